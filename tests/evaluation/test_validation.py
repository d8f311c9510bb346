"""What a training run is told about itself: the benchmark's own numbers, with their directions."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_models import make_pipeline
from tiny_suites import write_suite

from unirender.errors import UnirenderError, UsageError
from unirender_evaluation.scoring import score_maps
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.tasks import tasks
from unirender_evaluation.validation import SCORES, suite_validation


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_suite(tmp_path_factory.mktemp("validation"), objects=1))


def test_scores_are_the_benchmarks_own_means_with_their_directions(suite: str) -> None:
    pipeline, loaded = make_pipeline(), load_suite(suite)
    found = suite_validation(suite, 2)(pipeline)
    assert {name: score.higher_is_better for name, score in found.items()} == {
        "albedo.psnr": True,
        "normal.cosine": True,
        "metallic.mse": False,
        "roughness.mse": False,
        "render.psnr": True,
        "edit.psnr": True,
    }
    assert set(SCORES) == found.keys()
    by_hand = []
    for number, scene in enumerate(loaded.scenes):
        task = list(tasks(loaded, "inverse", "single-image", [scene]))[number]
        assert task.truth_maps is not None
        by_hand.append(score_maps(pipeline.decompose(**task.inputs["decompose"]).intrinsics, task.truth_maps))
    for name, key in (("albedo.psnr", "albedo.psnr@masked-srgb-raw"), ("roughness.mse", "roughness.mse@masked")):
        assert found[name].value == pytest.approx(np.mean([values[key] for values in by_hand]))


def test_a_good_renderer_scores_better_than_a_random_one(suite: str) -> None:
    validate = suite_validation(suite, 2)
    random, composite = (make_pipeline(physics_prior="composite") for _ in range(2))
    for p in composite.dual_stream.image_unet.conv_out.parameters():
        torch.nn.init.zeros_(p)  # with the prior alone it renders the composite, which is this suite's truth
    good, bad = (validate(pipeline)["render.psnr"] for pipeline in (composite, random))
    assert good.value > 45
    assert good.better_than(bad)


def test_what_cannot_be_scored_is_refused(tmp_path: Path, suite: str) -> None:
    with pytest.raises(UnirenderError, match="no suite"):
        suite_validation(str(tmp_path / "none.toml"), 1)
    with pytest.raises(UnirenderError, match="at least 1 scene"):
        suite_validation(suite, 0)
    with pytest.raises(UsageError, match=r"--validate 3: the suite .* has 2 scenes, expected at most as many"):
        suite_validation(suite, 3)  # the model card would say that there were three
