"""Monte Carlo passes: seeds, batches, the repair of NaN pixels, means and their variance.

A *pass* is one `mi.render` with its own seed. An estimate is the mean over its passes; the variance *of that mean*
comes from the spread between passes (Mitsuba's `moment` integrator gives XYZ, not RGB).
"""

import hashlib
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba

TRUTH_BATCHES = 8
SAMPLES_PER_PASS = 1 << 23  # wavefront size: memory grows with it
NAN_ATTEMPTS = 8
MOST_SPLITS = 8  # passes to make of one that is no full grid: small passes are hardly stratified


@dataclass(frozen=True)
class Estimate:
    """A Monte Carlo estimate.

    Attributes:
        mean: (h, w, c) linear radiance.
        variance: (h, w, c) variance of `mean`, or None when one pass was asked for.
        nan_pixels: pixels that came out NaN or infinite in some pass and were rendered again with another seed.
    """

    mean: Float[np.ndarray, "h w c"]
    variance: Float[np.ndarray, "h w c"] | None
    nan_pixels: int = 0


@dataclass
class Counters:
    """What a renderer has done so far: `mi.render` seconds (array read back included), calls, repaired pixels."""

    render_seconds: float = 0.0
    renders: int = 0
    nan_pixels: int = 0


def render_passes(
    scene: Any, depth: int, spp: int, seed: int, batches: int, counters: Counters
) -> tuple[Float[np.ndarray, "n h w 4"], int]:
    """Premultiplied RGBA passes of path tracing at `depth`, the environment hidden; at least `batches` of them.

    A pixel that comes out NaN or infinite is taken from a render with another seed; how many is the second result.

    Raises:
        UnirenderError: `spp` cannot be divided, or a pixel stays NaN.
    """
    mi = mitsuba()
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
    width, height = scene.sensors()[0].film().crop_size()
    count = pass_count(spp, batches, SAMPLES_PER_PASS // int(width * height))
    before, passes = counters.nan_pixels, []
    for index in range(count):

        def draw(attempt: int, index: int = index) -> Float[np.ndarray, "h w 4"]:
            return _render(scene, integrator, spp // count, derive_seed(seed, "pass", index, attempt), counters)

        passes.append(finite_pass(draw, counters, "render"))
    return np.stack(passes), counters.nan_pixels - before


def finite_pass(
    draw: Callable[[int], Float[np.ndarray, "*n c"]], counters: Counters, what: str
) -> Float[np.ndarray, "*n c"]:
    """A pass whose pixels are all finite: those that are NaN or infinite are counted and taken from other draws.

    Args:
        draw: makes the pass; attempt 0 is the pass itself, attempts 1, 2, ... have other seeds.
        counters: the repaired pixels are added here.
        what: stands in the error message.

    Raises:
        UnirenderError: a pixel is not finite in any of `NAN_ATTEMPTS` other draws.
    """
    picture = draw(0)
    bad = ~np.isfinite(picture).all(axis=-1)
    counters.nan_pixels += int(bad.sum())
    for attempt in range(1, NAN_ATTEMPTS + 1):
        if not bad.any():
            return picture
        picture[bad] = draw(attempt)[bad]
        bad = ~np.isfinite(picture).all(axis=-1)
    if bad.any():
        raise UnirenderError(
            f"{what}: {int(bad.sum())} pixels stay NaN after {NAN_ATTEMPTS} seeds, expected finite radiance; "
            "check the normals and the light"
        )
    return picture


def mean_estimate(passes: Float[np.ndarray, "n h w c"], nan_pixels: int, batches: int) -> Estimate:
    """Mean over passes and its variance (None for one batch)."""
    variance = passes.var(axis=0, ddof=1, dtype=np.float64) / len(passes) if batches > 1 else None
    return Estimate(_float32(passes.mean(axis=0, dtype=np.float64)), _float32(variance), nan_pixels)


def ratio_estimate(passes: Float[np.ndarray, "n h w 4"], nan_pixels: int, batches: int) -> Estimate:
    """Sum of radiance over sum of coverage, 0 where nothing is covered; variance of the ratio by the delta method."""
    radiance, coverage = passes[..., :3].astype(np.float64), passes[..., 3:].astype(np.float64)
    total = coverage.mean(axis=0)
    covered = total > 0
    mean = np.divide(radiance.mean(axis=0), total, out=np.zeros(radiance.shape[1:]), where=covered)
    if batches == 1:
        return Estimate(_float32(mean), None, nan_pixels)
    residual = radiance - mean * coverage
    spread = np.square(residual).sum(axis=0) / (len(passes) - 1) / len(passes)
    variance = np.divide(spread, np.square(total), out=np.zeros_like(spread), where=covered)
    return Estimate(_float32(mean), _float32(variance), nan_pixels)


def pass_count(spp: int, batches: int, most: int) -> int:
    """The fewest passes (at least `batches`) that divide `spp` into equal pass sizes, each a full multi-jittered grid.

    Mitsuba's multi-jittered sampler rounds other sizes up, with a warning.

    Args:
        spp: samples per pixel in all.
        batches: least number of passes.
        most: largest number of samples per pixel in one pass.

    Raises:
        UnirenderError: fewer samples than batches, or more than `MOST_SPLITS` times as many passes as `batches` and
            `most` ask for (67 samples in one batch are 67 passes of one sample).
    """
    if spp < 1 or batches < 1 or batches > spp:
        raise UnirenderError(f"spp: got {spp} in {batches} batches, expected at least one sample in each")
    if (count := _grid_passes(spp, batches, most)) is not None:
        return count
    below = next(n for n in range(spp - 1, 0, -1) if n < batches or _grid_passes(n, batches, most) is not None)
    above = next(n for n in itertools.count(spp + 1) if _grid_passes(n, batches, most) is not None)
    advice = f"use {below} or {above}" if below >= batches else f"use {above}"
    raise UnirenderError(
        f"spp: got {spp} in {batches} batches, expected a number that divides into a few full multi-jittered grids "
        f"(4, 6, 9, 16, 64, ... samples a pass); {advice}"
    )


def _grid_passes(spp: int, batches: int, most: int) -> int | None:
    """`pass_count`, or None where there are too many."""
    most = max(most, 1)
    needed = max(batches, -(-spp // most))
    for count in range(needed, min(spp, needed * MOST_SPLITS) + 1):
        size = spp // count
        if spp % count == 0 and size % math.isqrt(size) == 0:
            return count
    return None


def derive_seed(*parts: int | str) -> int:
    """A 32-bit seed that depends on all parts, the same in every process and version of Python."""
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:4], "little")


def _render(scene: Any, integrator: Any, spp: int, seed: int, counters: Counters) -> Float[np.ndarray, "h w 4"]:
    start = time.perf_counter()
    picture = np.array(mitsuba().render(scene, integrator=integrator, spp=spp, seed=seed), dtype=np.float32)
    counters.render_seconds += time.perf_counter() - start
    counters.renders += 1
    return picture


def _float32(array: Any) -> Any:
    return None if array is None else array.astype(np.float32)
