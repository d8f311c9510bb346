"""What is assumed of materials and light beyond the pictures: each prior is a value and its derivative.

Notation: rho(u) = sqrt(u^2 + w^2) - w (Charbonnier) is quadratic below the width w and grows linearly above, so that
edges of textures cost little more than slopes. Smoothness is the mean of rho over differences of neighbouring texels,
along columns and rows. Everything is a mean over texels: weights do not depend on resolution.
"""

import numpy as np
from jaxtyping import Float

Map = Float[np.ndarray, "h w"] | Float[np.ndarray, "h w c"]


def smoothness(values: Map, width: float) -> tuple[float, Map]:
    """Mean of rho over the differences between neighbours, and its derivative.

    Args:
        values: a map.
        width: of rho, in units of the map.
    """
    total, slope = 0.0, np.zeros_like(values)
    right, down = np.zeros_like(values), np.zeros_like(values)
    right[:, :-1] = values[:, 1:] - values[:, :-1]
    down[:-1] = values[1:] - values[:-1]
    for difference, axis in ((right, 1), (down, 0)):
        root = np.sqrt(difference**2 + width**2)
        total += float((root - width).mean(dtype=np.float64))
        each = difference / root / values.size
        slope += np.roll(each, 1, axis=axis) - each
    return total, slope


def white_light(environment: Float[np.ndarray, "h w 3"]) -> tuple[float, Float[np.ndarray, "h w 3"]]:
    """NvDiffRec's light regulariser: mean |E_c - mean over channels of E|, and its derivative."""
    difference = environment - environment.mean(axis=-1, keepdims=True)
    sign = np.sign(difference)
    slope = (sign - sign.mean(axis=-1, keepdims=True)) / environment.size
    return float(np.abs(difference).mean(dtype=np.float64)), slope.astype(np.float32)


def anchor(values: Map, first: Map) -> tuple[float, Map]:
    """Mean square distance from where the optimisation began, and its derivative."""
    difference = values - first
    return float((difference**2).mean(dtype=np.float64)), 2 * difference / values.size
