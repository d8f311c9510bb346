"""Renders one buffer until a noise-free prediction could score the suite's target against it (its noise ceiling)."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.exr import Channels
from unirender_evaluation.ceiling import noise_mse
from unirender_evaluation.metrics import Variant, psnr_from_mse
from unirender_evaluation.suite_spec import SuiteSpec
from unirender_evaluation.truth_file import Kind, estimate_channels, estimate_mean, estimate_variance

MARGIN_DB = 0.15  # aimed at above the target, so that few buffers need a third render
Rgb = Float[np.ndarray, "h w 3"]
Mask = Float[np.ndarray, "h w 1"]


@dataclass(frozen=True)
class TruthBuffer:
    """A rendered image, s or d (float64): `variance` is that of `mean`; `spp`, `nan_pixels` count all its renders."""

    mean: Rgb
    variance: Rgb
    spp: int
    ceiling_db: float
    nan_pixels: int


def noise_ceiling_db(mean: Rgb, variance: Rgb, mask: Mask, kind: Kind) -> float:
    """Masked sRGB PSNR in dB that a noise-free prediction would score against `mean` (see `ceiling`); inf without
    noise."""
    return psnr_from_mse(noise_mse(mean, variance, mask, Variant("masked", "srgb", "raw"), kind == "image"))


def stored_ceiling_db(channels: Channels, mask: Mask, kind: Kind) -> float:
    """The same of a buffer as it is stored: mean and std rounded."""
    return noise_ceiling_db(estimate_mean(kind, channels), estimate_variance(kind, channels), mask, kind)


def item_seed(*parts: Any) -> int:
    """A render seed that is a pure function of what is rendered."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x3FFFFFFF


def good_spp(wanted: float, spec: SuiteSpec) -> int:
    """The least samples per pixel >= `wanted` in a multiple of `spec.batches` passes, each of them a full
    multi-jittered grid and small enough for one wavefront."""
    from unirender_reference.passes import SAMPLES_PER_PASS

    most = max(1, SAMPLES_PER_PASS // spec.resolution**2)
    rounds = 0
    while True:
        rounds += 1
        passes = spec.batches * rounds
        size = max(math.ceil(wanted / passes), 1)
        while size % math.isqrt(size):
            size += 1
        if size <= most or size == 1:
            return passes * size


def render_once(render: Callable[[int, int], Any], mask: Mask, spp: int, seed: int, kind: Kind) -> TruthBuffer:
    """One render; arguments as `render_to_ceiling`."""
    estimate = render(spp, seed)
    mean, variance = estimate.mean[..., :3].astype(np.float64), estimate.variance[..., :3].astype(np.float64)
    return TruthBuffer(mean, variance, spp, noise_ceiling_db(mean, variance, mask, kind), estimate.nan_pixels)


def combined(a: TruthBuffer, b: TruthBuffer, mask: Mask, kind: Kind) -> TruthBuffer:
    """Two independent renders as one, each weighted by its samples."""
    share = b.spp / (a.spp + b.spp)
    mean = (1 - share) * a.mean + share * b.mean
    variance = (1 - share) ** 2 * a.variance + share**2 * b.variance
    ceiling = noise_ceiling_db(mean, variance, mask, kind)
    return TruthBuffer(mean, variance, a.spp + b.spp, ceiling, a.nan_pixels + b.nan_pixels)


def render_to_ceiling(
    render: Callable[[int, int], Any], mask: Mask, spec: SuiteSpec, seed: int, kind: Kind
) -> tuple[TruthBuffer, Channels]:
    """Adds samples until the noise ceiling reaches the suite's target, as estimated and as stored, or the samples
    `spec.max_spp`.

    The error falls as 1 / samples, so that the first estimate says how many are missing.

    Args:
        render: (spp, seed) -> estimate with `.mean`, `.variance` (of the mean) and `.nan_pixels`.
        mask: coverage.
        spec: gives target, limit, batches and the samples to begin with.
        seed: of the first render; each further one takes the next.
        kind: an image is premultiplied by coverage, s and d are not.

    Returns:
        The buffer, and its channels as they are to be stored.
    """
    is_image = kind == "image"
    first, target = (spec.spp, spec.target_db) if is_image else (spec.light_spp, spec.light_target_db)
    found, index = render_once(render, mask, good_spp(first, spec), seed, kind), 0
    while True:
        channels = estimate_channels(kind, found.mean, found.variance, mask)
        enough = min(found.ceiling_db, stored_ceiling_db(channels, mask, kind)) >= target
        if enough or found.spp >= spec.max_spp:
            return found, channels
        index += 1
        missing_db = max(target - found.ceiling_db, 0) + MARGIN_DB
        wanted = min(found.spp * 10 ** (missing_db / 10), spec.max_spp)
        more = render_once(render, mask, good_spp(wanted - found.spp, spec), seed + index, kind)
        found = combined(found, more, mask, kind)
