"""`shade` against closed forms, a Mitsuba render of the same scene, and its own arguments."""

from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.lighting import environment_directions
from unirender_reference import shade as shading
from unirender_reference.passes import Counters
from unirender_reference.render import Renderer
from unirender_reference.shade import facing_normals, shade

SIZE = 32


def maps(
    roughness: float = 0.5, metallic: float = 0.5, albedo: tuple[float, float, float] = (0.7, 0.4, 0.2)
) -> Intrinsics:
    geometry = Renderer(scenes.sphere(albedo), resolution=SIZE).geometry(64)
    mask = geometry.require("mask")["mask"]
    return geometry.replace(
        roughness=np.full_like(mask, roughness) * (mask > 0), metallic=np.full_like(mask, metallic) * (mask > 0)
    )


def relative(a: np.ndarray, b: np.ndarray, inside: np.ndarray) -> float:
    return float(np.abs(a[inside].mean(axis=0) / b[inside].mean(axis=0) - 1).max())


@pytest.mark.parametrize(("roughness", "metallic"), [(0.25, 0.5), (0.6, 0.0), (0.9, 1.0)])
def test_shaded_sphere_is_the_rendered_sphere(roughness: float, metallic: float) -> None:
    """A convex object has neither shadows nor interreflection: away from the edge both are one number per pixel."""
    light = scenes.environment(peaks=0)
    truth = Renderer(scenes.sphere(), resolution=SIZE).image(light, roughness, metallic, 256, batches=1).mean[..., :3]
    intrinsics = maps(roughness, metallic)
    inner = intrinsics.require("normal")["normal"][..., 2] > 0.5
    shaded = shade(intrinsics, light, 256)
    assert relative(shaded, truth, inner) < 0.01
    assert np.abs(shaded - truth)[inner].mean() < 0.03 * truth[inner].mean()
    twin = shade(maps(min(1, roughness * 1.5), abs(metallic - 0.3)), light, 256)
    assert np.abs(twin - truth)[inner].mean() > 0.03 * truth[inner].mean()


def test_white_mirror_reflects_a_constant_light_fully() -> None:
    intrinsics = maps(0.0, 1.0, (1, 1, 1))
    image = shade(intrinsics, np.full((8, 16, 3), 0.5, np.float32), 16)
    full = intrinsics.require("mask")["mask"][..., 0] == 1
    assert abs(image[full].mean() - 0.5) < 1e-3
    np.testing.assert_allclose(image[full], 0.5, atol=0.06)  # grazing pixels are noisy: 16 samples


def test_sharp_mirror_shows_the_light_in_the_reflected_direction() -> None:
    """One bright texel behind the camera's left shoulder is mirrored where the normal halves view and light."""
    light = np.full((33, 64, 3), 1e-3, np.float32)
    light[10, 40] = 100
    direction = environment_directions(33, 64)[10, 40]
    image = shade(maps(0.1, 1.0, (1, 1, 1)), light, 64)
    row, column = np.unravel_index(image.sum(-1).argmax(), (SIZE, SIZE))
    view = Camera().view_directions(SIZE, SIZE)[row, column]
    half = (view + direction) / np.linalg.norm(view + direction)
    assert half @ maps().require("normal")["normal"][row, column] > np.cos(np.radians(4))


def test_equal_seeds_give_equal_images() -> None:
    light, intrinsics = scenes.environment(), maps()
    assert np.array_equal(shade(intrinsics, light, 16, 3), shade(intrinsics, light, 16, 3))
    assert not np.array_equal(shade(intrinsics, light, 16, 3), shade(intrinsics, light, 16, 4))


def spoil(monkeypatch: pytest.MonkeyPatch, times: int, value: float) -> list[int]:
    """The first `times` passes of `shade` get `value` in point 7; returns the seeds of all passes, as they come."""
    genuine, seeds = shading._pass, []

    def draw(*args: Any) -> np.ndarray:
        points = genuine(*args)
        seeds.append(args[-1])
        if len(seeds) <= times:
            points[7, 1] = value
        return points

    monkeypatch.setattr(shading, "_pass", draw)
    return seeds


@pytest.mark.parametrize(("times", "value"), [(1, np.nan), (3, np.inf)])
def test_points_that_come_out_nan_are_shaded_again(monkeypatch: pytest.MonkeyPatch, times: int, value: float) -> None:
    light, intrinsics, counters = scenes.environment(), maps().replace(mask=None), Counters()
    clean = shade(intrinsics, light, 16)
    seeds = spoil(monkeypatch, times, value)
    repaired = shade(intrinsics, light, 16, counters=counters)
    assert counters.nan_pixels == 1
    assert len(set(seeds)) == times + 1
    differs = np.argwhere((clean != repaired).any(axis=-1))
    inside = np.argwhere(np.any(intrinsics.require("normal")["normal"] != 0, axis=-1))
    assert differs.tolist() == [inside[7].tolist()]
    assert np.isfinite(repaired).all()


def test_points_that_stay_nan_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    spoil(monkeypatch, 100, np.nan)
    with pytest.raises(UnirenderError, match="shade: 1 pixels stay NaN after 8 seeds"):
        shade(maps(), scenes.environment(), 16)


def test_image_is_premultiplied() -> None:
    intrinsics, light = maps(), scenes.environment()
    mask = intrinsics.require("mask")["mask"]
    np.testing.assert_allclose(
        shade(intrinsics, light, 16), shade(intrinsics.replace(mask=None), light, 16) * mask, rtol=1e-6
    )


def test_own_environment_is_the_default_and_black_light_is_black() -> None:
    intrinsics = maps().replace(environment=scenes.environment())
    assert np.array_equal(shade(intrinsics, spp=16), shade(intrinsics, scenes.environment(), 16))
    assert not shade(intrinsics, np.zeros((4, 8, 3), np.float32), 16).any()


def test_normals_that_face_away_are_bent_until_they_do_not() -> None:
    rng = np.random.default_rng(0)
    normal, view = (array / np.linalg.norm(array, axis=-1, keepdims=True) for array in rng.normal(size=(2, 500, 3)))
    bent = facing_normals(normal.astype(np.float32), view.astype(np.float32))
    cosine, was = (bent * view).sum(-1), (normal * view).sum(-1)
    assert cosine.min() > 0.009
    np.testing.assert_allclose(bent[was > 0.02], normal[was > 0.02], atol=1e-6)


def test_missing_maps_are_named() -> None:
    with pytest.raises(UnirenderError, match="roughness, metallic missing"):
        shade(maps().replace(roughness=None, metallic=None), scenes.environment())
