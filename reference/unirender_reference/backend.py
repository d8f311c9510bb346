"""Which Mitsuba runs, and on which LLVM.

Dr.Jit's CPU backend loads libLLVM as soon as drjit is imported. LLVM 14 to 16 *abort the process* on
AVX-512 machines ("Cannot select fminimum"), so the library is chosen here, before that can happen: the variable
`DRJIT_LIBLLVM_PATH`, then the wheel `karellen-llvm-core`, then the newest LLVM of the system or of the folder that
Python is installed in, as conda's is, also where a virtual environment was made with conda's Python. Everything older
than `MINIMUM_LLVM` is refused.

Call `mitsuba()` instead of importing mitsuba.
"""

import contextlib
import ctypes.util
import importlib.metadata
import importlib.util
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError

MINIMUM_LLVM = 17
DEFAULT_VARIANT = "llvm_ad_rgb"
VARIANT_VARIABLE = "UNIRENDER_MITSUBA_VARIANT"
LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
LLVM_WHEEL = "karellen-llvm-core"

# Where Debian, Fedora, Arch and Homebrew put libLLVM.
SYSTEM_PATTERNS = (
    "/usr/lib/llvm-*/lib/libLLVM*",
    "/usr/lib/*-linux-gnu/libLLVM*",
    "/usr/lib64/libLLVM*",
    "/usr/lib64/llvm*/lib64/libLLVM*",
    "/usr/lib/libLLVM*",
    "/usr/local/lib/libLLVM*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*",
    "/usr/local/opt/llvm*/lib/libLLVM*",
)

# LLVMGetVersion came with LLVM 16; a library without it is older (or no LLVM). A child asks: two LLVMs in one process
# register the same command-line options and clash.
_PROBE = """
import ctypes, sys
major = (ctypes.c_uint * 3)()
step = ctypes.sizeof(ctypes.c_uint)
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*(ctypes.byref(major, i * step) for i in range(3)))
print(major[0])
"""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM on this machine.

    Attributes:
        path: the shared library, links resolved.
        major: LLVM's major version.
        source: where it was found: the variable, the wheel or the system.
    """

    path: Path
    major: int
    source: str


def find_llvm() -> LlvmLibrary:
    """The libLLVM that Dr.Jit will load.

    Raises:
        UnirenderError: none is found, or the one asked for is missing, unreadable or older than `MINIMUM_LLVM`.
    """
    asked = os.environ.get(LLVM_VARIABLE)
    if asked:
        path = Path(asked)
        if not path.is_file():
            raise UnirenderError(f"{LLVM_VARIABLE}={asked}: no such file, expected a libLLVM; unset it or correct it")
        major = llvm_major(path)
        if major < MINIMUM_LLVM:
            found = f"LLVM {major}" if major else f"a library that is not LLVM 16 or newer ({path.name})"
            raise UnirenderError(
                f"{LLVM_VARIABLE}={asked}: got {found}, expected LLVM >= {MINIMUM_LLVM} "
                f"(14 to 16 abort the process on AVX-512 machines); unset it, or `pip install {LLVM_WHEEL}`"
            )
        return LlvmLibrary(path.resolve(), major, LLVM_VARIABLE)
    for path in _wheel_libraries():
        major = llvm_major(path)
        if major >= MINIMUM_LLVM:
            return LlvmLibrary(path, major, f"wheel {LLVM_WHEEL}")
    system = [LlvmLibrary(path, llvm_major(path), "system") for path in _system_libraries()]
    usable = [library for library in system if library.major >= MINIMUM_LLVM]
    if usable:
        return max(usable, key=lambda library: library.major)
    seen = ", ".join(sorted({f"LLVM {library.major}" for library in system if library.major})) or "none"
    raise UnirenderError(
        f"LLVM: found {seen} on this machine, expected >= {MINIMUM_LLVM}; `pip install {LLVM_WHEEL}` (Linux x86-64), "
        f"install libllvm19 or newer, or point {LLVM_VARIABLE} at one"
    )


def choose_llvm() -> None:
    """Has Dr.Jit load the library of `find_llvm`. To be called before anybody imports drjit or mitsuba, which load one.

    Raises:
        UnirenderError: as `find_llvm`.
    """
    os.environ[LLVM_VARIABLE] = str(find_llvm().path)


def llvm_major(path: Path) -> int:
    """Major version of a libLLVM: from its name (`libLLVM.so.23.1`, `libLLVM-14.so.1`), or asked of it; 0: unknown."""
    match = re.search(r"libLLVM(?:-(\d+)|\.so\.(\d+)|\.(\d+)\.dylib)", path.resolve().name)
    if match:
        return int(next(group for group in match.groups() if group))
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE, str(path)], capture_output=True, text=True, timeout=60, check=False
        )
        return int(probe.stdout.strip() or 0)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return 0


def _wheel_libraries() -> Iterator[Path]:
    try:
        files = importlib.metadata.files(LLVM_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return
    for file in files:
        if file.name.startswith("libLLVM.") or file.name.startswith("libLLVM-"):
            path = Path(str(file.locate())).resolve()
            if path.is_file():
                yield path


def _system_libraries() -> list[Path]:
    patterns = [(Path("/"), pattern.lstrip("/")) for pattern in SYSTEM_PATTERNS]
    patterns += [(Path(prefix), "lib/libLLVM*") for prefix in (sys.prefix, sys.base_prefix)]
    found = {
        path.resolve()
        for folder, pattern in patterns
        for path in folder.glob(pattern)
        if ".so" in path.name or path.suffix == ".dylib"
    }
    named = ctypes.util.find_library("LLVM")
    if named and Path(named).is_file():
        found.add(Path(named).resolve())
    return sorted(path for path in found if path.is_file())


def variant_name(variant: str | None = None) -> str:
    """The variant to use: the argument, else `UNIRENDER_MITSUBA_VARIANT`, else `llvm_ad_rgb`."""
    return variant or os.environ.get(VARIANT_VARIABLE) or DEFAULT_VARIANT


def mitsuba(variant: str | None = None) -> Any:
    """The mitsuba module with its variant set (`llvm_ad_rgb` unless asked otherwise). Cheap after the first call.

    Raises:
        UnirenderError: mitsuba is not installed or cannot be loaded, the variant does not exist, or no usable LLVM is
            found.
    """
    name = variant_name(variant)
    module = sys.modules.get("mitsuba")
    if module is not None and module.variant() == name:
        return module
    if importlib.util.find_spec("mitsuba") is None:
        raise UnirenderError("mitsuba: not installed, expected mitsuba >= 3.9; `pip install mitsuba`")
    try:  # whatever the variant
        choose_llvm()
    except UnirenderError:
        if name.startswith("llvm"):
            raise
    try:
        import mitsuba as module
    except (ImportError, NameError) as error:  # Dr.Jit stumbles over the name of what it could not load
        why = error.__cause__ or error.__context__ or error
        raise UnirenderError(
            f"mitsuba: cannot be loaded ({why}), expected its package and the shared libraries that it needs; install "
            "what is missing (libatomic.so.1: the system's package libatomic1 or libatomic)"
        ) from error

    loaded = _loaded_llvm_major()
    if name.startswith("llvm") and 0 < loaded < MINIMUM_LLVM:
        raise UnirenderError(
            f"LLVM {loaded} was loaded by an earlier `import drjit` or `import mitsuba`, expected >= {MINIMUM_LLVM}; "
            "call unirender_reference.backend.mitsuba() before these imports"
        )
    if name not in module.variants():
        raise UnirenderError(
            f"Mitsuba variant: got {name!r}, expected one of {', '.join(module.variants())}; "
            f"choose one of them ({VARIANT_VARIABLE})"
        )
    if module.variant() != name:
        module.set_variant(name)
    return module


def _loaded_llvm_major() -> int:
    """Major version of the libLLVM mapped into this process; 0 where the system does not tell."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return 0
    paths = {line.split(maxsplit=5)[5] for line in lines if "libLLVM" in line}
    return max((llvm_major(Path(path)) for path in paths), default=0)


def set_threads(count: int) -> None:
    """Limits Dr.Jit's CPU threads, the calling one included."""
    mitsuba()
    import drjit

    drjit.set_thread_count(count)


@contextlib.contextmanager
def renderer_threads(count: int) -> Iterator[None]:
    """Dr.Jit works with this many threads until the block is left; 0: with as many as before."""
    mitsuba()
    import drjit

    before = drjit.thread_count()
    if count:
        drjit.set_thread_count(count)
    try:
        yield
    finally:
        if count:
            drjit.set_thread_count(before)


def doctor() -> list[tuple[str, str, str]]:
    """What the reference renderer found on this machine: (name, value, status), status "ok", "note" or "fail"."""
    rows = [("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}", "ok")]
    for package in ("mitsuba", "drjit", LLVM_WHEEL, "cholespy"):
        try:
            rows.append((package, importlib.metadata.version(package), "ok"))
        except importlib.metadata.PackageNotFoundError:
            rows.append((package, "not installed", "fail" if package in ("mitsuba", "drjit") else "note"))
    name = variant_name()
    rows.append(("variant", name, "ok"))
    if name.startswith("llvm"):
        try:
            library = find_llvm()
            rows.append(("llvm", f"{library.major} from {library.source}: {library.path}", "ok"))
        except UnirenderError as error:
            return [*rows, ("llvm", str(error), "fail")]
    try:
        module = mitsuba()
        import drjit

        total = drjit.sum(drjit.arange(module.Float, 5))[0]
        works = total == 10
        rows.append(("kernel", f"sum(0..4) = {total:g}", "ok" if works else "fail"))
        rows.append(("threads", str(drjit.thread_count()), "ok"))
    except Exception as error:  # a doctor reports every failure, whatever its type
        rows.append(("kernel", f"{type(error).__name__}: {error}", "fail"))
    return rows
