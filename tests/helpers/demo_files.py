"""Files that visitors of the demo hand in: a ball, a light, a light with NaN."""

import io

import numpy as np
import OpenEXR
from PIL import Image

from unirender.exr import exr_bytes, image_channels
from unirender.pictures import Picture


def png(pixels: np.ndarray) -> bytes:
    """Display values in [0, 1], 3 or 4 channels, as a PNG."""
    stream = io.BytesIO()
    Image.fromarray(np.round(pixels * 255).astype(np.uint8)).save(stream, format="PNG")
    return stream.getvalue()


def ball(size: int = 32, colour: tuple[float, float, float] = (0.7, 0.4, 0.2)) -> Picture:
    """A shaded ball, black outside of its mask."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2.4 - 1.2
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    shade = np.clip(0.3 * x - 0.4 * y + 0.8 * z, 0.1, 1)[..., None]
    mask = (x**2 + y**2 < 1).astype(np.float32)[..., None]
    return Picture((shade * colour * mask).astype(np.float32), mask, "ball.png")


def ball_png(size: int = 32, colour: tuple[float, float, float] = (0.7, 0.4, 0.2)) -> bytes:
    """The same as a PNG with an alpha channel."""
    picture = ball(size, colour)
    assert picture.mask is not None
    return png(np.concatenate([picture.image_srgb, picture.mask], axis=-1))


def radiance(value: float, shape: tuple[int, int] = (8, 16)) -> bytes:
    """A light that is the same from everywhere, as an EXR."""
    return exr_bytes(image_channels(np.full((*shape, 3), value, dtype=np.float32)), half=False)


def nan_exr() -> bytes:
    """A light with a texel that is no number; our own writer would refuse it."""
    pixels = np.ones((8, 16, 3), dtype=np.float32)
    pixels[2, 3] = np.nan
    stream = io.BytesIO()
    OpenEXR.File({}, {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate("RGB")}).write(stream)
    return stream.getvalue()
