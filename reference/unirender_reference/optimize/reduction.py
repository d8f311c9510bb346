"""Posed pictures at fewer pixels: means over areas, in linear light."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode, srgb_encode, unpremultiply
from unirender.pictures import DISPLAY_WHITE
from unirender_reference.meshes.images import area_means
from unirender_reference.optimize.views import View

LEAST_SHARE = 1e-6  # of a new pixel: less is rounding


def reduced(view: View, longest_side: int, linear: bool) -> View:
    """A view with sides of at most `longest_side` pixels: means over areas, of light where it is covered.

    Pixels stay square: of the longer side, less than one new pixel is cut off. A display value that is clipped stays
    a lower bound in the mean that it enters.

    Args:
        view: any size.
        longest_side: in pixels.
        linear: the image is linear radiance; else display values.
    """
    height, width = view.mask.shape[:2]
    ratio = max(height, width) / longest_side
    if ratio <= 1:
        return view
    new = max(1, round(min(height, width) / ratio))
    ratio = min(height, width) / new
    new_height, new_width = math.floor(height / ratio + 1e-9), math.floor(width / ratio + 1e-9)
    top, left = (height - new_height * ratio) / 2, (width - new_width * ratio) / 2

    def means(values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "i j c"]:
        across = area_means(values, new_width, 1, left, width - left)
        return area_means(across, new_height, 0, top, height - top)

    straight = view.image if linear else srgb_decode(np.clip(view.image, 0, 1))
    mask = np.clip(means(view.mask), 0, 1)
    image = np.maximum(unpremultiply(means(straight * view.mask), mask), 0)
    x, y = view.camera.principal
    half = math.tan(math.radians(view.camera.fov_deg) / 2) * (height - 2 * top) / height
    camera = dataclasses.replace(
        view.camera,
        fov_deg=math.degrees(2 * math.atan(half)),
        principal=((x * width - left) / (width - 2 * left), (y * height - top) / (height - 2 * top)),
    )
    if linear:
        return View(image, mask, camera, view.pose, view.name)
    full = (view.image >= DISPLAY_WHITE) if view.clipped is None else view.clipped
    clipped = means((full & (view.mask > 0)).astype(np.float32)) > LEAST_SHARE
    return View(np.clip(srgb_encode(image), 0, 1), mask, camera, view.pose, view.name, clipped)
