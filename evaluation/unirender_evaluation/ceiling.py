"""Two rows that say what the truth itself is worth: the noise ceiling and the reference rendered with another seed.

Truth with noise of variance v scores a noise-free prediction at v, and another render of the same quality at 2 v, 3 dB
worse: a good method may pass the second and must not pass the first.
"""

import math

import numpy as np
from jaxtyping import Float

from unirender_evaluation.methods import Image, Mask
from unirender_evaluation.metrics import METRICS, Variant, metric_key, psnr_from_mse


def display_slope(linear: Float[np.ndarray, "h w c"], space: str) -> Float[np.ndarray, "h w c"]:
    """Derivative of the display transform (`clip`, then sRGB for space "srgb"): 0 where the display clips."""
    x = np.asarray(linear, np.float64)
    if space == "srgb":
        slope = np.where(x <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(x, 0.0031308) ** (1 / 2.4 - 1))
    else:
        slope = np.ones_like(x)
    return np.where((x < 0) | (x > 1), 0.0, slope)


def noise_mse(mean: Image, variance: Image, mask: Mask, variant: Variant, premultiplied: bool) -> float:
    """Expected squared error of a noise-free prediction against a noisy truth, by the delta method.

    Args:
        mean: linear truth, premultiplied by coverage or not.
        variance: of `mean`.
        mask: coverage.
        variant: mask and space are used.
        premultiplied: whether `mean` is.
    """
    coverage = np.maximum(mask, 1e-6)
    if variant.mask == "masked":
        scale = coverage if premultiplied else 1.0
        error = display_slope(mean / scale, variant.space) ** 2 * variance / np.square(scale)
        return float(np.sum(mask * error) / (error.shape[-1] * np.sum(mask)))
    frame, spread = (mean, variance) if premultiplied else (mean * mask, variance * np.square(mask))
    return float(np.mean(display_slope(frame + 1 - mask, variant.space) ** 2 * spread))


def noise_ceiling(quantity: str, mean: Image, variance: Image, mask: Mask, premultiplied: bool) -> dict[str, float]:
    """PSNR (dB) that a noise-free prediction is expected to score, for both masks and colour spaces, unaligned."""
    values = {}
    for region in ("masked", "whole"):
        for space in ("srgb", "linear"):
            variant = Variant(region, space, "raw")
            error = noise_mse(mean, variance, mask, variant, premultiplied)
            values[metric_key(quantity, METRICS["psnr"], variant)] = math.inf if error == 0 else psnr_from_mse(error)
    return values
