"""Memory that a process may have: of the machine, its swap, and the control groups around the process."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from unirender.system.machine import GIB, memory_bytes, memory_excess, needs_swap, peak_bytes, unswapped_bytes

NONE = 9223372036854771712  # what the first version of control groups says where nothing is limited
INNER = "system.slice/job.scope"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for files of the system's; the machine has 8 GiB, without swap and control groups."""
    monkeypatch.setattr("os.sysconf", lambda name: 8 * 2**18 if name == "SC_PHYS_PAGES" else 4096)
    for name, file in (("GROUPS", "cgroup"), ("GROUPS_ROOT", "groups"), ("SWAPS", "meminfo")):
        monkeypatch.setattr(f"unirender.system.machine.{name}", tmp_path / file)
    return tmp_path


def write(root: Path, files: dict[str, object]) -> None:
    for name, value in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{value}\n")


SWAP = {"meminfo": "MemTotal: 8388608 kB\nSwapTotal:       2097152 kB\nSwapFree: 0 kB"}
JOB = {"cgroup": f"0::/{INNER}"}
OLD = {"cgroup": "5:cpu,cpuacct:/\n4:memory:/docker/1\n1:name=systemd:/docker/1\n0::/"}


@pytest.mark.parametrize(
    ("files", "gib"),
    [
        ({}, 8),
        (SWAP, 10),
        ({"cgroup": "0::/", "groups/memory.max": 4 * GIB}, 4),  # a container sees its own group as the root
        ({"cgroup": "0::/", "groups/memory.max": "max"}, 8),
        ({"cgroup": "0::/", "groups/memory.max": 64 * GIB}, 8),
        (JOB | {f"groups/{INNER}/memory.max": 3 * GIB, "groups/memory.max": 5 * GIB}, 3),
        (JOB | {f"groups/{INNER}/memory.max": "max", "groups/system.slice/memory.max": 5 * GIB}, 5),
        (SWAP | JOB | {f"groups/{INNER}/memory.max": 3 * GIB}, 5),
        (SWAP | JOB | {f"groups/{INNER}/memory.max": 3 * GIB, f"groups/{INNER}/memory.swap.max": 0}, 3),
        (OLD | {"groups/memory/memory.limit_in_bytes": NONE}, 8),
        (OLD | {"groups/memory/memory.limit_in_bytes": 4 * GIB}, 4),
        (OLD | {"groups/memory/docker/1/memory.limit_in_bytes": 2 * GIB}, 2),
        (
            SWAP
            | OLD
            | {"groups/memory/memory.limit_in_bytes": 4 * GIB, "groups/memory/memory.memsw.limit_in_bytes": 5 * GIB},
            5,
        ),
    ],
)
def test_memory_is_the_least_that_is_allowed(machine: Path, files: dict[str, object], gib: float) -> None:
    write(machine, files)
    assert memory_bytes() == gib * GIB


def test_too_much_memory_is_told_with_numbers_that_differ(machine: Path) -> None:
    assert memory_excess(8 * GIB) is None
    assert memory_excess(8 * GIB + 1) == "would take about 8.1 GiB of memory, and this machine has 8.0 GiB for it"
    write(machine, {"cgroup": "0::/", "groups/memory.max": 4 * GIB + GIB // 16})
    assert memory_excess(memory_bytes() + 1) == (
        "would take about 4.1 GiB of memory, and this machine has 4.0 GiB for it"
    )
    (machine / "cgroup").unlink()
    assert memory_excess(8000 * GIB + 1) == "would take about 8,001 GiB of memory, and this machine has 8 GiB for it"
    assert str(memory_excess(GIB * 10**400)).startswith("would take about 10,000,000"), "beyond floats"


@pytest.mark.parametrize(
    ("files", "gib"), [(SWAP, 8), (SWAP | JOB | {f"groups/{INNER}/memory.max": 3 * GIB}, 3), ({}, 8)]
)
def test_what_only_swap_holds_is_told(machine: Path, files: dict[str, object], gib: float) -> None:
    write(machine, files)
    assert unswapped_bytes() == gib * GIB
    assert needs_swap(gib * GIB) is None
    said = f"takes about {gib}.1 GiB, and this machine has {gib}.0 GiB without swap: it may be very slow"
    assert needs_swap(gib * GIB + 1) == said


def test_a_machine_that_does_not_count_its_memory_has_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    assert memory_bytes() > 2**28
    monkeypatch.setattr("os.sysconf", lambda name: -1 if name == "SC_PHYS_PAGES" else 4096)
    assert memory_bytes() == math.inf


def test_where_nobody_counts_a_process_memory_it_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows has no module `resource`."""
    held = np.ones(2**25)  # 256 MiB
    assert held.nbytes < peak_bytes() < memory_bytes()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert math.isnan(peak_bytes())
