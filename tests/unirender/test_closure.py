"""Closing a decomposition: its rendering becomes the picture, true maps stay, clipped pixels are never made darker."""

import numpy as np
import pytest

from unirender.composite import composite_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.closure import MAX_GAIN, close_decomposition

RNG = np.random.default_rng(0)
SIZE = (6, 7)


def random_maps() -> Intrinsics:
    albedo, specular, diffuse = (RNG.uniform(0.2, 0.8, (*SIZE, 3)).astype(np.float32) for _ in range(3))
    mask = np.ones((*SIZE, 1), dtype=np.float32)
    mask[0], mask[1] = 0, 0.5
    metallic = np.full((*SIZE, 1), 0.4, dtype=np.float32)
    return Intrinsics(albedo=albedo, specular=specular, diffuse=diffuse, metallic=metallic, mask=mask)


def test_true_maps_are_a_fixed_point() -> None:
    maps = random_maps()
    closed = close_decomposition(maps, composite_image(maps), composite_image(maps))
    for name in ("albedo", "specular", "diffuse", "metallic"):
        np.testing.assert_allclose(getattr(closed, name), getattr(maps, name), atol=1e-5)


def test_the_rendering_becomes_the_picture_within_bounds() -> None:
    maps = random_maps()
    picture = composite_image(maps) * RNG.uniform(0.7, 1.4, (*SIZE, 3)).astype(np.float32)
    picture[0] = 0.7  # without coverage
    closed = close_decomposition(maps, picture, composite_image(maps))
    picture[0] = 0
    before, after = (np.abs(composite_image(x) - picture).max() for x in (maps, closed))
    assert after < 0.05
    assert before > 3 * after
    np.testing.assert_array_equal(closed.metallic, maps.metallic)
    assert closed.albedo is not None
    assert maps.albedo is not None
    np.testing.assert_array_equal(closed.albedo[0], maps.albedo[0])  # nothing is known outside the mask


def test_the_change_is_bounded_and_shared() -> None:
    maps = random_maps().replace(albedo=np.full((*SIZE, 3), 0.05, dtype=np.float32))
    closed = close_decomposition(maps, composite_image(maps) * 100, composite_image(maps))
    a, d = (getattr(closed, name)[2:] / getattr(maps, name)[2:] for name in ("albedo", "diffuse"))
    assert a.max() <= np.sqrt(MAX_GAIN) + 1e-4
    np.testing.assert_allclose(a, d, rtol=1e-4)
    light = maps.replace(albedo=np.full((*SIZE, 3), 0.9, dtype=np.float32))
    lighter = close_decomposition(light, composite_image(light) * 100, composite_image(light))
    assert lighter.require("albedo")["albedo"].max() == 1
    darkened = close_decomposition(maps, 0 * composite_image(maps), composite_image(maps))
    a, s = (getattr(darkened, name)[2:] / getattr(maps, name)[2:] for name in ("albedo", "specular"))
    assert a.min() == pytest.approx(np.sqrt(1 / MAX_GAIN), rel=1e-4)
    np.testing.assert_allclose(a, s, rtol=1e-4)


def test_a_clipped_picture_is_only_a_lower_bound() -> None:
    maps = random_maps().replace(diffuse=np.full((*SIZE, 3), 5.0, dtype=np.float32))
    clipped = np.minimum(composite_image(maps), random_maps().require("mask")["mask"])
    closed = close_decomposition(maps, clipped, composite_image(maps))
    bright = composite_image(maps) >= maps.require("mask")["mask"]
    assert bright[2:].any()
    np.testing.assert_allclose(composite_image(closed)[bright], composite_image(maps)[bright], atol=1e-5)
    near = 0.97 * maps.require("mask")["mask"] * np.ones(3, np.float32)  # below it, a channel is what it shows
    darker = close_decomposition(maps, near, composite_image(maps)).require("albedo")["albedo"]
    assert (darker < maps.require("albedo")["albedo"])[1:][bright[1:]].all()
