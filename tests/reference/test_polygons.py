"""Polygons as triangles: concave ones are filled and not crossed, convex ones stay fans."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.polygons import fans, triangulate

Flat = Sequence[Sequence[float]]
ARROW = [(0, 0), (4, 0), (4, 4), (3, 1)]  # concave at its last corner: a fan from the first one covers the notch
DART = [(4, 0), (4, 4), (3, 1), (0, 0)]  # the same from another corner: a fan fits
COMB = [(0, 0), (6, 0), (6, 4), (5, 4), (5, 1), (3, 1), (3, 4), (2, 4), (2, 1), (1, 1), (1, 4), (0, 4)]
FRAME = [(0, 0), (5, 0), (5, 5), (0, 5), (0, 0), (1, 1), (1, 4), (4, 4), (4, 1), (1, 1)]  # a hole, by a bridge
TILT = np.linalg.qr(np.array([[1.0, 2.0, 0.5], [0.3, -1.0, 2.0], [2.0, 0.1, 1.0]]))[0]


def placed(flat: Flat) -> np.ndarray:
    return np.pad(np.array(flat, float), ((0, 0), (0, 1))) @ TILT.T * 1e-3 + [5.0, -2.0, 7.0]


def area(flat: Flat) -> float:
    """Of what a polygon encloses (the shoelace formula)."""
    x, y = np.array(flat, float).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Of triangles, in the units of `placed`; negative where they are turned against +z."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return np.cross(b - a, c - a) @ TILT[:, 2] * np.sign(np.linalg.det(TILT)) / 2e-6


@pytest.mark.parametrize("flat", [ARROW, DART, COMB, FRAME])
def test_the_triangles_of_a_concave_polygon_fill_it(flat: Flat) -> None:
    for shift in range(len(flat)):
        for turn in (1, -1):
            turned = np.roll(np.array(flat), shift, axis=0)[::turn].tolist()
            points = placed(turned)
            triangles, polygon = triangulate(points, np.array([len(flat)]))
            found = areas(points, triangles)
            assert (found * turn >= -1e-6).all()
            assert found.sum() == pytest.approx(area(turned), rel=1e-6)
            assert not polygon.any()


def test_polygons_keep_their_order_and_convex_ones_their_fans() -> None:
    hexagon = [(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3]
    points = np.concatenate([placed(flat) for flat in (hexagon, ARROW, hexagon, COMB, hexagon[:3])])
    sizes = np.array([6, 4, 6, 12, 3])
    triangles, polygon = triangulate(points, sizes)
    fan, owner = fans(sizes)
    assert polygon.tolist() == owner.tolist()
    for convex in (0, 2, 4):
        np.testing.assert_array_equal(triangles[polygon == convex], fan[owner == convex])
    first = np.cumsum(sizes) - sizes
    assert (triangles.min(axis=1) >= first[polygon]).all()
    assert (triangles.max(axis=1) < (first + sizes)[polygon]).all()


@pytest.mark.parametrize(
    "points",
    [
        placed([(0, 0), (1, 1), (1, 0), (0, 1)]),  # cuts itself
        placed([(0, 0), (1, 0), (2, 0), (1, 0), (0, 0)]),  # no area
        np.zeros((5, 3)),
        np.array([[0, 0, 0], [np.nan, 0, 0], [1, 1, 0], [np.inf, 1, 0]]),
        np.array([[0, 0, 0], [1e300, 0, 0], [1e299, 1e299, 0], [0, 1e300, 0]]),
    ],
)
def test_what_no_cut_fills_stays_a_fan(points: np.ndarray) -> None:
    triangles, _ = triangulate(points, np.array([len(points)]))
    np.testing.assert_array_equal(triangles, fans(np.array([len(points)]))[0])


def test_neighbours_that_mirror_each_other_are_two_polygons() -> None:
    """Roof and its mirror image: they differ in two signs alone, and each begins as written."""
    roof = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.225), (0, 1, 0.225)])
    points = np.concatenate([roof, (roof * [1, 1, -1])[::-1]])
    sizes = np.array([4, 4])
    np.testing.assert_array_equal(triangulate(points, sizes)[0], fans(sizes)[0])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.2, 2.0), min_size=4, max_size=12), st.integers(0, 11))
def test_stars_of_any_radii_are_filled(radii: list[float], start: int) -> None:
    angles = np.arange(len(radii)) * 2 * np.pi / len(radii)
    corners = np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.array(radii)[:, None]
    flat = np.roll(corners, start, axis=0).tolist()
    points = placed(flat)
    found = areas(points, triangulate(points, np.array([len(flat)]))[0])
    assert np.abs(found).sum() == pytest.approx(area(flat), rel=5e-3)


@pytest.mark.parametrize("corners", [4, 5, 9])
def test_many_polygons_are_cut_as_each_is_alone(corners: int) -> None:
    """Those of one size together: 100,000 arrows one by one took a minute. Some cut themselves, some are in twice."""
    rng = np.random.default_rng(corners)
    angles = np.sort(rng.uniform(0, 2 * np.pi, (60, corners)), axis=1)
    radii = rng.uniform(0.1, 1, (60, corners))
    rings = np.stack([radii * np.cos(angles), radii * np.sin(angles), 0.01 * radii], axis=2)
    rings[::9] = rng.normal(size=rings[::9].shape)
    rings[1::9] = rings[::9][: len(rings[1::9]), ::-1]
    together, polygon = triangulate(rings.reshape(-1, 3), np.full(60, corners))
    assert not np.array_equal(together, fans(np.full(60, corners))[0])
    for p in np.setdiff1d(np.arange(60), np.arange(1, 60, 9)):  # the second of a pair begins as the first does
        alone, _ = triangulate(rings[p], np.array([corners]))
        np.testing.assert_array_equal(together[polygon == p], alone + p * corners)


def test_many_small_notches_count_together():
    """Each of them alone is below what is taken for rounding; the fan covered three times the polygon."""
    angles = np.arange(8000) * 2 * np.pi / 8000
    radii = np.where(np.arange(8000) // 2 % 2, 1.0, 0.998)
    points = placed((np.stack([np.cos(angles), np.sin(angles)], axis=1) * radii[:, None]).tolist())
    found = areas(points, triangulate(points, np.array([8000]))[0])
    assert found.sum() == pytest.approx(np.abs(found).sum(), rel=1e-9)


def test_an_obj_with_a_notch_has_the_area_that_it_draws(tmp_path: Path) -> None:
    lines = [*(f"v {x} {y} 0" for x, y in COMB), "f 2 3 4 5 6 7 8 9 10 11 12 1"]
    (tmp_path / "comb.obj").write_text("\n".join(lines))
    obj = load_mesh(tmp_path / "comb.obj")
    a, b, c = np.moveaxis(obj.vertices[obj.faces], 1, 0)
    scale = np.ptp(obj.vertices[:, 0]) / 6
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / scale**2 == pytest.approx(area(COMB), rel=1e-5)
