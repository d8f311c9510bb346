"""PNG files of predictions, of 8 and 16 bits a channel, as values in [0, 1]."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.map_files import one_channel
from unirender.picture_files.cicp import read_cicp
from unirender.picture_files.icc import states_other_colors
from unirender.picture_files.sixteen_bits import sixteen_bit_values

if TYPE_CHECKING:
    from PIL import Image

LINEAR_GAMMA = 0.9  # of the gAMA chunk: 1 is linear, 0.45 like sRGB


def read_png(path: Path, channels: int, encoded: bool = False) -> Float[np.ndarray, "h w c"]:
    """Values in [0, 1] of a PNG; alpha is dropped. Grey is as good as three equal channels, and the reverse: of
    channels that differ a little, one value a pixel is the mean.

    Args:
        path: the file.
        channels: 3, or 1.
        encoded: whether its values are taken as sRGB-encoded.

    Raises:
        UnirenderError: not a readable PNG, one in colour where `channels` is 1, or one that states other colours than
            sRGB's where it is taken as encoded.
    """
    from PIL import Image as Pil

    try:
        with Pil.open(path) as picture:
            stated = _other_colors(path, picture) if encoded else None
            if (full := sixteen_bit_values(path)) is not None:
                value = full[..., :3]
            elif picture.mode.startswith("I"):
                value = np.asarray(picture, np.float32) / 65535.0
            else:
                value = np.asarray(picture.convert("RGB"), np.float32) / 255.0
    except UnirenderError:
        raise
    except (OSError, ValueError, SyntaxError, Pil.DecompressionBombError) as error:
        raise UnirenderError(f"predictions: {path} is not a readable PNG ({error}); write it again") from None
    if stated is not None:
        raise UnirenderError(
            f"predictions: {path} states {stated}, expected sRGB-encoded values; convert it to sRGB, or write it "
            'without that where it is in sRGB already; if its values are linear, say png_colour = "linear" in '
            "conventions.toml"
        )
    value = value if value.ndim == 3 else value[..., None]
    if channels == 3:
        return np.repeat(value, 3, axis=-1) if value.shape[-1] == 1 else value.astype(np.float32)
    return one_channel(value, f"predictions: {path}")


def is_transparent(path: Path) -> bool:
    """Whether a PNG that can be read has pixels that are not opaque."""
    from PIL import Image as Pil

    with Pil.open(path) as picture:
        lowest: Any = picture.convert("RGBA").getchannel("A").getextrema()[0]
        return picture.has_transparency_data and lowest < 255


def _other_colors(path: Path, picture: "Image.Image") -> str | None:
    """What a PNG states of its colours that is not sRGB, by the first chunk that counts (`picture_files.cicp`)."""
    if (coded := read_cicp(path)) is not None:
        return None if coded.is_srgb else str(coded)
    if picture.info.get("icc_profile"):
        return "colours of another ICC profile" if states_other_colors(picture, f"predictions: {path}") else None
    gamma = 0 if "srgb" in picture.info else picture.info.get("gamma", 0)
    return f"linear values (gAMA {gamma:.3g})" if gamma > LINEAR_GAMMA else None
