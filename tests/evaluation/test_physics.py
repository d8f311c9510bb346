"""Each physics test: a perfect renderer passes, and a broken one (its twin) fails that test."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tiny_suites import make_suite

from unirender.intrinsics import Intrinsics
from unirender.symmetries import quarter_turn
from unirender_evaluation import physics
from unirender_evaluation.methods import Composite
from unirender_evaluation.suites import Suite

PERFECT = Composite().render
Render = Callable[[Intrinsics], np.ndarray]


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("physics"), objects=1)


def broken(change: Callable[[np.ndarray, Intrinsics], np.ndarray]) -> Render:
    return lambda maps: change(PERFECT(maps), maps).astype(np.float32)


def horizontal_gradient(image: np.ndarray, _: Intrinsics) -> np.ndarray:
    return image * np.linspace(0.7, 1.3, image.shape[1])[None, :, None]


TWINS: dict[str, Render] = {
    "superposition": broken(lambda image, _: image**0.8),
    "exposure_linearity": broken(lambda image, _: image**0.8),
    "white_furnace": broken(lambda image, _: 0.8 * image),
    "mirror_flip": broken(horizontal_gradient),
    "roll": broken(horizontal_gradient),
    "metallic_linearity": lambda maps: PERFECT(maps.replace(metallic=maps.require("metallic")["metallic"] ** 2)),
}


@pytest.mark.parametrize("name", TWINS)
def test_perfect_renderer_passes_and_twin_fails(name: str, suite: Suite) -> None:
    scene = suite.scenes[0]
    good = physics.renderer_tests(PERFECT, suite, scene)[name]
    bad = physics.renderer_tests(TWINS[name], suite, scene)[name]
    assert good < 1e-4
    assert bad > 0.03


def test_roughness_response(suite: Suite) -> None:
    """The composite's truth is its own composite: correlation 1; a renderer blind to roughness scores 0."""
    scene = suite.scenes[1]
    assert physics.renderer_tests(PERFECT, suite, scene)["roughness_response"] > 0.99
    blind = lambda maps: PERFECT(maps.replace(specular=maps.require("diffuse")["diffuse"]))  # noqa: E731 - a broken twin
    assert abs(physics.renderer_tests(blind, suite, scene)["roughness_response"]) < 1e-6


def test_quarter_turn_is_a_symmetry_of_the_world(suite: Suite) -> None:
    """Light derived from the turned normals and environment is the turned light; without turning the light it is
    not."""
    maps = suite.intrinsics(suite.scenes[1], suite.spec.base).replace(specular=None, diffuse=None)
    error = physics.roll(PERFECT, maps)
    assert error < 0.03  # the environment is resampled
    turned = physics.changed(maps, quarter_turn)
    wrong = turned.replace(environment=maps.environment)
    assert physics.relative_error(PERFECT(wrong), np.rot90(PERFECT(maps))) > 3 * error
    four = maps
    for _ in range(4):
        four = physics.changed(four, quarter_turn)
    np.testing.assert_allclose(four.require("normal")["normal"], maps.require("normal")["normal"], rtol=0, atol=1e-5)


def test_mirror_of_derived_light_is_exact(suite: Suite) -> None:
    maps = suite.intrinsics(suite.scenes[1], suite.spec.base).replace(specular=None, diffuse=None)
    assert physics.mirror_flip(PERFECT, maps) < 1e-4


def test_closed_loop_of_true_maps(suite: Suite) -> None:
    """The true maps shaded by the composite are the truth of this suite, under either light; wrong maps are not."""
    scene = suite.scenes[0]
    maps = suite.intrinsics(scene, suite.spec.base)
    shaders = {"composite": physics.composite_shader}
    loops = physics.closed_loop(maps, suite, scene, shaders)
    for name, lit in (("composite_input", scene), ("composite_heldout", suite.other_light(scene))):
        truth = suite.image(lit, suite.spec.base)
        assert physics.relative_error(loops[name], truth) < 2e-3
    wrong = physics.closed_loop(maps.replace(albedo=0.5 * maps.require("albedo")["albedo"]), suite, scene, shaders)
    assert physics.relative_error(wrong["composite_input"], suite.image(scene, suite.spec.base)) > 0.1


def test_every_test_has_a_column(suite: Suite, tmp_path: Path) -> None:
    columns = {column.quantity for column in physics.PHYSICS_TABLE.columns}
    assert columns == set(physics.RENDERER_TESTS) | set(physics.CLOSED_LOOPS)
    assert set(physics.renderer_tests(PERFECT, suite, suite.scenes[0])) == set(physics.RENDERER_TESTS)
