"""The quick start of the command line: what `unirender decompose` must not import, and that deferring loses nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

# Each takes from 0.1 to 1.5 s to import, and decomposing a picture uses none of it.
FORBIDDEN = (
    "diffusers.models.transformers.transformer_flux",
    "matplotlib",
    "mitsuba",
    "scipy.optimize",
    "scipy.stats._stats_py",
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


@pytest.mark.slow
def test_decompose_does_without_what_it_does_not_use(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "picture.png")
    words = ["decompose", str(tmp_path / "picture.png"), "--output", str(tmp_path / "out"), "--no-progress"]
    printed, imported = run_python("from unirender.cli import main; main()", *words)
    assert "roughness" in printed
    assert "diffusers.models.unets.unet_2d_condition" in imported
    assert not imported & set(FORBIDDEN)


@pytest.mark.slow
def test_a_library_import_has_all_of_diffusers() -> None:
    """The twin: without `lean_imports` the same model brings most of the list; inside a library nothing is hidden."""
    _, imported = run_python("import unirender.pipelines.unirender_pipeline")
    assert {"scipy.optimize", "scipy.stats._stats_py"} <= imported


@pytest.mark.slow
def test_what_was_deferred_is_there_when_it_is_asked_for() -> None:
    code = """
from unirender.models.lean_imports import lean_imports
with lean_imports():
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    before = "diffusers.models.unets.unet_1d" in sys.modules
import scipy.stats, torch
from diffusers.models.unets import UNet1DModel, UNet2DConditionModel as Again
assert Again is UNet2DConditionModel
compiled = torch.compile(lambda x: x + 1, backend="eager")
print(before, UNet1DModel.__name__, scipy.stats.norm.cdf(0.0), float(compiled(torch.ones(()))))
"""
    printed, imported = run_python(code)
    assert printed.split() == ["False", "UNet1DModel", "0.5", "2.0"]
    assert "torch._dynamo.convert_frame" in imported


def test_what_is_imported_already_is_left_alone() -> None:
    from unirender.models.lean_imports import HIDDEN, lean_imports

    there = {name: sys.modules.get(name) for name in HIDDEN}
    path = list(sys.meta_path)
    with lean_imports():
        assert len(sys.meta_path) == len(path) + 1
    assert sys.meta_path == path
    assert {name: sys.modules.get(name) for name in HIDDEN} == there
