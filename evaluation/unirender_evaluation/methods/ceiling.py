"""Two rows that say what the truth itself is worth: the noise ceiling and the reference rendered with another seed.

Truth with noise of variance v scores a noise-free prediction at v, and another render of the same quality at 2 v, 3 dB
worse: a good method may pass the second and must not pass the first. PSNR's ceiling follows from v; SSIM's and LPIPS's
are scored, on a picture that is nearly noise-free.
"""

import math
from collections.abc import Sequence

import numpy as np

from unirender.color import display_slope, unpremultiply
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.metrics import METRICS, Variant, metric_key, psnr_from_mse
from unirender_reference.noise import masked_noise_mse


def noise_mse(mean: Image, variance: Image, mask: Mask, variant: Variant, premultiplied: bool) -> float:
    """Expected squared error of a noise-free prediction against a noisy truth, by the delta method.

    Args:
        mean: linear truth, premultiplied by coverage or not.
        variance: of `mean`.
        mask: coverage.
        variant: mask and space are used.
        premultiplied: whether `mean` is.
    """
    if variant.mask == "masked":
        return masked_noise_mse(mean, variance, mask, premultiplied, variant.space)
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


def similarity_ceiling(
    quantity: str, twin: Image, truth: Image, mask: Mask, premultiplied: bool, backbones: Sequence[str] = ()
) -> dict[str, float]:
    """SSIM and LPIPS that a noise-free prediction is expected to score, for all masks and colour spaces, unaligned.

    The nearly noise-free `twin` stands for it. What noise it has left (a 1/n-th of the truth's variance for n times the
    samples) makes the ceiling pessimistic by about that share.

    Args:
        quantity: name in the metric keys.
        twin: the truth's scene with many times its samples (`Suite.ceiling_image`, ...), linear.
        truth: linear.
        mask: coverage.
        premultiplied: whether `twin` and `truth` are.
        backbones: of LPIPS; one left out has no values.
    """
    from unirender_evaluation import lpips  # torch
    from unirender_evaluation.scoring import score_colour

    if premultiplied:
        twin, truth = unpremultiply(twin, mask), unpremultiply(truth, mask)
    networks = [lpips.load(name) for name in backbones]
    scores = score_colour(quantity, twin, truth, mask, mask, ("raw",), networks)
    wanted = (f"{quantity}.ssim@", f"{quantity}.lpips_")
    return {key: value for key, value in scores.items() if key.startswith(wanted)}
