"""Normals from a silhouette: a disc is a hemisphere, whatever it stands beside, wherever it stands."""

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference.optimize.single.inflate import silhouette_normals

FAR = Camera(fov_deg=2.0)  # nearly orthographic


def disc(size: int, centre: tuple[float, float], radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Its mask and the hemisphere's normals."""
    row, column = np.mgrid[:size, :size].astype(np.float32)
    x, y = (column - centre[1]) / radius, -(row - centre[0]) / radius
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    return inside[..., None].astype(np.float32), normal * inside[..., None]


def cosines(found: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.sum(found * true, axis=-1)[mask[..., 0] > 0]


def test_a_disc_becomes_a_hemisphere() -> None:
    mask, true = disc(64, (31.5, 31.5), 28)
    found = cosines(silhouette_normals(mask, FAR), true, mask)
    assert found.mean() > 0.995
    assert found.min() > 0.9
    sphere_elsewhere = disc(64, (31.5, 24.5), 28)[1]
    assert cosines(silhouette_normals(mask, FAR), sphere_elsewhere, mask).mean() < 0.98


def test_parts_are_inflated_alone_and_fill_partly_covered_pixels() -> None:
    one, left = disc(64, (31.5, 15.5), 13)
    two, right = disc(64, (31.5, 47.5), 13)
    found = silhouette_normals(one + two, FAR)
    assert cosines(found, left + right, one + two).mean() > 0.98
    soft = np.maximum(one, 0.2 * np.roll(one, 1, axis=1))
    normal = silhouette_normals(soft, FAR)
    np.testing.assert_allclose(np.linalg.norm(normal[soft[..., 0] > 0], axis=-1), 1, rtol=0, atol=1e-5)
    assert not normal[soft[..., 0] == 0].any()


def test_the_balloon_faces_the_viewer_from_the_edge_of_the_frame() -> None:
    camera = Camera(fov_deg=60.0)
    mask, _ = disc(64, (31.5, 51.5), 8)
    mean = silhouette_normals(mask, camera)[mask[..., 0] > 0].mean(axis=0)
    view = camera.view_directions(64, 64)[mask[..., 0] > 0].mean(axis=0)
    assert np.dot(mean / np.linalg.norm(mean), view / np.linalg.norm(view)) > 0.999
    assert mean[0] < -0.1  # an object on the right is seen from its left


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(UnirenderError, match="covers no pixel"):
        silhouette_normals(np.full((8, 8, 1), 0.1, np.float32), FAR)
