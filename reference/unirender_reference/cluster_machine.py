"""What decides the bytes of a render on a machine: code, versions, variant, CPU. Workers have to be like the caller."""

import functools
import hashlib
import importlib.metadata
import importlib.util
import platform
from dataclasses import asdict, dataclass
from pathlib import Path

from unirender_reference import backend
from unirender_reference.denoise import PACKAGE as DENOISER


@dataclass(frozen=True)
class Machine:
    """What decides the bytes of a render, as one process sees it; `denoiser` is None where nobody is to denoise."""

    unirender: str
    code: str
    mitsuba: str
    drjit: str
    variant: str
    cpu: str
    denoiser: str | None = None

    def differences(self, other: "Machine") -> list[str]:
        """Names of the fields in which another process is not as this one; not the CPU, nor a denoiser of no use."""
        mine, theirs = asdict(self), asdict(other)
        return [name for name in mine if name != "cpu" and mine[name] not in (None, theirs[name])]


@functools.cache
def this_machine() -> Machine:
    """This process: versions, a hash of the code and of the bundled lights, the CPU."""
    return Machine(
        unirender=importlib.metadata.version("unirender"),
        code=_code_hash(),
        mitsuba=importlib.metadata.version("mitsuba"),
        drjit=importlib.metadata.version("drjit"),
        variant=backend.variant_name(),
        cpu=_cpu_name(),
        denoiser=_denoiser(),
    )


def _denoiser() -> str:
    try:
        return importlib.metadata.version(DENOISER)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _code_hash() -> str:
    """Hash of every file of the two packages that decides a render: equal versions may be different checkouts."""
    digest = hashlib.sha256()
    for package, pattern in (
        ("unirender", "*.py"),
        ("unirender", "light/*.py"),
        ("unirender", "picture_files/*.py"),
        ("unirender", "system/*.py"),
        ("unirender_reference", "**/*"),
    ):
        spec = importlib.util.find_spec(package)
        assert spec is not None
        assert spec.origin is not None
        folder = Path(spec.origin).parent
        for path in sorted(folder.glob(pattern)):
            if path.is_file() and "__pycache__" not in path.parts:
                digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "CPU part")))
    return f"{platform.machine()} {next(names, platform.processor())}".strip()
