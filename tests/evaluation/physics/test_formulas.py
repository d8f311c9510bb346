"""Each physics test: a perfect renderer or decomposer passes, and a broken one (its twin) fails that test."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from tiny_suites import make_suite

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light
from unirender.light.symmetries import quarter_turn
from unirender_evaluation.methods.composite import Composite
from unirender_evaluation.methods.method import Image
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.physics import formulas
from unirender_evaluation.physics.questions import loop_by_roughness, true_maps
from unirender_evaluation.physics.stage import LEVELS, ROUGH, Stage
from unirender_evaluation.physics.tests import PHYSICS_TABLE, TESTS, renderer_tests
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite, load_suite

PERFECT = Composite().render
EXACT = tuple(test.name for test in TESTS.values() if test.asks == "render" and test.expected == 0)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("physics"), objects=1)


@pytest.mark.parametrize("name", EXACT)
def test_perfect_renderer_passes_and_twin_fails(name: str, suite: Suite) -> None:
    stage, test = Stage(suite, suite.scenes[0]), TESTS[name]
    good, bad = test.run(PERFECT, stage), test.run(test.twin, stage)
    assert good < 1e-4
    assert bad > 0.03
    assert test.fails(bad, good)
    assert not test.fails(good, good)


def test_no_law_is_kept_by_a_picture_without_light_nor_by_a_background(suite: Suite) -> None:
    """Black pictures obey all laws but the furnace's; a background that obeys them would thin out the object's
    errors."""
    stage = Stage(suite, suite.scenes[0])
    black = renderer_tests(lambda maps: np.zeros((maps.height, maps.width, 3), np.float32), stage)
    assert black == {"white_furnace": 1.0, "roughness_response": 0.0}
    bright = renderer_tests(lambda maps: np.full((maps.height, maps.width, 3), 2, np.float32), stage)
    assert {"superposition", "exposure_linearity"}.isdisjoint(bright), "no pixel that is not clipped"

    def over_light(maps: Intrinsics) -> Image:
        empty = maps.require("mask")["mask"] == 0
        return TESTS["superposition"].twin(maps) + 0.5 * empty * maps.require("environment")["environment"].mean()

    broken = renderer_tests(TESTS["superposition"].twin, stage)
    assert renderer_tests(over_light, stage) == broken


def test_roughness_response(suite: Suite) -> None:
    """The composite's truth is its own composite: correlation 1; a renderer blind to roughness scores 0."""
    stage, test = Stage(suite, suite.scenes[1]), TESTS["roughness_response"]
    good, bad = test.run(PERFECT, stage), test.run(test.twin, stage)
    assert good > 0.99
    assert abs(bad) < 1e-6
    assert test.fails(bad, good)


def test_quarter_turn_is_a_symmetry_of_the_world(suite: Suite) -> None:
    """Light derived from the turned normals and environment is the turned light; without turning the light it is
    not."""
    maps = suite.intrinsics(suite.scenes[1], suite.spec.base).replace(specular=None, diffuse=None)
    error = formulas.roll(PERFECT, maps)
    assert error < 0.03  # the environment is resampled
    turned = formulas.changed(maps, quarter_turn)
    wrong = turned.replace(environment=maps.environment)
    assert formulas.relative_error(PERFECT(wrong), np.rot90(PERFECT(maps))) > 3 * error
    four = maps
    for _ in range(4):
        four = formulas.changed(four, quarter_turn)
    np.testing.assert_allclose(four.require("normal")["normal"], maps.require("normal")["normal"], rtol=0, atol=1e-5)


def test_mirror_of_derived_light_is_exact(suite: Suite) -> None:
    maps = suite.intrinsics(suite.scenes[1], suite.spec.base).replace(specular=None, diffuse=None)
    assert formulas.mirror_flip(PERFECT, maps) < 1e-4


def test_closed_loop_of_true_maps(suite: Suite) -> None:
    """The true maps shaded by the composite are the truth of this suite, under either light; wrong maps are not."""
    stage = Stage(suite, suite.scenes[0])
    for name in ("composite_input", "composite_heldout"):
        test = TESTS[name]
        good, bad = test.run(true_maps, stage), test.run(test.twin, stage)
        assert good > 50
        assert test.fails(bad, good)


def test_the_loop_looks_through_the_suites_camera(suite: Suite) -> None:
    """Whatever camera a method puts beside its maps, and whoever was asked before."""
    values = []
    for camera in (suite.spec.camera, Camera(90.0)):
        stage = Stage(suite, suite.scenes[0])
        maps = stage.true_maps(suite.spec.base).replace(camera=camera)
        values.append(stage.shaded(maps, "composite", "input"))
    assert np.array_equal(*values)


@pytest.mark.long
def test_the_loops_twin_is_wrong_on_the_most_concave_scenes() -> None:
    """There the object's own shadows, which no loop has, can make half the albedo score better than the true one."""
    suite = load_suite("tiny")
    concave, *others = sorted(suite.scenes, key=lambda scene: unshadowed_share(suite, scene))[:6]
    assert concave.key == "test-000000_l1"

    def half_albedo(stage: Stage, material: MetallicRoughness, _: Image) -> Intrinsics:
        maps = stage.true_maps(material)
        return maps.replace(albedo=0.5 * maps.require("albedo")["albedo"])

    for stage in (Stage(suite, scene) for scene in (concave, *others)):
        for test in (TESTS["composite_input"], TESTS["composite_heldout"]):
            assert test.fails(test.run(test.twin, stage), test.run(true_maps, stage))
    stage, shown = Stage(suite, concave), TESTS["composite_input"]
    assert shown.run(half_albedo, stage) > shown.run(true_maps, stage) + 1, "why half the albedo is no twin"


def unshadowed_share(suite: Suite, scene: Scene) -> float:
    """Diffuse light over what there would be if the object hid none of it."""
    maps = suite.intrinsics(scene, suite.spec.base).require("normal", "environment", "diffuse", "mask")
    free = diffuse_light(maps["normal"], maps["environment"]) * maps["mask"]
    return float((maps["diffuse"] * maps["mask"]).sum() / free.sum())


class OneShading(Stage):
    """The composite in Mitsuba's place: nothing is rendered, and the loops of the true maps are exact here."""

    def shaded(self, maps: Intrinsics, shader: Any, light: Any) -> Image:
        return super().shaded(maps, "composite", light)


def test_loss_is_what_the_found_maps_lose(suite: Suite) -> None:
    stage = OneShading(suite, suite.scenes[0])
    for name in ("loss_input", "loss_heldout", "loss_rough"):
        test = TESTS[name]
        assert test.run(true_maps, stage) == 0.0
        assert test.fails(test.run(test.twin, stage), 0.0)
    direct = TESTS["shade_input"].run(true_maps, stage) - TESTS["shade_input"].run(TESTS["shade_input"].twin, stage)
    assert TESTS["loss_input"].run(TESTS["loss_input"].twin, stage) == pytest.approx(direct)


def test_the_primary_loop_takes_the_rough_pictures(suite: Suite) -> None:
    """A decomposer that is wrong on smooth pictures alone loses nothing in the primary figure, all in the other."""
    stage = OneShading(suite, suite.scenes[0])

    def wrong_where_smooth(stage: Stage, material: MetallicRoughness, image: Image) -> Intrinsics:
        return (true_maps if material[1] >= ROUGH else TESTS["loop_smooth"].twin)(stage, material, image)

    rough, smooth = (partial(loop_by_roughness, stage=stage, rough=rough) for rough in (True, False))
    assert rough(wrong_where_smooth) == rough(true_maps)
    assert smooth(wrong_where_smooth) < smooth(true_maps) - 10
    assert {m[1] >= ROUGH for m in stage.pictures} == {True, False}


@pytest.mark.parametrize("parameter", ["roughness", "metallic"])
def test_tau_ranks_the_sweep(parameter: str, suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    """The true maps rank their 11 pictures, reversed ones rank them backwards, a constant (the twin) not at all."""
    stage, test = Stage(suite, suite.scenes[0]), TESTS[f"tau_{parameter}"]
    monkeypatch.setattr(Stage, "image", lambda self, material: np.zeros((32, 32, 3), np.float32))

    def backwards(stage: Stage, material: MetallicRoughness, _: Image) -> Intrinsics:
        return stage.true_maps((1 - material[0], 1 - material[1]))

    assert test.run(true_maps, stage) == pytest.approx(1.0)
    assert test.run(backwards, stage) == pytest.approx(-1.0)
    assert test.run(test.twin, stage) == 0.0
    assert test.fails(0.0, 1.0)
    assert not test.fails(1.0, 1.0)


def test_kendall_tau_counts_pairs() -> None:
    """One swapped neighbour among n(n-1)/2 pairs costs two of them."""
    swapped = [1, 0, *range(2, 11)]
    assert formulas.kendall_tau(LEVELS, [float(x) for x in swapped]) == pytest.approx(1 - 2 / 55)


def test_every_test_is_defined_and_has_a_column(suite: Suite) -> None:
    columns = {column.key(DEFAULT_VARIANT) for column in PHYSICS_TABLE.columns}
    assert columns == {test.key for test in TESTS.values() if test.in_run}
    assert set(renderer_tests(PERFECT, Stage(suite, suite.scenes[0]))) == {
        test.name for test in TESTS.values() if test.asks == "render"
    }
    for test in TESTS.values():
        assert test.formula
        assert test.twin_is
        assert test.margin > 0
