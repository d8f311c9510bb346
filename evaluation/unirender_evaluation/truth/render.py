"""Renders one buffer until a noise-free prediction could score the suite's target against it (its noise ceiling)."""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.exr import Channels
from unirender_evaluation.suites.spec import SuiteSpec
from unirender_evaluation.suites.truth_file import Kind, estimate_channels, estimate_mean, estimate_variance
from unirender_reference.noise import FloorEstimate, full_spp, noise_floor_db, render_to_floor
from unirender_reference.passes import Estimate

Rgb = Float[np.ndarray, "h w 3"]
Mask = Float[np.ndarray, "h w 1"]


def stored_ceiling_db(channels: Channels, mask: Mask, kind: Kind) -> float:
    """The noise ceiling of a buffer as it is stored: mean and std rounded."""
    return noise_floor_db(estimate_mean(kind, channels), estimate_variance(kind, channels), mask, kind == "image")


def item_seed(*parts: Any) -> int:
    """A render seed that is a pure function of what is rendered."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x3FFFFFFF


def good_spp(wanted: float, spec: SuiteSpec) -> int:
    """The least samples per pixel >= `wanted` that make full passes of the suite's pictures (`noise.full_spp`)."""
    return full_spp(wanted, spec.batches, spec.resolution**2)


def render_to_ceiling(
    render: Callable[[int, int], Any], mask: Mask, spec: SuiteSpec, seed: int, kind: Kind
) -> tuple[FloorEstimate, Channels]:
    """Adds samples until the noise ceiling reaches the suite's target, as estimated and as stored, or the samples
    `spec.max_spp` (`noise.render_to_floor`).

    Args:
        render: (spp, seed) -> estimate with `.mean`, `.variance` (of the mean) and `.nan_pixels`.
        mask: coverage.
        spec: gives target, limit, batches and the samples to begin with.
        seed: of the first render; each further one takes the next.
        kind: an image is premultiplied by coverage, s and d are not.

    Returns:
        The buffer, RGB, and its channels as they are to be stored.
    """
    premultiplied = kind == "image"
    first, target = (spec.spp, spec.target_db) if premultiplied else (spec.light_spp, spec.light_target_db)

    def render_rgb(spp: int, seed: int) -> Estimate:
        estimate = render(spp, seed)
        return Estimate(estimate.mean[..., :3], estimate.variance[..., :3], estimate.nan_pixels)

    def ceilings(mean: Rgb, variance: Rgb) -> tuple[float, float]:
        found = noise_floor_db(mean, variance, mask, premultiplied)
        return found, min(found, stored_ceiling_db(estimate_channels(kind, mean, variance, mask), mask, kind))

    found = render_to_floor(
        render_rgb,
        mask,
        target,
        premultiplied=premultiplied,
        spp=first,
        max_spp=spec.max_spp,
        seed=seed,
        batches=spec.batches,
        measure=ceilings,
    )
    return found, estimate_channels(kind, found.mean, found.variance, mask)
