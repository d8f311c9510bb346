"""Repainting against Mitsuba's render of the repainted object: close, and far closer than the picture as it was."""

import numpy as np
import pytest
from lopsided_scene import ALBEDO, KEY, lopsided_object

from unirender.color import image_srgb
from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.light.symmetries import Maps
from unirender.training.augmentations.repaint import CHANNEL_RANGE, mean_colour, recoloured, repaint
from unirender_reference.render import Renderer

SIZE = 32
SPP = 1024
LEAST = 30.0  # dB (measured 31 to 39; the two cubes face each other, and their light is of the old colours)
PAINTED = np.float32(1) - ALBEDO[::-1]  # far more than training does


def buffers(renderer: Renderer, roughness: float, metallic: float, environment: np.ndarray, seed: int) -> Maps:
    geometry = renderer.geometry(1024, seed=4).require("albedo", "normal", "mask")
    inside = (geometry["mask"] > 0).astype(np.float32)
    return geometry | {
        "image": renderer.image(environment, roughness, metallic, SPP, seed).mean[..., :3],
        "diffuse": renderer.diffuse(environment, SPP, seed).mean,
        "specular": renderer.specular(environment, roughness, SPP, seed).mean,
        "roughness": inside * np.float32(roughness),
        "metallic": inside * np.float32(metallic),
    }


def psnr(a: Maps, b: Maps) -> float:
    """Masked, sRGB."""
    error = (image_srgb(a["image"]) - image_srgb(b["image"]))[a["mask"][..., 0] > 0]
    return float(-10 * np.log10(np.mean(np.square(error))))


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(lopsided_object(), resolution=SIZE)


@pytest.fixture(scope="module")
def painted() -> Renderer:
    return Renderer(lopsided_object(albedo=PAINTED), resolution=SIZE)


@pytest.mark.parametrize(
    ("roughness", "metallic"),
    [(0.2, 1.0), pytest.param(0.5, 0.0, marks=pytest.mark.long), pytest.param(0.8, 0.5, marks=pytest.mark.long)],
)
def test_repainted_is_the_render_of_the_repainted_object(
    renderer: Renderer, painted: Renderer, roughness: float, metallic: float
) -> None:
    before = buffers(renderer, roughness, metallic, KEY, seed=1)
    truth = buffers(painted, roughness, metallic, KEY, seed=2)
    repainted = repaint(before, truth["albedo"])
    np.testing.assert_array_equal(repainted["albedo"], truth["albedo"])
    close, unedited = psnr(repainted, truth), psnr(before, truth)
    assert close > LEAST, (close, unedited)
    assert unedited < LEAST - 10, unedited


def test_the_closed_form_of_a_repainted_object_is_exact() -> None:
    """What is left out is light from one part of the object to another, which it has not."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(6, 6, 3)) * (0.3, 0.3, 0) + (0, 0, 1)
    old, new = rng.uniform(0.1, 0.9, (2, 6, 6, 3)).astype(np.float32)
    maps = {name: rng.uniform(0.1, 0.9, (6, 6, 3)).astype(np.float32) for name in ("specular", "diffuse")}
    maps |= {name: rng.uniform(0.1, 0.9, (6, 6, 1)).astype(np.float32) for name in ("roughness", "metallic")}
    maps |= {"normal": (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)}
    maps |= {"mask": np.ones((6, 6, 1), np.float32)}
    before, after = (split_sum_image(Intrinsics().replace(**maps, albedo=colour)) for colour in (old, new))
    found = repaint(maps | {"image": before, "albedo": old}, new)
    np.testing.assert_allclose(found["image"], after, rtol=0, atol=2e-6)
    assert np.abs(before - after).max() > 0.1


def test_a_recoloured_object_has_the_colour() -> None:
    rng = np.random.default_rng(0)
    albedo, mask = rng.uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32), np.ones((8, 8, 1), np.float32)
    mask[:2], albedo[:2] = 0, 0
    colour = np.array([0.2, 0.5, 0.7])
    result = recoloured(albedo, mask, colour)
    np.testing.assert_allclose(mean_colour(result, mask), colour, atol=0.01)
    np.testing.assert_allclose(recoloured(albedo, mask, mean_colour(albedo, mask)), albedo, atol=1e-5)
    assert (result[:2] == 0).all()


def test_extreme_colours_stay_in_range() -> None:
    mask = np.ones((2, 2, 1), np.float32)
    for value in (0.0, 1.0):
        albedo = np.full((2, 2, 3), value, np.float32)
        np.testing.assert_allclose(mean_colour(albedo, mask), np.clip(value, *CHANNEL_RANGE), rtol=1e-5)
        result = recoloured(albedo, mask, np.array([0.0, 0.5, 1.0]))
        assert np.isfinite(result).all()
        assert result.min() >= 0
        assert result.max() <= 1
    bright = np.full((2, 2, 3), 0.9, np.float32)
    np.testing.assert_allclose(recoloured(bright, mask, np.zeros(3)), 0.9**4, rtol=1e-5)
    np.testing.assert_allclose(recoloured(0.1 + 0 * bright, mask, np.ones(3)), 0.1**0.25, rtol=1e-5)
    assert recoloured(1.2 * bright, mask, np.full(3, 0.5)).max() <= 1
    assert (mean_colour(bright, np.zeros((2, 2, 1))) == 0.5).all()  # no pixel: no colour of its own
