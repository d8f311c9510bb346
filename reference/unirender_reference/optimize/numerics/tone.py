"""The curve from linear radiance to display values, where residuals are measured."""

import numpy as np
from jaxtyping import Float

from unirender.color import display_slope


def tone_slope(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Derivative of the sRGB curve, continued above 1."""
    return np.where(linear > 1, 1.055 / 2.4 * np.maximum(linear, 1) ** (1 / 2.4 - 1), display_slope(linear))
