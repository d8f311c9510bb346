"""`shade` against closed forms, a Mitsuba render of the same scene, and its own arguments."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes
import torch
from occluders import book, torus

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender_reference import principled
from unirender_reference.backend import mitsuba
from unirender_reference.passes import Counters, Estimate, mean_estimate
from unirender_reference.render import Renderer
from unirender_reference.shade import shade
from unirender_reference.shader import Shader, facing
from unirender_reference.shapes import MeshObject
from unirender_reference.statistics import ZTest, z_test

SIZE = 32


def maps_of(obj: MeshObject, roughness: float, metallic: float, size: int = SIZE) -> Intrinsics:
    """The true maps of an object."""
    geometry = Renderer(obj, resolution=size).geometry(256)
    mask = geometry.require("mask")["mask"]
    return geometry.replace(
        roughness=np.full_like(mask, roughness) * (mask > 0), metallic=np.full_like(mask, metallic) * (mask > 0)
    )


def maps(
    roughness: float = 0.5, metallic: float = 0.5, albedo: tuple[float, float, float] = (0.7, 0.4, 0.2)
) -> Intrinsics:
    return maps_of(scenes.sphere(albedo), roughness, metallic)


def shaded(intrinsics: Intrinsics, light: np.ndarray, geometry: MeshObject | None = None, first: int = 0) -> Estimate:
    """Mean and variance from eight seeds."""
    passes = [shade(intrinsics, light, 64, first + seed, geometry=geometry) for seed in range(8)]
    return mean_estimate(passes, 0, 8)


def compare(a: Estimate, b: Estimate, where: np.ndarray, rounding: float = 1e-3) -> ZTest:
    assert a.variance is not None
    assert b.variance is not None
    return z_test(a.mean, a.variance, b.mean[..., :3], b.variance[..., :3], where.astype(np.float32), rounding=rounding)


def wound(obj: MeshObject) -> MeshObject:
    """The object with every face counter-clockwise as seen from where its shading normals point."""
    a, b, c = np.moveaxis(obj.vertices[obj.faces], 1, 0)
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), obj.normals[obj.faces[:, 0]]) < 0
    return dataclasses.replace(obj, faces=np.where(inwards[:, None], obj.faces[:, ::-1], obj.faces))


def flat_pixels(intrinsics: Intrinsics) -> np.ndarray:
    """1 where a pixel is covered and has the same normal as its eight neighbours: what `shade` takes a pixel for."""
    normal, mask = (intrinsics.require(name)[name] for name in ("normal", "mask"))
    same = mask[..., 0] == 1
    for shift in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        same &= np.abs(np.roll(normal, shift, (0, 1)) - normal).max(-1) < 1e-4
    return same[..., None].astype(np.float32)


@pytest.mark.parametrize(("roughness", "metallic"), [(0.15, 1.0), (0.8, 0.0)])
def test_constant_light_returns_the_directional_albedo(roughness: float, metallic: float) -> None:
    """White furnace: what our own BSDF reflects of a light of 1, by quadrature."""
    intrinsics, light = maps(roughness, metallic, (1, 1, 1)), np.ones((4, 8, 3), np.float32)
    inner = intrinsics.require("mask")["mask"] == 1
    normal = intrinsics.require("normal")["normal"][inner[..., 0]]
    view = intrinsics.camera.view_directions(SIZE, SIZE)[inner[..., 0]]
    cosine = torch.from_numpy((normal * view).sum(-1)).double().clamp(0.01, 1)
    wi = torch.stack([(1 - cosine**2).sqrt(), torch.zeros_like(cosine), cosine], -1)
    one = torch.ones(1, dtype=torch.float64)
    _, weights = principled.light_quadrature(wi, one.expand(1, 3), roughness * one, metallic * one)
    expected = np.zeros((SIZE, SIZE, 3))
    expected[inner[..., 0]] = weights.sum(1).numpy()
    found = shaded(intrinsics, light)
    exact = Estimate(expected.astype(np.float32), np.zeros_like(expected, np.float32))
    result = compare(found, exact, inner)
    assert result.passed, str(result)
    twin = shaded(maps(roughness, metallic, (0.98, 0.98, 0.98)), light)
    assert not compare(twin, exact, inner).passed


@pytest.mark.slow
def test_a_convex_object_hides_nothing_from_itself() -> None:
    """With and without geometry, and the render with one bounce: the same sphere, by z-test."""
    sphere, light = scenes.sphere(), scenes.environment(peaks=0)
    intrinsics = maps(0.5, 0.5)
    inner = (intrinsics.require("normal")["normal"][..., 2:] > 0.6).astype(np.float32)
    alone, shadowed = shaded(intrinsics, light), shaded(intrinsics, light, sphere, 100)
    result = compare(alone, shadowed, intrinsics.require("mask")["mask"])
    assert result.passed, str(result)
    truth = Renderer(sphere, resolution=SIZE).image(light, 0.5, 0.5, 512, depth=2)
    result = compare(shadowed, truth, inner, rounding=2e-3)
    assert result.passed, str(result)
    assert not compare(shaded(maps(0.55, 0.5), light, sphere), truth, inner, rounding=2e-3).passed


@pytest.mark.slow
def test_flat_faces_shadow_each_other_as_in_a_render() -> None:
    """Two pages in a right angle: where a pixel has one normal, `shade` with geometry is the render with one bounce."""
    pages, light = wound(book()), scenes.environment(2)
    intrinsics = maps_of(pages, 0.4, 0.6)
    flat = flat_pixels(intrinsics)
    assert flat.sum() > 100
    truth = Renderer(pages, resolution=SIZE).image(light, 0.4, 0.6, 512, depth=2)
    result = compare(shaded(intrinsics, light, pages), truth, flat)
    assert result.passed, str(result)
    assert not compare(shaded(intrinsics, light), truth, flat).passed
    assert not compare(shaded(intrinsics, light, book("left")), truth, flat).passed


def test_geometry_brings_a_concave_object_closer_to_the_truth() -> None:
    ring, light = torus(), scenes.environment(2)
    intrinsics = maps_of(ring, 0.6, 0.2)
    covered = intrinsics.require("mask")["mask"]
    truth = Renderer(ring, resolution=SIZE).image(light, 0.6, 0.2, 256, depth=2, batches=1).mean[..., :3]
    error = {
        name: float((covered * np.square(shade(intrinsics, light, 256, geometry=obj) - truth)).sum())
        for name, obj in (("alone", None), ("shadowed", ring))
    }
    assert error["shadowed"] < 0.2 * error["alone"], error


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
    genuine, seeds = Shader.image, []

    def draw(shader: Shader, *args: Any) -> Any:
        picture = np.array(genuine(shader, *args))
        seeds.append(args[-1])
        if len(seeds) <= times:
            picture[tuple(np.argwhere(picture.any(axis=-1))[7])] = value
        return mitsuba().TensorXf(picture)

    monkeypatch.setattr(Shader, "image", draw)
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


def test_light_is_checked_even_where_nothing_is_shaded() -> None:
    intrinsics, light = maps(), np.ones((4, 8, 3), np.float32)
    nothing = intrinsics.replace(mask=np.zeros_like(intrinsics.require("mask")["mask"]))
    assert not shade(nothing, light, 16).any()
    for given in (intrinsics, nothing):
        for wrong in (-light, np.full_like(light, np.nan)):
            with pytest.raises(UnirenderError, match="NaN, infinite or negative radiance"):
                shade(given, wrong, 16)
        for wrong in (light[:2], 0 * light[:2]):
            with pytest.raises(UnirenderError, match=r"got shape \(2, 8, 3\), expected .* of at least 3 x 2"):
                shade(given, wrong, 16)


def test_normals_that_face_away_are_bent_until_they_do_not() -> None:
    rng = np.random.default_rng(0)
    normal, view = (array / np.linalg.norm(array, axis=-1, keepdims=True) for array in rng.normal(size=(2, 500, 3)))
    mi = mitsuba()
    bent = np.array(facing(mi.Vector3f(normal.T.astype(np.float32)), mi.Vector3f(view.T.astype(np.float32)))).T
    cosine, was = (bent * view).sum(-1), (normal * view).sum(-1)
    assert cosine.min() > 0.009
    np.testing.assert_allclose(bent[was > 0.02], normal[was > 0.02], atol=1e-6)


def test_missing_maps_are_named() -> None:
    with pytest.raises(UnirenderError, match="roughness, metallic missing"):
        shade(maps().replace(roughness=None, metallic=None), scenes.environment())
