"""Mitsuba as a row: its answers are the truth's to within noise, and it says nothing of foreign objects."""

from dataclasses import replace
from pathlib import Path

import pytest
from tiny_suites import make_suite

from unirender_evaluation.engine import score
from unirender_evaluation.methods.mitsuba import MITSUBA, MitsubaScene, mitsuba_jobs, prediction
from unirender_evaluation.physics import rows as physics_rows
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.suites.suite import Scene, Suite, load_suite
from unirender_evaluation.tables.build import RANKED_KINDS
from unirender_evaluation.tasks import tasks

SCENE = "test-000015_l1"  # its truth took the fewest samples


@pytest.fixture(scope="module")
def suite() -> Suite:
    return load_suite("tiny")


@pytest.fixture(scope="module")
def mitsuba(suite: Suite) -> MitsubaScene:
    return MitsubaScene(suite, suite.scene(SCENE))


def test_it_is_no_competitor() -> None:
    assert MITSUBA.kind not in RANKED_KINDS


def test_it_knows_the_object(mitsuba: MitsubaScene) -> None:
    assert mitsuba.shows_the_truth


def test_decomposition_is_the_truths(mitsuba: MitsubaScene, suite: Suite) -> None:
    """To within the tracing noise of edge pixels; the twin, another material, is not."""
    task = next(tasks(suite, "inverse", "single-image", [mitsuba.scene]))
    values = score(task, prediction(task, mitsuba), ())
    assert values["albedo.psnr@masked-srgb-raw"] > 40
    assert values["normal.cosine"] > 0.999
    assert values["roughness.mse@masked"] < 1e-4  # not 0: a faint edge pixel may be hit by one trace alone
    assert values["metallic.mse@masked"] < 1e-4
    twin = replace(task, sample=f"{mitsuba.scene.key}_m100_r050")
    assert score(task, prediction(twin, mitsuba), ())["metallic.mse@masked"] > 0.01


def test_pictures_are_the_truths(mitsuba: MitsubaScene, suite: Suite) -> None:
    """An edit is a render of the truth with as many samples: near 42 dB where the noise ceiling is 45; the twin, the
    picture of another edit, is far from it."""
    first, second, *_ = tasks(suite, "rendering", "given", [mitsuba.scene])
    key = f"{first.quantity}.psnr@masked-srgb-raw"
    assert score(first, prediction(first, mitsuba), ())[key] > 38
    assert score(first, prediction(second, mitsuba), ())[key] < 35


def key_of(what: str, *_: object) -> str:
    return what


def test_foreign_objects_have_no_values(tmp_path: Path) -> None:
    """The truth of this suite is a sphere that the generator does not make."""
    foreign = make_suite(tmp_path, objects=1)
    scenes: list[Scene] = list(foreign.scenes)
    job = next(mitsuba_jobs(foreign, scenes, scenes[0], key_of, (), None))
    assert job.make().values == {}
    assert list(mitsuba_jobs(foreign, scenes, scenes[1], key_of, (), 0)) == []


@pytest.mark.long
def test_its_closed_loop_is_that_of_the_true_maps(mitsuba: MitsubaScene, suite: Suite) -> None:
    """Its own buffers, shaded again, are as near the truth as the stored ones."""
    stage = Stage(suite, mitsuba.scene)
    values = physics_rows.loop_values(mitsuba.maps(suite.spec.base), stage)
    assert abs(values["loss_input.loss"]) < 0.5
    assert abs(values["loss_heldout.loss"]) < 0.5
    wrong = mitsuba.maps((suite.spec.base[0], 0.9))
    assert physics_rows.loop_values(wrong, stage)["loss_input.loss"] > 3
