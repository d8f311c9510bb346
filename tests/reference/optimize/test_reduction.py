"""Pictures at fewer pixels: each new pixel shows what its camera says that it looks at."""

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.color import srgb_decode, srgb_encode
from unirender_reference.optimize.reduction import reduced
from unirender_reference.optimize.views import View

POSE = np.eye(4, dtype=np.float32)


def ramp(camera: Camera, height: int, width: int) -> np.ndarray:
    """Radiance that grows evenly along the image plane at distance 1: its mean over a pixel is that in the middle."""
    rays = camera.rays(height, width)
    across, up = np.moveaxis(rays / -rays[..., 2:], -1, 0)[:2]
    return np.stack([5 + across, 5 + up, 5 + across - up], axis=-1).astype(np.float32)


@pytest.mark.parametrize(("height", "width", "new"), [(30, 17, (10, 6)), (17, 30, (6, 10)), (23, 23, (10, 10))])
def test_a_smaller_picture_is_that_of_its_camera(height: int, width: int, new: tuple[int, int]) -> None:
    """Also of sides that are no multiples of one another, of which a border is cut off. Old pixels that lie in two new
    ones are even, which moves what is seen by less than a tenth of them."""
    camera = Camera(50.0, (0.42, 0.55))
    view = View(ramp(camera, height, width), np.ones((height, width, 1), np.float32), camera, POSE)
    small = reduced(view, 10, linear=True)
    assert small.image.shape[:2] == new
    np.testing.assert_allclose(small.image, ramp(small.camera, *new), rtol=0, atol=5e-3)
    assert np.abs(small.image - ramp(camera, *new)).max() > 1e-2 or height == width  # the twin: the old camera
    np.testing.assert_allclose(small.mask, 1, atol=1e-6)


def test_a_picture_that_is_small_enough_stays() -> None:
    view = View(np.ones((10, 7, 3), np.float32), np.ones((10, 7, 1), np.float32), Camera(), POSE)
    assert reduced(view, 10, linear=True) is view


def test_light_is_averaged_where_it_is_covered_and_what_is_clipped_stays_a_bound() -> None:
    """Of four display values: a bright one, a dark one, one at white, and one that the mask leaves out."""
    image = np.full((2, 4, 3), 0.5, np.float32)
    image[:, :2] = np.array([[0.8, 0.2], [1.0, 0.9]], np.float32)[..., None]
    mask = np.ones((2, 4, 1), np.float32)
    mask[1, 1] = 0
    small = reduced(View(image, mask, Camera(), POSE), 2, linear=False)
    shown = srgb_encode(srgb_decode(np.array([[0.8, 0.2, 1.0]], np.float32)).mean(axis=1))
    np.testing.assert_allclose(small.image[0, :, 0], [shown[0], 0.5], atol=1e-5)
    np.testing.assert_allclose(small.mask[0, :, 0], [0.75, 1])
    assert small.clipped is not None
    assert small.clipped[0].all(axis=-1).tolist() == [True, False]
