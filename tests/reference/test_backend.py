"""Which LLVM is chosen, and that one that would abort the process is refused before it can."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from unirender.errors import UnirenderError
from unirender_reference import backend


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM.so.23.1", 23),
        ("libLLVM-14.so.1", 14),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM-19.so", 19),
        ("libLLVM.so.19.1", 19),
    ],
)
def test_version_is_read_from_the_name(tmp_path: Path, name: str, major: int) -> None:
    path = tmp_path / name
    path.touch()
    assert backend.llvm_major(path) == major


def test_version_of_a_file_that_is_no_library_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "libother.so"
    path.write_text("not a library")
    assert backend.llvm_major(path) == 0


def test_version_is_asked_of_a_library_without_a_number(tmp_path: Path) -> None:
    found = backend.find_llvm()
    path = tmp_path / "libsomething.so"
    path.symlink_to(found.path)  # resolved: the name of the target has the number
    assert backend.llvm_major(path) == found.major
    assert found.major >= backend.MINIMUM_LLVM


def test_probe_agrees_with_the_name() -> None:
    found = backend.find_llvm()
    probe = subprocess.run([sys.executable, "-c", backend._PROBE, str(found.path)], capture_output=True, text=True)
    assert probe.stdout.strip() == str(found.major), probe.stderr


def test_old_llvm_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = tmp_path / "libLLVM-15.so.1"
    old.touch()
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(old))
    with pytest.raises(UnirenderError, match=r"LLVM 15.*expected LLVM >= 17.*karellen"):
        backend.find_llvm()


def test_missing_llvm_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "nowhere.so"))
    with pytest.raises(UnirenderError, match="no such file"):
        backend.find_llvm()


@pytest.mark.parametrize("prefix", ["prefix", "base_prefix"])
def test_llvm_of_a_conda_environment_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefix: str) -> None:
    """Also from a virtual environment that was made with its Python."""
    monkeypatch.delenv(backend.LLVM_VARIABLE, raising=False)
    monkeypatch.setattr(backend, "_wheel_libraries", list)
    monkeypatch.setattr(backend, "SYSTEM_PATTERNS", (str(tmp_path / "usr" / "libLLVM*"),))
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    for name in ("prefix", "base_prefix"):
        monkeypatch.setattr(sys, name, str(tmp_path / ("env" if name == prefix else "venv")))
    for folder, name in (("usr", "libLLVM-14.so.1"), ("env/lib", "libLLVM.so.21.1")):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / name).touch()
    assert backend.find_llvm() == backend.LlvmLibrary(tmp_path / "env" / "lib" / "libLLVM.so.21.1", 21, "system")
    monkeypatch.setattr(sys, prefix, str(tmp_path))
    with pytest.raises(UnirenderError, match=r"found LLVM 14 .*expected >= 17; .* install libllvm19 or newer"):
        backend.find_llvm()


def test_refusal_is_an_exception_and_not_an_abort(tmp_path: Path) -> None:
    old = tmp_path / "libLLVM-14.so.1"
    old.touch()
    code = "from unirender_reference.backend import mitsuba; mitsuba()"
    run = subprocess.run(
        [sys.executable, "-c", code], env={"DRJIT_LIBLLVM_PATH": str(old)}, capture_output=True, text=True
    )
    assert run.returncode == 1
    assert "UnirenderError" in run.stderr
    assert "LLVM 14" in run.stderr


def test_what_mitsuba_cannot_load_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a slim container has no libatomic: Dr.Jit fails on its own message."""
    (tmp_path / "mitsuba.py").write_text(
        "try:\n    raise ImportError('libatomic.so.1: cannot open shared object file')\n"
        "except ImportError:\n    _drjit_ext.__file__\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mitsuba", raising=False)
    monkeypatch.setattr(backend, "choose_llvm", lambda: None)
    with pytest.raises(
        UnirenderError, match=r"cannot be loaded \(libatomic.so.1: cannot open .*install what is missing"
    ):
        backend.mitsuba()


def test_unknown_variant_is_refused() -> None:
    with pytest.raises(UnirenderError, match="no_such_variant"):
        backend.mitsuba("no_such_variant")
    assert backend._loaded_llvm_major() >= backend.MINIMUM_LLVM  # not even then does drjit pick a library itself


def test_an_old_llvm_that_is_already_loaded_is_refused() -> None:
    """`import drjit` before us loads whatever the system has; where that is too old we must say so."""
    code = "import drjit; from unirender_reference import backend as b; print(b._loaded_llvm_major()); b.mitsuba()"
    environment = {name: value for name, value in os.environ.items() if name != backend.LLVM_VARIABLE}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    major = int(run.stdout or 0)
    if 0 < major < backend.MINIMUM_LLVM:
        assert run.returncode == 1
        assert f"LLVM {major} was loaded by an earlier" in run.stderr
    else:
        assert run.returncode == 0, run.stderr


def test_doctor_reports_a_working_backend() -> None:
    rows = backend.doctor()
    assert {name for name, _, _ in rows} >= {"python", "mitsuba", "llvm", "kernel", "threads"}
    assert not [row for row in rows if row[2] == "fail"]


def test_doctor_survives_a_broken_backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "nowhere.so"))
    assert backend.doctor()[-1][::2] == ("llvm", "fail")
