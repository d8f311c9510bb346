"""Huber's loss: squares of small residuals, and beyond them as much as their size."""

import numpy as np
from jaxtyping import Float

HUBER = 4.0  # residuals in units of what is expected, beyond which they count linearly


def huber_cost(size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """size^2 up to `HUBER`, then linear with the same slope; sizes are not negative."""
    return np.where(size > HUBER, 2 * HUBER * size - HUBER**2, size**2)


def huber_weight(size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """What a squared residual counts so that its derivative is the loss's, (0, 1]."""
    return HUBER / np.maximum(size, HUBER)
