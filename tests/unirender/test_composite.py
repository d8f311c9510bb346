"""The closed-form image: limits, linearity, one formula for numpy and torch; the split sum against brute force.

Mitsuba judges both in tests/physics.
"""

import tracemalloc
from typing import Any

import numpy as np
import pytest
import torch

from unirender.camera import Camera
from unirender.composite import composite, composite_image, fresnel, split_sum_image
from unirender.environment_brdf import (
    TABLES,
    environment_brdf,
    environment_brdf_tables,
    integrate_environment_brdf,
    mean_fresnel,
)
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics

RNG = np.random.default_rng(0)
ALBEDO, DIFFUSE, SPECULAR = (RNG.random((4, 5, 3), dtype=np.float32) for _ in range(3))


def test_limits() -> None:
    one, zero = np.ones((4, 5, 1), dtype=np.float32), np.zeros((4, 5, 1), dtype=np.float32)
    np.testing.assert_allclose(composite(ALBEDO, one, DIFFUSE, SPECULAR), ALBEDO * SPECULAR, rtol=1e-6)
    np.testing.assert_allclose(
        composite(ALBEDO, zero, DIFFUSE, SPECULAR), ALBEDO * DIFFUSE + 0.04 * SPECULAR, rtol=1e-5
    )
    np.testing.assert_allclose(fresnel(ALBEDO, zero), 0.04, rtol=1e-6)


def test_linear_in_light_and_in_metallic() -> None:
    m = np.full((4, 5, 1), 0.3, dtype=np.float32)
    ends = [composite(ALBEDO, m * 0 + value, DIFFUSE, SPECULAR) for value in (0, 1)]
    np.testing.assert_allclose(composite(ALBEDO, m, DIFFUSE, SPECULAR), 0.7 * ends[0] + 0.3 * ends[1], atol=1e-6)
    np.testing.assert_allclose(
        composite(ALBEDO, m, 3 * DIFFUSE, 3 * SPECULAR), 3 * composite(ALBEDO, m, DIFFUSE, SPECULAR), rtol=1e-5
    )


def test_torch_and_numpy_agree() -> None:
    m = RNG.random((4, 5, 1), dtype=np.float32)
    there = composite(*(torch.from_numpy(x) for x in (ALBEDO, m, DIFFUSE, SPECULAR)))
    np.testing.assert_allclose(there.numpy(), composite(ALBEDO, m, DIFFUSE, SPECULAR), atol=1e-6)


def test_image_is_premultiplied_and_says_what_is_missing() -> None:
    mask = np.full((4, 5, 1), 0.25, dtype=np.float32)
    metallic = np.full((4, 5, 1), 0.5, dtype=np.float32)
    full = Intrinsics(albedo=ALBEDO, metallic=metallic, diffuse=DIFFUSE, specular=SPECULAR, mask=mask)
    np.testing.assert_allclose(composite_image(full), 0.25 * composite(ALBEDO, metallic, DIFFUSE, SPECULAR), rtol=1e-5)
    with pytest.raises(UnirenderError, match="maps specular, mask are missing"):
        composite_image(full.replace(specular=None, mask=None))


def lobe_integral(n_v: float, alpha: float, count: int = 600) -> tuple[float, float]:
    """A and B by the midpoint rule over light directions: none of the sampling that the table is made with."""
    theta = (np.arange(count) + 0.5) * np.pi / (2 * count)
    phi = (np.arange(count) + 0.5) * np.pi / count
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    light = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    half = light + np.array([np.sqrt(1 - n_v**2), 0, n_v])
    v_h = half[..., 2] * n_v + half[..., 0] * np.sqrt(1 - n_v**2)
    length = np.linalg.norm(half, axis=-1)
    n_h, v_h, n_l = half[..., 2] / length, v_h / length, light[..., 2]
    ggx = alpha**2 / (np.pi * (n_h**2 * (alpha**2 - 1) + 1) ** 2)
    shadowing = [2 / (1 + np.sqrt(1 + alpha**2 * (1 / np.square(c) - 1))) for c in (n_v, n_l)]
    lobe = ggx * shadowing[0] * shadowing[1] / (4 * n_v) * np.sin(theta) * (np.pi / (2 * count)) * (2 * np.pi / count)
    schlick = (1 - v_h) ** 5
    return float(np.sum(lobe * (1 - schlick))), float(np.sum(lobe * schlick))


def test_the_tables_that_ship_are_what_the_code_integrates(regenerate: bool) -> None:
    """Also to a processor whose cosines end in another digit."""
    integrated = integrate_environment_brdf()
    if regenerate:
        np.save(TABLES, integrated)
    np.testing.assert_allclose(np.stack(environment_brdf_tables()), integrated, rtol=0, atol=1e-13)
    assert np.abs(integrated.astype(np.float32) - integrated).max() > 1e-9  # single precision would not do


@pytest.mark.parametrize("n_v", [0.1, 0.62])
@pytest.mark.parametrize("roughness", [0.35, 0.77, 1.0])
def test_environment_brdf_is_the_integral_of_the_lobe(n_v: float, roughness: float) -> None:
    """Within 0.004, the table's resolution; with alpha = roughness (not its square) it is not."""
    found = [float(x) for x in environment_brdf(np.array(n_v), np.array(roughness))]
    np.testing.assert_allclose(found, lobe_integral(n_v, roughness**2), rtol=0, atol=0.004)
    if roughness < 0.9:
        assert np.abs(np.subtract(found, lobe_integral(n_v, roughness))).max() > 0.02


def test_environment_brdf_of_a_smooth_mirror_is_schlick() -> None:
    n_v = np.linspace(0.05, 1, 20, dtype=np.float32)
    a, b = environment_brdf(n_v, np.zeros_like(n_v))
    np.testing.assert_allclose(a + b, 1, rtol=0, atol=2e-3)
    np.testing.assert_allclose(b, (1 - n_v) ** 5, rtol=0, atol=2e-3)


def test_mean_fresnel_lies_between_f0_and_one_and_grows_towards_grazing() -> None:
    n_v = np.linspace(-0.2, 1, 61, dtype=np.float32)[:, None]
    for roughness in (0.0, 0.37, 1.0):
        found = mean_fresnel(np.full_like(n_v, 0.04), n_v, np.full_like(n_v, roughness))
        assert np.all(np.diff(found[n_v >= 0.1]) < 0)  # at the horizon itself a rough lobe turns a little
        assert np.all(found[n_v < 0] == found[np.argmin(np.abs(n_v))])
        assert found.min() >= 0.04 - 1e-6
        assert found.max() <= 1
        np.testing.assert_allclose(mean_fresnel(np.ones_like(n_v), n_v, np.full_like(n_v, roughness)), 1, atol=1e-6)


def facing_scene(roughness: float, metallic: float) -> Intrinsics:
    """A plane that faces the camera: normals along the view ray in the middle of the frame only."""
    single = {name: np.full((4, 5, 1), value, np.float32) for name, value in (("mask", 0.25), ("metallic", metallic))}
    return Intrinsics(
        albedo=ALBEDO,
        normal=np.broadcast_to(np.array([0, 0, 1], np.float32), (4, 5, 3)),
        roughness=np.full((4, 5, 1), roughness, np.float32),
        diffuse=DIFFUSE,
        specular=SPECULAR,
        camera=Camera(fov_deg=20),
        **single,
    )


def test_split_sum_is_the_composite_where_the_surface_faces_the_viewer_and_more_at_grazing() -> None:
    facing = facing_scene(0.5, 0.5)
    np.testing.assert_allclose(split_sum_image(facing), composite_image(facing), rtol=0, atol=1e-3)
    tilted = np.broadcast_to(np.array([np.sqrt(0.99), 0, 0.1], np.float32), (4, 5, 3))
    gain = split_sum_image(facing.replace(normal=tilted)) - composite_image(facing)
    assert gain.min() >= 0
    assert gain.max() > 0.01
    shorter = facing.replace(normal=0.5 * tilted)  # as averages are
    np.testing.assert_allclose(split_sum_image(shorter), split_sum_image(facing.replace(normal=tilted)), rtol=1e-5)


def test_split_sum_uses_the_true_view_rays() -> None:
    """A tilted plane is seen at another angle in the left and in the right column; an orthographic view has one."""
    tilted = np.broadcast_to(np.array([np.sqrt(1 - 0.09), 0, 0.3], np.float32), (4, 5, 3))
    same = {name: np.full((4, 5, 3), 0.5, np.float32) for name in ("albedo", "diffuse", "specular")}
    wide = facing_scene(0.5, 1.0).replace(normal=tilted, camera=Camera(fov_deg=60), **same)
    image = split_sum_image(wide)[2, :, 0]
    assert image[0] < image[-1] - 0.005  # the plane turns to the right: the left column's view ray is closer to n
    narrow = split_sum_image(wide.replace(camera=Camera(fov_deg=0.01)))[2, :, 0]
    np.testing.assert_allclose(narrow, narrow[0], rtol=0, atol=1e-5)


def test_split_sum_of_a_large_picture_is_that_of_its_pixels_in_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    maps: dict[str, Any] = {name: rng.random((300, 400, 3), np.float32) for name in ("albedo", "diffuse", "specular")}
    maps |= {name: rng.random((300, 400, 1), np.float32) for name in ("roughness", "metallic", "mask")}
    normal = np.broadcast_to(np.array([0.6, 0, 0.8], np.float32), (300, 400, 3))
    maps["mask"] = np.where(maps["mask"] < 0.3, 0, maps["mask"])
    large = Intrinsics(normal=normal, **maps)
    whole, needed = split_sum_image(large), peak_memory(large)
    assert not whole[maps["mask"][..., 0] == 0].any()
    monkeypatch.setattr("unirender.composite.BLOCK", 2**12)
    np.testing.assert_array_equal(split_sum_image(large), whole)
    assert peak_memory(large) < 0.5 * needed


def peak_memory(intrinsics: Intrinsics) -> int:
    """Bytes that the split sum takes."""
    tracemalloc.start()
    split_sum_image(intrinsics)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_split_sum_says_what_is_missing() -> None:
    with pytest.raises(UnirenderError, match="maps normal, roughness are missing"):
        split_sum_image(facing_scene(0.5, 0.5).replace(normal=None, roughness=None))
