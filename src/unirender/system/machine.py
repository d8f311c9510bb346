"""What the machine has, or leaves to this process."""

import importlib.util
import math
import os
import sys
from pathlib import Path

GIB = 2**30
GROUPS = Path("/proc/self/cgroup")  # of Linux: which control groups this process is in
GROUPS_ROOT = Path("/sys/fs/cgroup")
SWAPS = Path("/proc/meminfo")
LIMITS = {  # by version of the control groups: of memory, and of swap, which the first one's counts with memory
    1: ("memory.limit_in_bytes", "memory.memsw.limit_in_bytes"),
    2: ("memory.max", "memory.swap.max"),
}


def memory_bytes() -> float:
    """Memory and swap that this process may have: of the machine, or of its control groups (a container, a job), where
    they allow less; infinite where the system does not tell."""
    return _allowed_bytes(_swap_bytes())


def unswapped_bytes() -> float:
    """The same without swap."""
    return _allowed_bytes(0)


def peak_bytes() -> float:
    """The most memory that this process has had so far; NaN where the system does not tell, as Windows."""
    if importlib.util.find_spec("resource") is None:
        return math.nan
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return float(unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def memory_excess(wanted: float) -> str | None:
    """What to say of something that takes so many bytes, where there are not so many; None where there are.

    What is wanted is rounded up and what there is down, so that the numbers differ.
    """
    present = memory_bytes()
    if wanted <= present:
        return None
    needed, there = _gibibytes(wanted, present)
    return f"would take about {needed} GiB of memory, and this machine has {there} GiB for it"


def needs_swap(wanted: float) -> str | None:
    """What to say of something that takes so many bytes, where only swap makes them so many; None elsewhere."""
    present = unswapped_bytes()
    if wanted <= present:
        return None
    needed, there = _gibibytes(wanted, present)
    return f"takes about {needed} GiB, and this machine has {there} GiB without swap: it may be very slow"


def _gibibytes(wanted: float, present: float) -> tuple[str, str]:
    """Both as text, the first rounded up and the second down."""
    if wanted >= 100 * GIB:
        return f"{int(-(-wanted // GIB)):,}", f"{present // GIB:,.0f}"
    return f"{-(-wanted * 10 // GIB) / 10:.1f}", f"{present * 10 // GIB / 10:.1f}"


def _allowed_bytes(swap: float) -> float:
    """Of the machine with so much swap, or of its control groups; infinite where the system does not tell."""
    pages = os.sysconf("SC_PHYS_PAGES") if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}) else -1
    if pages <= 0:
        return math.inf
    return min([float(pages * os.sysconf("SC_PAGE_SIZE")) + swap, *_group_limits(swap)])


def _swap_bytes() -> float:
    """Of the machine; 0 where it has none or does not tell."""
    for line in _text(SWAPS).splitlines():
        if line.startswith("SwapTotal:"):
            return 1024.0 * int(line.split()[1])
    return 0.0


def _group_limits(swap: float) -> list[float]:
    """Bytes that each control group around this process allows, with what it may have of the machine's swap."""
    limits = []
    for line in _text(GROUPS).splitlines():
        _, controllers, path = line.split(":", 2)
        version = 1 if "memory" in controllers.split(",") else 2
        if version == 2 and controllers:
            continue
        root = GROUPS_ROOT / "memory" if version == 1 else GROUPS_ROOT
        inner = root / path.lstrip("/")  # which is not there inside of a container: `root` is its own group then
        for folder in (inner, *inner.parents):
            limit, more = (_number(folder / name) for name in LIMITS[version])
            limits.append(min(limit + swap, more if version == 1 else limit + more))
    return limits


def _number(path: Path) -> float:
    """Of a file of the system's; infinite where it has none, or says `max`."""
    text = _text(path).strip()
    return float(text) if text.isdigit() else math.inf


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
