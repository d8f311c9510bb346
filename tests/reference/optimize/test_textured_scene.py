"""The scene of all views: against the reference's renderer, seeds, sizes, and its errors."""

import dataclasses
import gc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import refine_problems as problems

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference import shader
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.refine import scene as refined
from unirender_reference.optimize.refine.config import Space
from unirender_reference.optimize.refine.parameters import LIMITS, NAMES, Name, parameter_gradient, to_map, to_parameter
from unirender_reference.optimize.refine.scene import TexturedScene, maps_of
from unirender_reference.passes import NAN_ATTEMPTS
from unirender_reference.render import Renderer
from unirender_reference.statistics import z_test

COUNT = 3


@pytest.fixture(scope="module")
def scene() -> TexturedScene:
    return TexturedScene(problems.solution(), problems.blank_views(COUNT))


def test_every_view_is_the_reference_picture(scene: TexturedScene) -> None:
    truth = problems.solution()
    maps = maps_of(truth)
    batches = np.stack([scene.image(maps, 256, seed) for seed in range(8)]).astype(np.float64)
    mean, variance = batches.mean(0), batches.var(0, ddof=1) / len(batches)
    renderer = Renderer(truth.obj, Camera(), problems.SIDE)
    for index, view in enumerate(problems.blank_views(COUNT)):
        expected = renderer.image(truth.environment, None, None, 2048, seed=50 + index, pose=view.pose)
        assert expected.variance is not None
        inside = (expected.mean[..., 3:] > 0.99).astype(np.float32)
        shown = (mean[index, ..., :3], variance[index, ..., :3])
        test = z_test(*shown, expected.mean[..., :3], expected.variance[..., :3], inside)
        assert test.passed, f"view {index}: {test}"
        other = z_test(mean[index - 1, ..., :3], shown[1], expected.mean[..., :3], expected.variance[..., :3])
        assert not other.passed, f"the picture of another view passes, too: {other}"


def test_seeds_and_names(scene: TexturedScene) -> None:
    maps = maps_of(problems.solution())
    first = scene.image(maps, 4, 1)
    assert first.shape == (COUNT, problems.SIDE, problems.SIDE, 4)
    np.testing.assert_allclose(scene.image(maps, 4, 1), first, atol=1e-5)
    assert np.abs(scene.image(maps, 4, 2) - first).max() > 0.01
    darker = scene.image({"environment": 0.5 * maps["environment"]}, 4, 1)
    np.testing.assert_allclose(darker[..., :3], 0.5 * first[..., :3], rtol=1e-3, atol=1e-5)
    with pytest.raises(UnirenderError, match="got a map 'normal'"):
        scene.image({"normal": maps["albedo"]}, 4, 1)


def test_gradients_have_the_shapes_of_their_maps_and_end_where_the_light_ends(scene: TexturedScene) -> None:
    maps = maps_of(problems.solution())
    weight = np.ones((COUNT, problems.SIDE, problems.SIDE, 3), np.float32)
    found = scene.gradients(maps, weight, 16, 0)
    assert {name: value.shape for name, value in found.items()} == {name: maps[name].shape for name in NAMES}
    # The picture is linear in the light: the derivative along the light is the picture's sum.
    image = scene.image(maps, 64, 1)[..., :3]
    along = float((found["environment"].astype(np.float64) * maps["environment"]).sum())
    assert along == pytest.approx(float(image.sum(dtype=np.float64)), rel=0.03)
    assert 0.9 * along != pytest.approx(float(image.sum(dtype=np.float64)), rel=0.03)


def test_a_wrong_image_gradient_is_refused(scene: TexturedScene) -> None:
    maps = maps_of(problems.solution())
    weight = np.ones((COUNT, problems.SIDE, problems.SIDE, 3), np.float32)
    for wrong in (weight[:2], weight * np.nan):
        with pytest.raises(UnirenderError, match="expected finite"):
            scene.gradients(maps, wrong, 4, 0)


@pytest.mark.parametrize("poisoned", [1, NAN_ATTEMPTS + 1])
def test_derivatives_that_come_out_nan_are_drawn_again(
    poisoned: int, scene: TexturedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where those of one map alone do, be it of the last."""
    maps, genuine, drawn = maps_of(problems.solution()), shader.gradient, []
    weight = np.ones((COUNT, problems.SIDE, problems.SIDE, 3), np.float32)

    def gradient(tensor: Any) -> np.ndarray:
        drawn.append(tensor)
        last = len(drawn) % len(NAMES) == 0 and len(drawn) <= poisoned * len(NAMES)
        return genuine(tensor) * np.float32(np.nan if last else 1)

    monkeypatch.setattr(refined, "gradient", gradient)
    if poisoned > NAN_ATTEMPTS:
        with pytest.raises(UnirenderError, match=f"derivatives stay NaN after {NAN_ATTEMPTS} seeds"):
            scene.gradients(maps, weight, 4, 0)
    else:
        assert all(np.isfinite(value).all() for value in scene.gradients(maps, weight, 4, 0).values())
    assert len(drawn) == min(poisoned + 1, NAN_ATTEMPTS + 1) * len(NAMES)


def test_another_iteration_compiles_nothing(scene: TexturedScene) -> None:
    import drjit as dr

    mi = mitsuba()
    maps = maps_of(problems.solution())
    weight = np.ones((COUNT, problems.SIDE, problems.SIDE, 3), np.float32)

    def iteration(seed: int) -> None:
        scene.image(maps, 16, seed)
        scene.gradients(maps, weight, 16, seed + 1)

    def compiled(work: Callable[[], Any]) -> int:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            work()
            kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
        return sum(not kernel["cache_hit"] for kernel in kernels)

    # A scene of another test, freed on the way, changes the table of shapes and with it the code of kernels: it may
    # take several iterations until all are gone. A number that stands in a kernel makes a new one at every iteration.
    gc.collect()
    iteration(10)
    counts = [compiled(lambda seed=seed: iteration(seed)) for seed in (20, 30, 40)]
    assert 0 in counts, f"kernels compiled by three iterations: {counts}"
    literal = float(np.random.default_rng().random())  # the twin: a number that stands in the kernel makes a new one
    assert compiled(lambda: dr.eval(dr.arange(mi.Float, 8) * literal)) == 1


def test_an_objects_normal_map_is_shown() -> None:
    truth = problems.solution()
    tilted = np.zeros((4, 4, 3), np.float32)
    tilted[..., 0], tilted[..., 2] = 0.6, 0.8
    bumped = dataclasses.replace(truth, obj=dataclasses.replace(truth.obj, normal_map=tilted))
    views = problems.blank_views(1)
    plain, seen = (TexturedScene(s, views).image(maps_of(s), 64, 0) for s in (truth, bumped))
    expected = Renderer(bumped.obj, Camera(), problems.SIDE).image(
        truth.environment, None, None, 512, pose=views[0].pose
    )
    assert np.abs(seen[0] - expected.mean).mean() < 0.5 * np.abs(plain[0] - expected.mean).mean()


@pytest.mark.parametrize("name", NAMES)
def test_parameters_are_inverted_and_differentiated(name: Name) -> None:
    rng, channels = np.random.default_rng(0), 1 if name in ("roughness", "metallic") else 3
    values = rng.uniform(0.1, 0.9, (4, 6, channels)).astype(np.float32)
    spaces: tuple[Space, ...] = ("perceptual", "linear")
    for space in spaces:
        parameter = to_parameter(name, values, space)
        np.testing.assert_allclose(to_map(name, parameter, space), values, rtol=1e-5)
        step = 1e-3
        central = (to_map(name, parameter + step, space) - to_map(name, parameter - step, space)) / (2 * step)
        slope = parameter_gradient(name, parameter, np.ones_like(values), space)
        np.testing.assert_allclose(slope, central, rtol=5e-3)
    far = to_map(name, to_parameter(name, 1e9 * values, "perceptual"), "perceptual")
    np.testing.assert_allclose(far, LIMITS[name][1], rtol=1e-4)
