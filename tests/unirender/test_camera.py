"""The pinhole camera: its axes, its principal point and the framing of a sphere."""

import math

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.errors import UnirenderError


def test_rays_are_unit_and_look_along_minus_z() -> None:
    rays = Camera().rays(6, 8)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=0, atol=1e-6)
    assert (rays[..., 2] < 0).all()
    assert rays[0, 0, 0] < 0 < rays[0, -1, 0]  # +x right
    assert rays[-1, 0, 1] < 0 < rays[0, 0, 1]  # +y up
    np.testing.assert_array_equal(Camera().view_directions(6, 8), -rays)


def test_vertical_field_of_view_reaches_the_upper_edge() -> None:
    camera = Camera(fov_deg=50)
    top = camera.rays(101, 11)[:, 5]
    pixel = 2 * math.tan(math.radians(25)) / 101
    edge = top[0, 1] / -top[0, 2] + pixel / 2
    assert math.degrees(2 * math.atan(edge)) == pytest.approx(50, abs=1e-4)


def test_principal_point_moves_the_axis() -> None:
    rays = Camera(principal=(0.25, 0.75)).rays(40, 40)
    row, column = np.unravel_index(np.argmin(rays[..., 2]), (40, 40))
    assert abs((column + 0.5) / 40 - 0.25) <= 0.5 / 40 + 1e-9
    assert abs((row + 0.5) / 40 - 0.75) <= 0.5 / 40 + 1e-9


@pytest.mark.parametrize(("fov", "fill"), [(36, 0.9), (60, 0.5), (20, 1.0)])
def test_sphere_fills_the_stated_share_of_the_frame(fov: float, fill: float) -> None:
    """Brute force: share of a dense column of rays that hits the sphere."""
    camera = Camera(fov_deg=fov)
    distance = camera.distance(radius=1.3, fill=fill)
    rays = camera.rays(20001, 1)[:, 0].astype(np.float64)
    sine = np.sqrt(np.square(rays[:, 0]) + np.square(rays[:, 1]))
    assert np.mean(sine * distance <= 1.3) == pytest.approx(fill, abs=2e-4)


@pytest.mark.parametrize("fov", [0.0, 180.0, -5.0, math.nan])
def test_impossible_field_of_view(fov: float) -> None:
    with pytest.raises(UnirenderError, match="field of view"):
        Camera(fov_deg=fov)


@pytest.mark.parametrize("camera", [Camera(), Camera(1 / 3 * 100, (-1e-7, 2 / 3)), Camera(50, (0.4, 0.6))])
def test_a_described_camera_reads_back(camera: Camera) -> None:
    assert Camera.parse(camera.describe()) == camera


def test_the_description_is_that_of_rendered_files() -> None:
    assert Camera().describe() == "fov_deg=36 principal=0.5,0.5"


@pytest.mark.parametrize("text", ["", "36", "fov_deg=36", "fov_deg=x principal=0.5,0.5", "fov_deg=190 principal=0,0"])
def test_what_is_no_camera_is_refused(text: str) -> None:
    with pytest.raises(UnirenderError, match=r"camera|field of view"):
        Camera.parse(text)
