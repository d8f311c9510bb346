"""The light that s and d reveal: a blurred estimate of a known light comes nearer to it by what that light does."""

import functools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender.light.ggx import facing_normal
from unirender.light.lobes import cosine_matrix, grid_lobes, lobe_matrix
from unirender.light.resampling import resample_environment
from unirender.pipelines.derived_light import derived_diffuse, derived_specular
from unirender.pipelines.revealed_light import agreeing_light, revealed_light

SHAPE = (16, 32)
OLD, WIDER = 0.4, 0.8


@functools.cache
def lamp() -> np.ndarray:
    """A dim sky with a lamp above and behind the camera."""
    directions = environment_directions(*SHAPE)
    lamp = 20 * np.exp(30 * (directions @ np.array([0.36, 0.48, 0.8]) - 1))
    return (0.3 + lamp[..., None] * np.array([1.0, 0.9, 0.7])).astype(np.float32)


def blurred(environment: np.ndarray) -> np.ndarray:
    return gaussian_filter(environment, (2, 4, 0), mode="nearest").astype(np.float32)


@functools.cache
def ball(height: int = 48, width: int = 48) -> Intrinsics:
    """A ball under that light."""
    y, x = np.mgrid[:height, :width].astype(np.float32) + 0.5
    radius = 0.45 * min(height, width)
    x, y = (x - width / 2) / radius, -(y - height / 2) / radius
    mask = (x**2 + y**2 < 1)[..., None].astype(np.float32)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1) * mask
    given = Intrinsics(normal=normal, roughness=OLD * mask, mask=mask)
    return given.replace(specular=derived_specular(given, lamp()), environment=blurred(lamp()))


def get(intrinsics: Intrinsics, name: str) -> np.ndarray:
    return intrinsics.require(name)[name]


def distance(environment: np.ndarray, roughness: float) -> float:
    """Mean distance of a light's s from the true light's."""
    given = ball().replace(roughness=roughness * get(ball(), "mask"))
    return float(np.abs(derived_specular(given, environment) - derived_specular(given, lamp())).mean())


@pytest.mark.parametrize("roughness", [OLD, WIDER])
def test_it_is_nearer_to_the_true_light_also_for_lobes_it_was_not_fitted_to(roughness: float) -> None:
    found = revealed_light(ball())
    assert found.shape == (*SHAPE, 3)
    assert found.dtype == np.float32
    assert found.min() >= 0
    assert distance(found, roughness) < 0.6 * distance(blurred(lamp()), roughness)


@pytest.mark.parametrize("camera", [Camera(), Camera(70, (0.1, 0.8))])
def test_a_light_that_explains_s_stays(camera: Camera) -> None:
    """As the camera sees it."""
    seen = ball().replace(camera=camera)
    given = seen.replace(environment=lamp(), specular=derived_specular(seen, lamp()))
    before = np.abs(blurred(lamp()) - lamp()).sum() / lamp().sum()
    assert np.abs(revealed_light(given) - lamp()).sum() / lamp().sum() < 0.1 * before


def test_what_no_lobe_sees_stays_as_predicted() -> None:
    dark = ball().replace(specular=np.zeros_like(get(ball(), "specular")))
    kept = revealed_light(dark) / get(dark, "environment")
    seen = environment_directions(*SHAPE)[..., 2]
    assert kept[seen > 0.9].max() < 0.3
    front = np.zeros_like(get(ball(), "normal"))
    front[24, 24] = (0, 0, 1)
    kept = revealed_light(dark.replace(normal=front)) / get(dark, "environment")
    assert kept[seen < 0].min() > 0.99


def test_larger_pictures_and_other_shapes_say_the_same() -> None:
    small, large = revealed_light(ball()), revealed_light(ball(150, 110))
    assert np.abs(small - large).mean() < 0.25 * np.abs(small - get(ball(), "environment")).mean()


def test_a_finer_light_keeps_its_detail_and_comes_nearer_too() -> None:
    """512 rows would be half a million texels beside each pixel: it is looked at in fewer."""
    fine = resample_environment(blurred(lamp()), (512, 1024))
    fine[200, 300] *= 3
    found = revealed_light(ball().replace(environment=fine))
    assert found.shape == fine.shape
    assert found.min() >= 0
    np.testing.assert_allclose(found[200, 300] / found[200, 301], fine[200, 300] / fine[200, 301], rtol=0.05)
    assert distance(found, WIDER) < 0.7 * distance(fine, WIDER)


def test_nothing_to_see_leaves_the_prediction() -> None:
    empty = ball().replace(mask=np.zeros_like(get(ball(), "mask")))
    assert np.array_equal(revealed_light(empty), get(empty, "environment"))


def test_lobe_matrix_times_a_light_is_its_lobes() -> None:
    rng = np.random.default_rng(0)
    view = np.tile(np.array([[0], [0], [1]], dtype=np.float32), 5)
    normal = rng.normal(size=(3, 5)).astype(np.float32) + np.array([[0], [0], [2]], dtype=np.float32)
    normal = facing_normal(normal / np.linalg.norm(normal, axis=0), view)
    alpha = np.full(5, 0.3, dtype=np.float32)
    lobes = lobe_matrix(normal, view, alpha, SHAPE)
    assert lobes.shape == (5, SHAPE[0] * SHAPE[1])
    expected = grid_lobes(normal, view, alpha, lamp(), SHAPE, tails=False)
    np.testing.assert_allclose(lobes @ lamp().reshape(-1, 3), expected, rtol=1e-4)


def dim(factor: float = 0.5) -> Intrinsics:
    """The ball lit as it is, with a predicted light that is blurred and too dark."""
    lit = ball()
    return lit.replace(
        diffuse=derived_diffuse(lit, lamp()), environment=(factor * get(lit, "environment")).astype(np.float32)
    )


def test_the_agreeing_light_lights_the_ball_as_its_s_and_d_say() -> None:
    given = dim()
    found = agreeing_light(given)
    assert found.shape == get(given, "environment").shape
    for name, of, most in (("specular", derived_specular, 0.45), ("diffuse", derived_diffuse, 0.1)):
        wanted = get(given, name)
        before, after = (np.abs(of(given, light) - wanted).sum() for light in (get(given, "environment"), found))
        assert after < most * before, name
    assert distance(found, WIDER) < 0.1 * distance(get(given, "environment"), WIDER)
    shorter = given.replace(normal=np.float32(0.7) * get(given, "normal"))  # of a normal the direction counts
    np.testing.assert_allclose(agreeing_light(shorter), found, rtol=1e-3)


def test_d_says_left_from_right_where_s_is_black() -> None:
    """A light from the left alone, predicted as one from all around, on a surface that hardly shines."""
    directions = environment_directions(*SHAPE)
    left = (np.maximum(-directions[..., :1], 0) * np.ones(3)).astype(np.float32)
    rough = ball().replace(roughness=get(ball(), "mask"), environment=np.full_like(left, left.mean()))
    given = rough.replace(specular=derived_specular(rough, left), diffuse=derived_diffuse(rough, left))
    for light, least, most in ((get(given, "environment"), -0.01, 0.01), (agreeing_light(given), 0.5, 1.0)):
        sides = [light[directions[..., 0] * side > 0].sum() for side in (-1, 1)]
        assert least < (sides[0] - sides[1]) / sum(sides) < most


def test_cosine_matrix_times_a_light_is_d() -> None:
    given = ball()
    there = get(given, "mask")[..., 0] > 0.5
    lit = cosine_matrix(get(given, "normal")[there].T, SHAPE) @ lamp().reshape(-1, 3)
    np.testing.assert_allclose(lit, derived_diffuse(given, lamp())[there], rtol=0.05, atol=0)
