"""Colours of vertices and faces, as files store them, in the range [0, 1].

Numbers of a type say what white is: 255 for bytes. Where they are text, or floats, their values have to tell: of 255
where all are whole and one is above 1, or one is above `MOST_FLOAT`; else of 1, as floats that miss it by rounding are.
"""

import numpy as np
from jaxtyping import Float, Shaped

from unirender.color import srgb_decode

MOST_FLOAT = 2.0  # of colours that are floats of 1
OPAQUE = 0.998  # what alpha is above if it means 1: less than half a step of 255 below


def unit_colors(stored: Shaped[np.ndarray, "n c"]) -> Float[np.ndarray, "n 3"]:
    """sRGB-coded colours in [0, 1], float64; NaN counts as 0.

    Args:
        stored: red, green, blue and what else is of their range (alpha). Integer types: of 255, or of 65,535 where one
            is above 255. Floats, and numbers that were text: by the rule of the module.
    """
    top = stored.max(initial=0, where=np.isfinite(stored))
    if np.issubdtype(stored.dtype, np.integer):
        white = 255 if top <= 255 else 65535
    elif top > MOST_FLOAT or (top > 1 and not (stored % 1).any()):
        white = 255
    else:
        white = 1
    return np.clip(np.nan_to_num(stored[:, :3].astype(np.float64) / white), 0, 1)


def is_opaque(alpha: Shaped[np.ndarray, " n"]) -> bool:
    """Whether each alpha, stored as colours are, is 1."""
    return bool((unit_colors(alpha[:, None].repeat(3, axis=1)) > OPAQUE).all())


def linear_colors(stored: Shaped[np.ndarray, "n c"]) -> Float[np.ndarray, "n 3"]:
    """Linear colours of what `unit_colors` takes."""
    return srgb_decode(unit_colors(stored).astype(np.float32)).astype(np.float64)
