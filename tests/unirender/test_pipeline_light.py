"""Derived s and d of large pictures: the interpolated light against the light of every pixel, and what it costs."""

import functools
from typing import Any

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender.light.surface_light import diffuse_light, specular_light
from unirender.pipelines import derived_light
from unirender.pipelines.derived_light import COARSE_ROWS, LIGHT_SIDE, derived_diffuse, derived_specular
from unirender.pipelines.editing import specular_for_roughness, specular_share, trust, under_light
from unirender.pipelines.framing import Frame
from unirender.pipelines.rendered_maps import ready_to_render
from unirender.pipelines.revealed_light import agreeing_light
from unirender.pipelines.shadowed_light import visible_shares

CAMERA = Camera(fov_deg=50.0, principal=(0.35, 0.6))
TOLERANCE = 0.03  # of the light's mean


def surface(height: int, width: int, roughness: float = 0.5) -> Intrinsics:
    """A ball with its mask, beside the middle of the frame."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    radius = 0.3 * min(height, width)
    x, y = (x - 0.4 * width) / radius, -(y - 0.5 * height) / radius
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    mask = (x**2 + y**2 < 1)[..., None].astype(np.float32)
    normal = np.stack([x, y, z], axis=-1) * mask
    return Intrinsics(normal=normal, roughness=roughness * mask, mask=mask, camera=CAMERA)


@functools.cache
def light(rows: int) -> np.ndarray:
    """A lopsided sky with a lamp."""
    directions = environment_directions(rows, 2 * rows)
    lamp = np.exp(20 * (directions @ np.array([0.6, 0.48, 0.64]) - 1))
    sky = 0.5 + 0.4 * directions @ np.array([0.8, 0.6, 0.0])
    return (sky[..., None] * np.array([0.6, 0.8, 1.0]) + 4 * lamp[..., None]).astype(np.float32)


def slice_of(given: Intrinsics) -> Intrinsics:
    """The middle rows of the ball, so that a test of every pixel is quick."""
    mask = given.require("mask")["mask"].copy()
    middle = given.height // 2
    mask[: middle - 8] = mask[middle + 8 :] = 0
    return given.replace(**{name: value * mask for name, value in given.maps.items()})


def every_pixel(given: Intrinsics, environment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s and d, each pixel lit by itself."""
    maps = given.require("normal", "roughness")
    s = specular_light(maps["normal"], maps["roughness"], environment, given.camera)
    return s, diffuse_light(maps["normal"], environment)


def interior(given: Intrinsics) -> np.ndarray:
    """The ball without its rim, where the normal turns fastest."""
    return given.require("normal")["normal"][..., 2] > 0.3


@pytest.mark.parametrize("size", [(120, LIGHT_SIDE), (LIGHT_SIDE, 80)])
def test_small_pictures_have_the_light_of_every_pixel(size: tuple[int, int]) -> None:
    given, environment = surface(*size), light(16)
    s, d = every_pixel(given, environment)
    assert np.array_equal(derived_specular(given, environment), s)
    assert np.array_equal(derived_diffuse(given, environment), d)


def test_large_pictures_have_nearly_the_light_of_every_pixel() -> None:
    given, environment = surface(300, 220), light(16)
    inside = interior(given)
    s, d = every_pixel(given, environment)
    derived = derived_specular(given, environment), derived_diffuse(given, environment)
    for value, exact in zip(derived, (s, d), strict=True):
        assert np.abs(value - exact)[inside].max() < TOLERANCE * exact[inside].mean()
        assert not np.array_equal(value, exact)
        assert not value[given.require("mask")["mask"][..., 0] == 0].any()
        assert value.dtype == np.float32
    # the twin: the view directions of another camera are told apart
    wrong = derived_specular(given.replace(camera=Camera()), environment)
    assert np.abs(wrong - s)[inside].max() > 2 * TOLERANCE * s[inside].mean()


def test_a_light_too_small_is_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    given, environment = surface(240, 300), light(16)
    inside = interior(given)
    s, _ = every_pixel(given, environment)
    monkeypatch.setattr(derived_light, "LIGHT_SIDE", 24)
    monkeypatch.setattr(derived_light, "NORMAL_DETAIL", 2.0)
    assert np.abs(derived_specular(given, environment) - s)[inside].max() > TOLERANCE * s[inside].mean()


def test_the_cost_is_bounded_by_the_small_size(monkeypatch: pytest.MonkeyPatch) -> None:
    lit: list[int] = []

    def counted(*arguments: Any) -> np.ndarray:
        s = specular_light(*arguments)
        lit.append(int(np.any(s != 0, axis=-1).sum()))
        return s

    monkeypatch.setattr(derived_light, "specular_light", counted)
    given = surface(560, 700)
    derived_specular(given, light(16))
    pixels = int(given.require("mask")["mask"].sum())
    share = (LIGHT_SIDE / Frame.reduced(given.require("mask")["mask"], LIGHT_SIDE).side) ** 2
    assert lit[0] == pytest.approx(share * pixels, rel=0.05)
    assert sum(lit[1:]) < 0.1 * pixels  # the rim, whose normals the small size does not show


def test_detail_of_the_surface_is_lit_by_itself() -> None:
    given, environment = surface(300, 300), light(16)
    maps = given.require("normal", "roughness")
    rng, patch = np.random.default_rng(0), (slice(140, 160), slice(110, 130))
    normal, roughness = maps["normal"].copy(), maps["roughness"].copy()
    normal[patch] += rng.normal(0, 0.3, (20, 20, 3)).astype(np.float32)
    normal[patch] /= np.linalg.norm(normal[patch], axis=-1, keepdims=True)
    roughness[190:200, 110:130] = rng.choice([0.3, 0.6], (10, 20, 1))
    detailed = given.replace(normal=normal, roughness=roughness)
    s, d = every_pixel(detailed, environment)
    derived = derived_specular(detailed, environment), derived_diffuse(detailed, environment)
    for value, exact in zip(derived, (s, d), strict=True):
        same = np.all(np.isclose(value, exact, rtol=1e-5, atol=0), axis=-1)
        assert same[patch].mean() > 0.95
        assert same[interior(detailed)].mean() < 0.3  # elsewhere it is interpolated
        error = np.abs(value - exact)[interior(detailed)] / exact[interior(detailed)].mean()
        assert (error > TOLERANCE).mean() < 0.005  # beside the patch
    assert np.isclose(derived[0], s, rtol=1e-5, atol=0)[190:200, 110:130].mean() > 0.95
    assert (derived[1] == d)[190:200, 110:130].mean() < 0.1  # d knows no roughness


def test_mirrors_are_lit_pixel_by_pixel_under_a_light_with_detail(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    mirror = slice_of(surface(280, 280, roughness=0.05))
    inside = interior(mirror)
    fine, coarse = (every_pixel(mirror, light(rows))[0][inside] for rows in (2 * COARSE_ROWS, 16))
    mask, environment = mirror.require("mask")["mask"], light(2 * COARSE_ROWS)
    lit = mirror.replace(environment=environment, metallic=mask, diffuse=mask.repeat(3, axis=-1))
    assert np.array_equal(ready_to_render(lit, shadows=False).require("specular")["specular"][inside], fine)
    assert not np.array_equal(derived_specular(mirror, environment, mirrors=False)[inside], fine)
    assert not np.array_equal(derived_specular(mirror, light(16))[inside], coarse)
    assert not caplog.records
    monkeypatch.setattr(derived_light, "MANY_PIXELS", 1000)
    under_light(mirror, environment, "keep")
    assert "one by one" in caplog.text


def test_edits_relighting_and_rendering_use_it() -> None:
    given, environment = slice_of(surface(280, 340, roughness=0.6)), light(16)
    mask = given.require("mask")["mask"]
    s, d = derived_specular(given, environment), derived_diffuse(given, environment)
    relit = under_light(given, environment, "keep").require("specular", "diffuse")
    lit = given.replace(environment=environment, metallic=mask)
    ready = ready_to_render(lit, shadows=False).require("specular", "diffuse")
    for maps in (relit, ready):
        assert np.array_equal(maps["specular"], s)
        assert np.array_equal(maps["diffuse"], d)
    shares = visible_shares(given, environment)
    shadowed = under_light(given, environment, "keep", shadows=True).require("specular", "diffuse")
    assert lit.albedo is None  # nothing is known of what the surface reflects
    for maps in (shadowed, ready_to_render(lit).require("specular", "diffuse")):
        np.testing.assert_allclose(maps["specular"], s * shares["specular"], rtol=1e-6)
        np.testing.assert_allclose(maps["diffuse"], d * shares["diffuse"], rtol=1e-6)
    paint = {"albedo": np.full(s.shape, 0.5, dtype=np.float32), "metallic": 0.5 * mask}
    before = given.replace(environment=environment, specular=s, diffuse=d, **paint)
    edited, held = specular_for_roughness(before, 0.4 * mask)
    old, new = (every_pixel(given.replace(roughness=r * mask), environment)[0] for r in (0.6, 0.4))
    inside = interior(given)
    assert held == 0
    expected = old * ((new + 0.02) / (old + 0.02)) ** trust(0.6 * mask, 0.4 * mask, specular_share(before))
    np.testing.assert_allclose(edited[inside], expected[inside], rtol=2 * TOLERANCE)
    assert not np.allclose(edited[inside], old[inside], rtol=4 * TOLERANCE)  # the twin: something changes
    same, _ = specular_for_roughness(before, given.require("roughness")["roughness"])
    np.testing.assert_allclose(same, before.require("specular")["specular"], rtol=1e-5)


def test_of_a_normal_the_direction_counts() -> None:
    """Resampled and averaged normals are shorter than 1, each by another factor."""
    given = surface(40, 48, roughness=0.2)
    normal, mask = given.require("normal", "mask").values()
    lengths = np.random.default_rng(0).uniform(0.3, 1, mask.shape).astype(np.float32)
    short = given.replace(normal=normal * lengths)
    everything = {"albedo": np.repeat(0.5 * mask, 3, -1), "metallic": 0.3 * mask, "environment": light(16)}
    whole, halved = (ready_to_render(maps.replace(**everything)) for maps in (given, short))
    for name in ("normal", "specular", "diffuse"):
        np.testing.assert_allclose(getattr(halved, name), getattr(whole, name), rtol=1e-3, atol=1e-3, err_msg=name)
    np.testing.assert_allclose(
        split_sum_image(halved.replace(normal=short.normal)), split_sum_image(whole), rtol=1e-3, atol=1e-3
    )
    np.testing.assert_allclose(agreeing_light(halved.replace(normal=short.normal)), agreeing_light(whole), rtol=1e-3)
    for lit, same in zip(every_pixel(short, light(16)), every_pixel(given, light(16)), strict=True):
        np.testing.assert_allclose(lit, same, rtol=1e-3, atol=1e-3)
