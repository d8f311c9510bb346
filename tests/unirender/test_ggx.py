"""The GGX lobe's pieces: frames, normals that face the viewer, shadowing, and visible normals against their density."""

import numpy as np
import pytest
from environments import random_directions

from unirender.light.ggx import dot, facing_normal, halton, mirror_direction, smith_g1, tangents, visible_normals


def directions(count: int) -> np.ndarray:
    return np.ascontiguousarray(random_directions(count).T.astype(np.float32))


def test_every_normal_has_a_right_handed_frame() -> None:
    n = np.concatenate([directions(200), np.array([[0, 0, 0], [0, 0, 1], [1, -1, 0]], np.float32)], axis=1)
    t, b = tangents(n)
    for one, other, cosine in ((t, t, 1), (b, b, 1), (t, b, 0), (t, n, 0), (b, n, 0)):
        np.testing.assert_allclose(dot(one, other), cosine, atol=1e-5)
    np.testing.assert_allclose(np.cross(t, b, axis=0), n, atol=1e-5)


def test_normals_that_point_away_are_bent_to_graze_the_view_ray() -> None:
    """In the plane of both; others stay as they are."""
    n, v = directions(500), directions(501)[:, 1:]
    facing, cosine = facing_normal(n, v), dot(n, v)
    away = cosine < 0
    np.testing.assert_allclose(facing[:, cosine > 0.02], n[:, cosine > 0.02], atol=1e-6)
    grazing = dot(facing, v)[away]
    assert (grazing > 0).all()
    straight = np.abs(cosine[away]) < 0.99  # of those that point straight away no plane is left
    assert (grazing[straight] < 0.1).all()
    np.testing.assert_allclose(dot(np.cross(n, v, axis=0), facing)[away], 0, atol=1e-5)
    np.testing.assert_allclose(dot(facing, facing), 1, atol=1e-5)


def test_a_mirror_direction_has_the_normal_half_way() -> None:
    n, v = directions(100), directions(101)[:, 1:]
    light = mirror_direction(n, v)
    np.testing.assert_allclose(dot(light, n), dot(v, n), atol=1e-5)
    np.testing.assert_allclose(np.cross(light + v, n, axis=0), 0, atol=1e-5)


def test_nothing_below_the_horizon_is_seen_and_all_is_from_ahead() -> None:
    cosine = np.array([-1.0, -0.2, 0.0, 1.0], np.float32)
    for alpha in (0.05, 0.5, 1.0):
        np.testing.assert_allclose(smith_g1(cosine, np.array(alpha)), [0, 0, 0, 1], atol=1e-6)


def test_points_are_spread_evenly_whichever_two_coordinates_are_taken() -> None:
    points = np.stack(halton(64))
    assert points.min() >= 0
    assert points.max() < 1
    np.testing.assert_allclose(points.mean(axis=1), 0.5, atol=0.03)
    assert np.abs(np.corrcoef(points) - np.eye(4)).max() < 0.2


@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_visible_normals_have_their_density(alpha: float, slope: float) -> None:
    """D_v(h) = G1(v) D(h) v.h / n.v, integrated over a grid: it sums to 1, and the samples have its mean direction."""
    view = np.array([0.8 * slope, 0.6 * slope, 1], np.float32) / np.sqrt(np.float32(1 + slope**2))
    u1, u2, *_ = halton(1 << 12)
    h = visible_normals(np.repeat(view[:, None], len(u1), axis=1), np.full(len(u1), alpha, np.float32), u1, u2)
    theta, phi = np.meshgrid((np.arange(1000) + 0.5) / 1000 * np.pi / 2, (np.arange(200) + 0.5) / 200 * 2 * np.pi)
    grid = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    d = alpha**2 / (np.pi * (grid[2] ** 2 * (alpha**2 - 1) + 1) ** 2)
    seen = np.maximum(np.einsum("i,ijk->jk", view, grid), 0)
    density = (
        smith_g1(view[2:], np.array(alpha)) * d * seen / view[2] * np.sin(theta) * (np.pi / 2 / 1000 * 2 * np.pi / 200)
    )
    assert density.sum() == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(dot(h, h), 1, atol=1e-5)
    np.testing.assert_allclose(h.mean(axis=1), (density * grid).sum(axis=(1, 2)), atol=2e-3)
    np.testing.assert_allclose((h * h).mean(axis=1), (density * grid * grid).sum(axis=(1, 2)), atol=2e-3)
