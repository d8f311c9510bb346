"""How many passes an estimate of so many samples takes, and how many of them are kept.

A pass is a full multi-jittered grid of samples and fits into one wavefront; of many passes the means of
equal groups are kept (`passes`).
"""

import itertools
import math
from numbers import Integral

from unirender.errors import UnirenderError

SAMPLES_PER_PASS = 1 << 23  # wavefront size: memory grows with it
MOST_KEPT = 32  # passes, or means of groups of them, in memory
PIXELS_KEPT = 1 << 25  # in memory, of all of them: of pictures above 1024 x 1024 fewer than `MOST_KEPT` are kept
MOST_PASSES = 1_000_000  # of one image: more take days, and finding how to divide them takes long, too
MOST_SPLITS = 8  # passes to make of one that is no full grid: small passes are hardly stratified


def pass_count(spp: int, batches: int, most: int) -> int:
    """The fewest passes (at least `batches`) that divide `spp` into equal pass sizes, each a full multi-jittered grid.

    Mitsuba's multi-jittered sampler rounds other sizes up, with a warning. More than `MOST_KEPT` passes can be put into
    equal groups, at least `batches` and at most `MOST_KEPT` (or `MOST_SPLITS` times `batches`) of them.

    Args:
        spp: samples per pixel in all.
        batches: least number of passes.
        most: largest number of samples per pixel in one pass.

    Raises:
        UnirenderError: fewer samples than batches, more than `MOST_PASSES`, or more than `MOST_SPLITS` times as many as
            `batches` and `most` ask for (67 samples in one batch are 67 passes of one sample).
    """
    if not isinstance(spp, Integral):
        raise UnirenderError(f"spp: got {spp!r:.60}, expected a whole number of samples, at least 1")
    if spp < 1 or batches < 1 or batches > spp:
        raise UnirenderError(f"spp: got {spp} in {batches} batches, expected at least one sample in each")
    if spp > (limit := MOST_PASSES * max(most, 1)):
        raise UnirenderError(
            f"spp: got {spp}, expected at most {limit:,}, which {MOST_PASSES:,} passes take; average several seeds"
        )
    if (count := _grid_passes(spp, batches, most)) is not None:
        return count
    below = next(n for n in range(spp - 1, 0, -1) if n < batches or _grid_passes(n, batches, most) is not None)
    above = next_spp(spp, batches, most)
    advice = f"use {below} or {above}" if below >= batches else f"use {above}"
    raise UnirenderError(
        f"spp: got {spp} in {batches} batches, expected a number that divides into a few full multi-jittered grids "
        f"(4, 6, 9, 16, 64, ... samples a pass); {advice}"
    )


def next_spp(spp: int, batches: int, most: int) -> int:
    """The least number of samples per pixel >= `spp` that `pass_count` divides; `spp` itself where it can."""
    return next(n for n in itertools.count(max(spp, batches)) if _grid_passes(n, batches, most) is not None)


def _grid_passes(spp: int, batches: int, most: int) -> int | None:
    """`pass_count`, or None where there are too many."""
    most = max(most, 1)
    needed = max(batches, -(-spp // most))
    for count in range(needed, min(spp, needed * MOST_SPLITS) + 1):
        size = spp // count
        if spp % count == 0 and size % math.isqrt(size) == 0 and _groupable(count, batches):
            return count
    return None


def _groupable(count: int, batches: int) -> bool:
    most = max(MOST_KEPT, MOST_SPLITS * batches)
    return count <= most or any(count % groups == 0 for groups in range(batches, most + 1))


def kept_passes(count: int, batches: int, pixels: int) -> int:
    """How many passes, or means of equal groups of passes, of a picture of `pixels` are kept of `count`.

    All of them up to `MOST_KEPT` (and `PIXELS_KEPT` in all); else the most groups below that, but at least `batches`.
    """
    most = max(batches, min(MOST_KEPT, PIXELS_KEPT // pixels))
    groups = [n for n in range(batches, count + 1) if count % n == 0]
    return max((n for n in groups if n <= most), default=groups[0])
