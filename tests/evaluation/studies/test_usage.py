"""Studies with arguments that cannot be right: one sentence, before anything is made."""

from pathlib import Path
from typing import Any

import pytest

from unirender.diffusion.steps import MOST_STEPS
from unirender.errors import UsageError
from unirender_evaluation.studies.optimiser.commands import BenchIngredients, BenchRace
from unirender_evaluation.studies.sampling.command import BenchSampling
from unirender_evaluation.studies.speed.command import BenchSpeed
from unirender_evaluation.studies.training.command import BenchTraining
from unirender_evaluation.studies.unknown_mesh.command import BenchUnknownMesh
from unirender_evaluation.studies.warm_start.command import BenchWarmStart
from unirender_reference.optimize.multiview.config import OptimizeConfig

NO_DATA = Path("none")


@pytest.mark.parametrize(
    ("study", "options", "message"),
    [
        (BenchIngredients, {"objects": 0}, "--objects 0: expected at least 1"),
        (BenchIngredients, {"seed": -1}, "--seed -1: expected at least 0"),
        (
            BenchIngredients,
            {"variants": ("log", "colour")},
            "--variants colour: expected some of full, .*, or the ",
        ),
        (BenchRace, {"objects": 0}, "--objects 0: expected at least 1"),
        (BenchSampling, {"scenes": 0}, "--scenes 0: expected at least 1"),
        (BenchSampling, {"steps": ()}, "--steps : expected at least one number"),
        (BenchSampling, {"steps": (0, 2)}, "--steps 0: expected at least 1"),
        (BenchSampling, {"steps": (2, MOST_STEPS + 1)}, f"--steps {MOST_STEPS + 1}: expected at most {MOST_STEPS}"),
        (BenchSampling, {"samples": (5, 5)}, "--samples 5 5: expected at least one number, none of them twice"),
        (BenchSampling, {"seed": -1}, "--seed -1: expected at least 0"),
        (BenchSpeed, {"scenes": 0}, "--scenes 0: expected at least 1"),
        (BenchSpeed, {"repeats": 0}, "--repeats 0: expected at least 1"),
        (BenchSpeed, {"parts": ("start", "start")}, "--parts start start: expected none of them twice"),
        (BenchSpeed, {"parts": ("network", "training")}, "--parts training: expected --data beside it"),
        (BenchSpeed, {"preset": "none"}, "preset: got 'none'"),
        (BenchSpeed, {"preset": "sd15"}, "--preset sd15: expected one with the pixel codec"),
        (BenchTraining, {"data": NO_DATA, "steps": 0}, "--steps 0: expected at least 1"),
        (BenchTraining, {"data": NO_DATA, "scenes": 0}, "--scenes 0: expected at least 1"),
        (BenchTraining, {"data": NO_DATA, "batch_size": 0}, "--batch-size 0: expected at least 1"),
        (BenchTraining, {"data": NO_DATA, "seed": -1}, "--seed -1: expected at least 0"),
        (
            BenchTraining,
            {"data": NO_DATA, "choices": ("cycle", "no-such")},
            "--choices no-such: expected some of plain, .*, or the groups chance",
        ),
        (BenchUnknownMesh, {"objects": 0}, "--objects 0: expected at least 1"),
        (BenchUnknownMesh, {"views": 3}, "--views 3: expected at least 4: fewer silhouettes"),
        (BenchUnknownMesh, {"config": OptimizeConfig(texture_size=1)}, "--texture-size 1: expected 4 or more"),
        (BenchWarmStart, {"scenes": 0}, "--scenes 0: expected at least 1"),
    ],
)
def test_what_cannot_be_right_is_refused(study: Any, options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=message):
        study(out=tmp_path / "out", **options).run()
    assert not (tmp_path / "out").exists()
