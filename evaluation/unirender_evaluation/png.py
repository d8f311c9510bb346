"""PNG files of predictions, of 8 and 16 bits a channel, as values in [0, 1]."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.sixteen_bits import sixteen_bit_values

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
            if (full := sixteen_bit_values(path)) is not None:
                value = full[..., :3]
            elif picture.mode.startswith("I"):
                value = np.asarray(picture, np.float32) / 65535.0
            else:
                value = np.asarray(picture.convert("RGB"), np.float32) / 255.0
    except (OSError, ValueError, SyntaxError) as error:
        raise UnirenderError(f"predictions: {path} is not a readable PNG ({error}); write it again") from None
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
