"""The quick start of the command line: what `unirender decompose` must not import, and that deferring loses nothing."""

import gc
import importlib
import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unirender.cli import main
from unirender.models.lean_imports import HIDDEN, lean_imports

# Each takes from 0.1 to 1.5 s to import, and decomposing a picture uses none of it.
FORBIDDEN = (
    "diffusers.models.transformers.transformer_flux",
    "matplotlib",
    "mitsuba",
    "scipy.optimize",
    "scipy.stats._stats_py",
    "torch._dynamo",
    "transformers",
)
REPORT = "import atexit, json, sys; atexit.register(lambda: print(json.dumps(sorted(sys.modules)), file=sys.stderr)); "


def run_python(code: str, *arguments: str) -> tuple[str, set[str]]:
    """Runs code in a process of its own: what it printed, and the modules that it imported."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", REPORT + code, *arguments], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout, set(json.loads(done.stderr.strip().splitlines()[-1]))


@pytest.mark.long
def test_decompose_does_without_what_it_does_not_use(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "picture.png")
    words = ["decompose", str(tmp_path / "picture.png"), "--output", str(tmp_path / "out"), "--no-progress"]
    frozen = "import atexit, gc; atexit.register(lambda: print('frozen', gc.get_freeze_count() > 100_000)); "
    printed, imported = run_python(frozen + "from unirender.cli import main; main()", *words)
    assert "roughness" in printed
    assert "frozen True" in printed
    assert "diffusers.models.unets.unet_2d_condition" in imported
    assert not imported & set(FORBIDDEN)


@pytest.mark.long
def test_a_library_import_has_all_of_diffusers() -> None:
    """The twin: without `lean_imports` the same model brings most of the list; inside a library nothing is hidden."""
    _, imported = run_python("import unirender.pipelines.unirender_pipeline")
    assert {"scipy.optimize", "scipy.stats._stats_py", "torch._dynamo"} <= imported


@pytest.mark.long
def test_what_was_left_out_is_there_when_it_is_asked_for() -> None:
    code = """
import unirender.models.lean_imports as lean
with lean.lean_imports():
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from diffusers.utils.torch_utils import is_compiled_module
    import torch

    def plain():
        return torch.compiler.is_compiling()

    left_alone = torch.compiler.disable()(torch.compiler.disable(plain, reason="a test"))
    before = [name in sys.modules for name in ("diffusers.models.unets.unet_1d", "torch._dynamo")]
    before += [left_alone(), is_compiled_module(torch.nn.Identity())]
    assert torch.compiler.disable.__module__ == lean.__name__
assert torch.compiler.disable.__module__ == "torch.compiler"
import scipy.stats
from diffusers.models.unets import UNet1DModel, UNet2DConditionModel as Again
assert Again is UNet2DConditionModel
print(any(before), UNet1DModel.__name__, scipy.stats.norm.cdf(0.0))
compiled = [torch.compile(lambda x, f=f: x + f(), backend="eager") for f in (plain, left_alone)]
print(*(float(function(torch.ones(()))) for function in compiled))
print(is_compiled_module(torch.compile(torch.nn.Identity(), backend="eager")), is_compiled_module(torch.nn.Identity()))
print(isinstance(lean._when_loaded(torch.compiler.disable)(type("Own", (), {})), type))
"""
    printed, imported = run_python(code)
    left_out, compiled, recognised, left_a_class = printed.splitlines()
    assert left_out == "False UNet1DModel 0.5"
    assert compiled == "2.0 1.0"  # the compiler looks into one of the two functions
    assert recognised == "True False"
    assert left_a_class == "True"
    assert "torch._dynamo.convert_frame" in imported


def test_results_are_read_without_what_only_measures_them() -> None:
    _, imported = run_python("import unirender_evaluation.results.file, unirender_evaluation.tables.build")
    assert "unirender_evaluation.light_metrics" in imported
    assert not imported & {*FORBIDDEN, "torch"}


def test_a_deferred_package_is_whole_for_whoever_asks_otherwise() -> None:
    """All of its names at once, or a file beside its code; a code that fails says so each time, not only at first."""
    code = """
import importlib.resources, pathlib, tempfile
import unirender.models.lean_imports as lean
with tempfile.TemporaryDirectory() as folder:
    for name, source in {"whole": "__all__ = ['one']; one = 1", "broken": "raise ImportError('no libfoo')"}.items():
        (pathlib.Path(folder) / name).mkdir()
        (pathlib.Path(folder) / name / "__init__.py").write_text(source)
        (pathlib.Path(folder) / name / "inner.py").touch()
    (pathlib.Path(folder) / "whole" / "data.txt").write_text("42")
    sys.path.insert(0, folder)
    lean.DEFERRED = ("whole", "broken")
    with lean.lean_imports():
        import broken.inner, whole.inner
    before = "one" in vars(whole)
    print(before, importlib.resources.files("whole").joinpath("data.txt").read_text())
    from whole import *
    print(one)
    for _ in range(2):
        try:
            broken.missing
        except ImportError as error:
            print(error)
"""
    printed, _ = run_python(code)
    assert printed.splitlines() == ["False 42", "1", "no libfoo", "no libfoo"]


def test_packages_are_listed_when_somebody_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a module in the place of the one of diffusers, which other tests have imported."""
    (tmp_path / "asks_at_once.py").write_text(
        "import importlib.metadata as m\nlisted = m.packages_distributions()\nhas = lambda name: name in listed\n"
    )
    asked: list[str] = []

    def listing() -> dict[str, list[str]]:
        asked.append("once")
        return {"PIL": ["pillow"]}

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(importlib.metadata, "packages_distributions", listing)
    monkeypatch.setattr("unirender.models.lean_imports.LISTS_FILES", "asks_at_once")
    with lean_imports():
        module = importlib.import_module("asks_at_once")
    del sys.modules["asks_at_once"]
    assert not asked
    assert (module.has("PIL"), module.has("cv2"), dict(module.listed)) == (True, False, listing())
    assert len(asked) == 2, "by the module once, and by the line above"
    assert importlib.metadata.packages_distributions is listing


def test_a_call_from_python_changes_nothing_of_the_process(tmp_path: Path) -> None:
    before, frozen = (gc.get_threshold(), list(sys.meta_path)), gc.get_freeze_count()
    with pytest.raises(SystemExit, match="1"):
        main(["decompose", str(tmp_path / "missing.png"), "--output", str(tmp_path / "out")])
    assert (gc.get_threshold(), list(sys.meta_path)) == before
    assert gc.get_freeze_count() <= frozen  # some of what these tests have frozen may be gone


def test_what_is_imported_already_is_left_alone() -> None:
    there = {name: sys.modules.get(name) for name in HIDDEN}
    path = list(sys.meta_path)
    with lean_imports():
        assert len(sys.meta_path) == len(path) + 1
    assert sys.meta_path == path
    assert {name: sys.modules.get(name) for name in HIDDEN} == there
