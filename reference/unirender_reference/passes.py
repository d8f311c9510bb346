"""Monte Carlo passes: seeds, the repair of NaN pixels, groups, means and their variance.

A *pass* is one `mi.render` with its own seed. An estimate is the mean over its passes; the variance *of that mean*
comes from the spread between passes (Mitsuba's `moment` integrator gives XYZ, not RGB). Many passes are kept as the
means of equal groups, so that memory does not grow with the samples: a mean over groups is the mean over passes, and
the spread between groups gives the same variance, with fewer degrees of freedom.
"""

import hashlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.shown import short_repr
from unirender_reference.backend import mitsuba
from unirender_reference.faults import ObjectFault
from unirender_reference.integrators import path_integrator
from unirender_reference.sample_counts import SAMPLES_PER_PASS, kept_passes, pass_count

TRUTH_BATCHES = 8
NAN_ATTEMPTS = 8
PIXELS_PER_BLOCK = 1 << 13

Picture = Float[np.ndarray, "h w c"]


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

    __repr__ = short_repr


@dataclass
class Counters:
    """What a renderer has done so far: `mi.render` seconds (array read back included), calls, repaired pixels."""

    render_seconds: float = 0.0
    renders: int = 0
    nan_pixels: int = 0


def render_passes(
    scene: Any, depth: int, spp: int, seed: int, batches: int, counters: Counters, sensor: Any = None
) -> tuple[list[Float[np.ndarray, "h w 4"]], int]:
    """Premultiplied RGBA passes of path tracing at `depth`, the environment hidden; arguments as `integrator_passes`.

    Depth 2 is one bounce, direct light; depth 4 is three bounces.
    """
    return integrator_passes(scene, path_integrator(depth), spp, seed, batches, counters, sensor)


def integrator_passes(
    scene: Any, integrator: Any, spp: int, seed: int, batches: int, counters: Counters, sensor: Any = None
) -> tuple[list[Picture], int]:
    """At least `batches` passes of any Mitsuba integrator, each an `mi.render` with its own seed.

    Where there are more than `kept_passes` allows, what comes back are the means of groups of as many passes each.

    A pixel that comes out NaN or infinite is taken from a render with another seed; how many is the second result.

    Args:
        scene: a Mitsuba scene.
        integrator: what is rendered; c is 4 (RGBA) and one channel for each of its AOVs.
        spp: samples per pixel of all passes together.
        seed: equal seeds give equal passes.
        batches: least number of passes.
        counters: seconds, calls and repaired pixels are added here.
        sensor: a Mitsuba sensor, loaded or as a dict; None: the scene's first.

    Raises:
        UnirenderError: `spp` cannot be divided, or a pixel stays NaN.
    """
    if sensor is None:
        sensor = scene.sensors()[0]
    elif isinstance(sensor, dict):
        sensor = mitsuba().load_dict(sensor)
    width, height = sensor.film().crop_size()
    pixels = int(width * height)
    count = pass_count(spp, batches, SAMPLES_PER_PASS // pixels)
    before = counters.nan_pixels

    def drawn(index: int) -> Float[np.ndarray, "h w c"]:
        def draw(attempt: int) -> Float[np.ndarray, "h w c"]:
            return _render(scene, sensor, integrator, spp // count, derive_seed(seed, "pass", index, attempt), counters)

        return finite_pass(draw, counters, "render")

    kept = group_means((drawn(index) for index in range(count)), count, kept_passes(count, batches, pixels))
    return kept, counters.nan_pixels - before


def group_means(passes: Iterable[Picture], count: int, groups: int) -> list[Picture]:
    """The means of `groups` equal groups of `count` successive passes; the passes themselves where there is one each.

    One pass and one float64 sum are in memory besides the result.
    """
    size, left = count // groups, iter(passes)
    if size == 1:
        return list(left)
    return [_mean_of(itertools.islice(left, size), size) for _ in range(groups)]


def _mean_of(passes: Iterator[Picture], size: int) -> Picture:
    total = next(passes).astype(np.float64)
    for picture in passes:
        total += picture
    return (total / size).astype(np.float32)


def finite_pass(
    draw: Callable[[int], Float[np.ndarray, "*n c"]], counters: Counters, what: str
) -> Float[np.ndarray, "*n c"]:
    """A pass whose pixels are all finite: those that are NaN or infinite are counted and taken from other draws.

    Args:
        draw: makes the pass; attempt 0 is the pass itself, attempts 1, 2, ... have other seeds.
        counters: the repaired pixels are added here.
        what: stands in the error message.

    Raises:
        ObjectFault: a pixel is not finite in any of `NAN_ATTEMPTS` other draws.
    """
    picture = draw(0)
    if np.isfinite(picture).all():
        return picture
    bad = ~np.isfinite(picture).all(axis=-1)
    counters.nan_pixels += int(bad.sum())
    for attempt in range(1, NAN_ATTEMPTS + 1):
        if not bad.any():
            return picture
        picture[bad] = draw(attempt)[bad]
        bad = ~np.isfinite(picture).all(axis=-1)
    if bad.any():
        raise ObjectFault(
            f"{what}: {int(bad.sum())} pixels stay NaN after {NAN_ATTEMPTS} seeds, expected finite radiance; "
            "check the normals and the light"
        )
    return picture


def mean_estimate(passes: Sequence[Picture], nan_pixels: int, batches: int) -> Estimate:
    """Mean over passes and its variance (None for one batch)."""
    mean = np.empty(passes[0].shape, np.float32)
    variance = np.empty_like(mean) if batches > 1 else None
    for rows in _row_blocks(mean):
        block = _stacked(passes, rows)
        average = block.mean(axis=0)
        mean[rows] = average
        if variance is not None:
            block -= average
            variance[rows] = np.einsum("nijc,nijc->ijc", block, block) / (len(block) - 1) / len(block)
    return Estimate(mean, variance, nan_pixels)


def ratio_estimate(passes: Sequence[Float[np.ndarray, "h w 4"]], nan_pixels: int, batches: int) -> Estimate:
    """Sum of radiance over sum of coverage, 0 where nothing is covered; variance of the ratio by the delta method."""
    return weighted_estimate(channels(passes, slice(0, 3)), channels(passes, slice(3, 4)), nan_pixels, batches)


def weighted_estimate(
    light: Sequence[Float[np.ndarray, "h w 3"]],
    weight: Sequence[Float[np.ndarray, "h w k"]],
    nan_pixels: int,
    batches: int,
) -> Estimate:
    """Sum of weighted radiance over sum of weights (one a pixel, or one a channel), 0 where the weights are 0.

    `light` has its weight in it. Variance of the ratio by the delta method; None for one batch.
    """
    mean = np.empty(light[0].shape, np.float32)
    variance = np.empty_like(mean) if batches > 1 else None
    for rows in _row_blocks(mean):
        radiance, coverage = (
            np.ascontiguousarray(np.moveaxis(_stacked(part, rows), -1, 0)) for part in (light, weight)
        )
        total = coverage.mean(axis=1)
        covered = np.broadcast_to(total > 0, (len(radiance), *total.shape[1:]))
        average = np.divide(radiance.mean(axis=1), total, out=np.zeros(covered.shape), where=covered)
        mean[rows] = np.moveaxis(average, 0, -1)
        if variance is not None:
            radiance -= average[:, None] * coverage
            spread = np.einsum("cnij,cnij->cij", radiance, radiance) / (len(light) - 1) / len(light)
            spread = np.divide(spread, np.square(total), out=np.zeros(covered.shape), where=covered)
            variance[rows] = np.moveaxis(spread, 0, -1)
    return Estimate(mean, variance, nan_pixels)


def channels(passes: Sequence[Picture], which: slice) -> list[Float[np.ndarray, "h w k"]]:
    """Some channels of every pass, not copied."""
    return [picture[..., which] for picture in passes]


def _stacked(passes: Sequence[Picture], rows: slice) -> Float[np.ndarray, "n rows w c"]:
    return np.stack([picture[rows] for picture in passes], dtype=np.float64)


def _row_blocks(picture: Picture) -> Iterator[slice]:
    """Rows to average at a time: their float64 copies stay in the processor's cache."""
    height, width = picture.shape[:2]
    step = max(1, PIXELS_PER_BLOCK // width)
    return (slice(start, start + step) for start in range(0, height, step))


def derive_seed(*parts: int | str) -> int:
    """A 32-bit seed that depends on all parts, the same in every process and version of Python.

    Raises:
        UnirenderError: a part is neither a whole number nor a text.
    """
    for part in parts:
        if not isinstance(part, str | Integral):
            raise UnirenderError(f"seed: got {part!r:.60}, expected a whole number")
    plain = tuple(str(part) if isinstance(part, str) else int(part) for part in parts)  # numpy's print otherwise
    return int.from_bytes(hashlib.sha256(repr(plain).encode()).digest()[:4], "little")


def _render(
    scene: Any, sensor: Any, integrator: Any, spp: int, seed: int, counters: Counters
) -> Float[np.ndarray, "h w c"]:
    start = time.perf_counter()
    rendered = mitsuba().render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
    picture = np.asarray(rendered, dtype=np.float32)  # waits for the render; on the CPU a view of its memory
    counters.render_seconds += time.perf_counter() - start
    counters.renders += 1
    return picture
