"""PNG files of 8 and 16 bits a channel as values in [0, 1].

Pillow has no mode for 16-bit colour and drops the low bytes. They are read all the same: its decoder unpacks the same
pixels a second time, as if their bytes were in the other order, and keeps what it dropped before.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError

# How Pillow names the pixels it cuts -> names under which it keeps the high, and the low bytes.
SIXTEEN = {"RGB;16B": ("RGB;16B", "RGB;16L"), "RGBA;16B": ("RGBA;16B", "RGBA;16L")}
GREY_AND_ALPHA = "LA;16B"  # four bytes a pixel: the grey's, then the alpha's
COLOURED = 0.1  # mean difference of the channels; a network's grey pictures have a hundredth


def read_png(path: Path, channels: int) -> Float[np.ndarray, "h w c"]:
    """Values in [0, 1] of a PNG; alpha is dropped. Grey is as good as three equal channels, and the reverse: of
    channels that differ a little, one value a pixel is the mean.

    Raises:
        UnirenderError: not a readable PNG, or one in colour where `channels` is 1.
    """
    from PIL import Image as Pil

    try:
        with Pil.open(path) as picture:
            stored = picture.tile[0].args if picture.tile else None
            if stored in SIXTEEN or stored == GREY_AND_ALPHA:
                value = _sixteen_bits(path, str(stored))
            elif picture.mode.startswith("I"):
                value = np.asarray(picture, np.float32) / 65535.0
            else:
                value = np.asarray(picture.convert("RGB"), np.float32) / 255.0
    except (OSError, ValueError, SyntaxError) as error:
        raise UnirenderError(f"predictions: {path} is not a readable PNG ({error})") from None
    value = value if value.ndim == 3 else value[..., None]
    if channels == 3:
        return np.repeat(value, 3, axis=-1) if value.shape[-1] == 1 else value.astype(np.float32)
    if (difference := float(np.ptp(value, axis=-1).mean())) > COLOURED:
        raise UnirenderError(
            f"predictions: {path} is in colour: its channels differ by {difference:.2g} in the mean, expected one "
            "value a pixel; write it as grey: of glTF's metallicRoughness, roughness is the green channel and metallic "
            "the blue; of a network's three channels that should be one, their mean"
        )
    return value.mean(axis=-1, keepdims=True, dtype=np.float64).astype(np.float32)


def _sixteen_bits(path: Path, stored: str) -> np.ndarray:
    """Values in [0, 1] without alpha: `[h w 3]` of colour, `[h w]` of grey."""
    if stored == GREY_AND_ALPHA:
        pixels = _unpacked(path, "RGBA")
        high, low = pixels[..., 0], pixels[..., 1]
    else:
        high, low = (_unpacked(path, name)[..., :3] for name in SIXTEEN[stored])
    return (high.astype(np.float32) * 256 + low) / 65535.0


def _unpacked(path: Path, name: str) -> np.ndarray:
    """The pixels' bytes, unpacked as Pillow does with pixels of that name."""
    from PIL import Image as Pil

    with Pil.open(path) as picture:
        picture.tile = [tile._replace(args=name) for tile in picture.tile]
        return np.asarray(picture)
