"""How maps look: the display values of each, and PNGs of 8 bits for the eye. What is read back is in the EXR files."""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from unirender.arguments import as_floats, as_path
from unirender.blocks import by_rows
from unirender.color import eight_bits, image_srgb
from unirender.errors import UnirenderError
from unirender.intrinsics import MAPS
from unirender.vectors import nonzero

PNG_STRATEGY = 3  # zlib's Z_RLE: a fifth of the time of what Pillow takes; of noisy pictures files up to a fifth larger


def map_picture(name: str, value: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """A map as people look at it: colours and light through sRGB, normals as (n + 1) / 2, the others as they are.

    Raises:
        UnirenderError: there is no map of that name, or it is of no numbers.
    """
    if name not in MAPS:
        raise UnirenderError(f"map: got {name!r:.60}, expected one of {', '.join(MAPS)}")
    value = as_floats(value, name)
    if name == "normal":
        return np.where(nonzero(value)[..., None], value * 0.5 + 0.5, 0)
    return value if name in ("roughness", "metallic", "mask") else image_srgb(value)


def write_png(path: str | Path, values: Float[np.ndarray, "h w c"]) -> None:
    """Display values in [0, 1], 1, 3 or 4 channels, as an 8-bit PNG.

    Raises:
        UnirenderError: no such values, or no path.
    """
    values = as_floats(values, "picture")
    if values.ndim != 3 or values.shape[-1] not in (1, 3, 4):
        raise UnirenderError(f"picture: got shape {values.shape}, expected (height, width, 1, 3 or 4)")
    if not np.isfinite(values).all():
        raise UnirenderError(
            "picture: got NaN or infinite values, expected display values in [0, 1]; repair them first"
        )
    _save_png(as_path(path), by_rows(eight_bits, values))


def write_map_png(path: Path, name: str, value: Float[np.ndarray, "h w c"]) -> None:
    """A map as `map_picture` shows it, as an 8-bit PNG; made some rows at a time."""
    _save_png(path, by_rows(partial(_map_pixels, name), value))


def _map_pixels(name: str, value: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    return eight_bits(map_picture(name, value))


def _save_png(path: Path, pixels: UInt8[np.ndarray, "h w c"]) -> None:
    grey = pixels.shape[-1] == 1
    Image.fromarray(pixels[..., 0] if grey else pixels).save(path, format="PNG", compress_type=PNG_STRATEGY)
