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


def test_rays_go_through_the_centres_of_square_pixels() -> None:
    """In a frame that is no square, with a principal point that is no symmetric one."""
    rays = Camera(50, (0.3, 0.6)).rays(6, 10).astype(np.float64)
    side = 2 * math.tan(math.radians(25)) / 6
    x, y = (np.arange(10) + 0.5 - 3.0) * side, (3.6 - np.arange(6) - 0.5) * side
    np.testing.assert_allclose(rays[..., 0] / -rays[..., 2], np.broadcast_to(x, (6, 10)), atol=1e-6)
    np.testing.assert_allclose(rays[..., 1] / -rays[..., 2], np.broadcast_to(y[:, None], (6, 10)), atol=1e-6)


def test_a_calibration_projects_to_its_pixels() -> None:
    """Points before the camera by the matrix K of COLMAP, and by the rays through those pixels."""
    focal, height, width, center = 210.0, 120, 200, (93.5, 66.0)
    camera = Camera.from_focal(focal, height, width, center)
    points = np.random.default_rng(0).uniform([-0.4, -0.25, 1], [0.4, 0.25, 1.2], (50, 3))  # x right, y down, z forward
    x, y = (focal * points[:, :2] / points[:, 2:] + center).T
    rays = camera.rays(height, width).astype(np.float64)
    for point, row, column in zip(points, y.astype(int), x.astype(int), strict=True):
        across, up, back = rays[row, column]
        middle = np.array([across, -up, -back]) * point[2] / -back
        assert np.abs(middle - point).max() <= 0.5 / focal * point[2] + 1e-6  # half a pixel
    assert camera.focal(height) == pytest.approx(focal, rel=1e-12)
    assert Camera.from_focal(focal, height, width).principal == (0.5, 0.5)
    for bad in ((0.0, 9, 9), (-3.0, 9, 9), (math.nan, 9, 9), (math.inf, 9, 9), (9.0, 0, 9), (9.0, 9, 0)):
        with pytest.raises(UnirenderError, match="expected numbers above 0"):
            Camera.from_focal(*bad)


def test_a_square_part_has_the_pictures_rays() -> None:
    """Of a picture that is no square, beyond whose left border the part reaches."""
    camera, top, left, side = Camera(50, (0.3, 0.6)), 2, -1, 5
    whole, part = camera.rays(9, 14), camera.of_square(top, left, side, 9, 14).rays(side, side)
    np.testing.assert_allclose(part[:, 1:], whole[top : top + side, : left + side], atol=1e-6)


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


@pytest.mark.parametrize("principal", [(0.5, math.nan), (math.inf, 0.5)])
def test_impossible_principal_point(principal: tuple[float, float]) -> None:
    with pytest.raises(UnirenderError, match="principal point"):
        Camera(principal=principal)


@pytest.mark.parametrize(
    "camera", [Camera(), Camera(1 / 3 * 100, (-1e-7, 2 / 3)), Camera(50, (0.4, 0.6)), Camera(50, (1e20, 0.5))]
)
def test_a_described_camera_reads_back(camera: Camera) -> None:
    assert Camera.parse(f" {camera.describe()}\n") == camera


def test_the_description_is_that_of_rendered_files() -> None:
    assert Camera().describe() == "fov_deg=36 principal=0.5,0.5"


@pytest.mark.parametrize("text", ["", "36", "fov_deg=36", "fov_deg=x principal=0.5,0.5", "fov_deg=190 principal=0,0"])
def test_what_is_no_camera_is_refused(text: str) -> None:
    with pytest.raises(UnirenderError, match=r"camera|field of view"):
        Camera.parse(text)
