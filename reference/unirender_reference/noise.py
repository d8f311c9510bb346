"""The noise floor of a render, and renders that go on until it is reached.

The *noise floor* of a picture is the masked sRGB PSNR that a noise-free prediction would score against it: what no
method can beat. Notation: m the mean of the batches, s its standard deviation (both divided by coverage where the
picture is premultiplied), D the display transform `srgb(clip(., 0, 1))`, a the coverage.

    noise_floor_db   by the delta method, D'(m)^2 s^2: exact for little noise
    floor_range      w (D(m) - D(m - s))^2 + (1 - w) (D(m + s) - D(m))^2,  w = (1 + min(s / m, 1)^2) / 2

The second follows the display curve instead of its tangent. It matters where few samples carry a pixel's light (glints,
pixels at the silhouette that a sample in hundreds hits): the mean is skewed, the curve steep near black, and the delta
method sees a sixth of what the samples that missed have cost. `docs/noise.md` has the derivation and what was measured.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from unirender.color import MIN_MASK, display_slope, image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender_reference.passes import Estimate
from unirender_reference.sample_counts import SAMPLES_PER_PASS

FLOOR_BATCHES = 16
FIRST_SPP = 64
MAX_SPP = 1 << 16
MARGIN_DB = 0.15  # aimed at above the floor, so that few pictures need another render
UNDERSHOOT = 0.7  # of the predicted samples: larger passes are better stratified, and need fewer
MOST_GROWTH = 4.0  # of the samples in one step: of few samples the noise looks larger than it is
SIGMAS = 2.0  # of the error of the noise estimate itself, that a floor is to be reached by

Picture = Float[np.ndarray, "h w c"]
Mask = Float[np.ndarray, "h w 1"]
Measure = Callable[[Picture, Picture], tuple[float, float]]


@dataclass(frozen=True)
class FloorEstimate:
    """A picture rendered to a floor (float64).

    Attributes:
        mean: (h, w, c), all channels of the renders.
        variance: of `mean`.
        spp: samples per pixel of all renders together.
        floor_db: reached, as expected from the batches.
        sure_db: reached even if the noise is `SIGMAS` standard errors worse than it looks; sampling stops on this one.
        asked_db: the floor asked for.
        nan_pixels: rendered again with another seed.
    """

    mean: Picture
    variance: Picture
    spp: int
    floor_db: float
    sure_db: float
    asked_db: float
    nan_pixels: int = 0

    @property
    def reached(self) -> bool:
        """False where `max_spp` ended the sampling."""
        return self.sure_db >= self.asked_db

    @property
    def estimate(self) -> Estimate:
        """The picture as a renderer returns it, float32."""
        return Estimate(self.mean.astype(np.float32), self.variance.astype(np.float32), self.nan_pixels)


def masked_noise_mse(
    mean: Picture, variance: Picture, mask: Mask, premultiplied: bool, space: Literal["srgb", "linear"] = "srgb"
) -> float:
    """Expected squared error of a noise-free prediction against a noisy picture, by the delta method.

    Args:
        mean: linear picture.
        variance: of `mean`.
        mask: coverage: the weight of a pixel.
        premultiplied: whether `mean` is.
        space: in which the error is taken, both clipped to [0, 1].
    """
    mask = _wide(mask)
    scale = np.maximum(mask, MIN_MASK) if premultiplied else 1.0
    error = display_slope(mean / scale, space) ** 2 * variance / np.square(scale)
    return float(np.sum(mask * error) / (error.shape[-1] * np.sum(mask)))


def _wide(mask: Mask) -> Mask:
    """A mask of half floats, as an EXR has it, as float32: its sum is beyond them, and squares of its edges are 0."""
    return np.asarray(mask, np.result_type(mask, np.float32))


def noise_floor_db(mean: Picture, variance: Picture, mask: Mask, premultiplied: bool) -> float:
    """Masked sRGB PSNR in dB that a noise-free prediction would score, by the delta method; inf without noise."""
    return decibels(masked_noise_mse(mean, variance, mask, premultiplied))


def floor_range(mean: Picture, variance: Picture, mask: Mask, premultiplied: bool) -> tuple[float, float]:
    """(expected, sure) noise floor in dB along the display curve (see the module).

    The second adds `SIGMAS` standard errors of the mean squared error, as if each pixel's noise were one rare event:
    its own square is then the variance of what was seen of it.

    Args:
        mean: linear picture.
        variance: of `mean`, from batches.
        mask: coverage: the weight of a pixel.
        premultiplied: whether `mean` is.
    """
    mask = _wide(mask)
    scale = np.maximum(mask, MIN_MASK) if premultiplied else 1.0
    m = np.asarray(mean / scale, np.float64)
    s = np.sqrt(np.asarray(variance, np.float64)) / scale
    skew = np.square(np.minimum(np.divide(s, m, out=np.ones_like(s), where=m > s), 1.0))
    shown = image_srgb(m)
    down, up = np.square(shown - image_srgb(m - s)), np.square(image_srgb(m + s) - shown)
    pixels = (mask * (down * (1 + skew) + up * (1 - skew)) / 2).sum(axis=-1)
    total = mask.sum(dtype=np.float64) * m.shape[-1]
    error, spread = pixels.sum() / total, math.sqrt(np.square(pixels).sum()) / total
    return decibels(error), decibels(error + SIGMAS * spread)


def measured_floor_db(picture: Estimate, converged: Estimate, mask: Mask, premultiplied: bool) -> float:
    """Masked sRGB PSNR in dB of a picture against an independent one with far more samples, less what noise that one
    has left by `floor_range`: the floor itself, not an estimate of it; inf where nothing is left.

    Args:
        picture: whose floor is measured.
        converged: the same scene; needs its variance.
        mask: coverage: the weight of a pixel.
        premultiplied: whether both are.

    Raises:
        UnirenderError: `converged` has no variance.
    """
    if converged.variance is None:
        raise UnirenderError(
            "noise floor: got a render without variance, expected one from several batches; render it with batches=16"
        )
    shown, true = (
        image_srgb(unpremultiply(x.mean[..., :3], mask) if premultiplied else x.mean[..., :3]).astype(np.float64)
        for x in (picture, converged)
    )
    error = float((mask * np.square(shown - true)).sum() / (3 * mask.sum(dtype=np.float64)))
    left_db, _ = floor_range(converged.mean[..., :3], converged.variance[..., :3], mask, premultiplied)
    return decibels(max(error - 10 ** (-left_db / 10), 0.0))


def full_spp(wanted: float, batches: int, pixels: int) -> int:
    """The least samples per pixel >= `wanted` in a multiple of `batches` passes, each of them a full multi-jittered
    grid and small enough for one wavefront of a picture of `pixels`."""
    most = max(1, SAMPLES_PER_PASS // pixels)
    rounds = 0
    while True:
        rounds += 1
        passes = batches * rounds
        size = max(math.ceil(wanted / passes), 1)
        while size % math.isqrt(size):
            size += 1
        if size <= most or size == 1:
            return passes * size


def combined(a: FloorEstimate, b: FloorEstimate, measure: Measure) -> FloorEstimate:
    """Two independent renders as one, each weighted by its samples; `measure` as in `render_to_floor`."""
    share = b.spp / (a.spp + b.spp)
    mean = (1 - share) * a.mean + share * b.mean
    variance = (1 - share) ** 2 * a.variance + share**2 * b.variance
    floor_db, sure_db = measure(mean, variance)
    return FloorEstimate(mean, variance, a.spp + b.spp, floor_db, sure_db, a.asked_db, a.nan_pixels + b.nan_pixels)


def render_to_floor(
    render: Callable[[int, int], Estimate],
    mask: Mask,
    floor_db: float,
    *,
    premultiplied: bool,
    spp: int = FIRST_SPP,
    max_spp: int = MAX_SPP,
    seed: int = 0,
    batches: int = FLOOR_BATCHES,
    measure: Measure | None = None,
) -> FloorEstimate:
    """Adds samples until the noise floor is reached, or the samples `max_spp`.

    The error falls as 1 / samples, so that each estimate says how many are missing. Every sample counts: the renders
    are averaged, each with a seed of its own.

    Args:
        render: (spp, seed) -> estimate with its variance from `batches` passes.
        mask: coverage.
        floor_db: asked for.
        premultiplied: an image is premultiplied by coverage, s and d are not.
        spp: samples per pixel of the first render, which says how many it takes.
        max_spp: about where sampling ends, reached or not (`FloorEstimate.reached`).
        seed: of the first render; each further one takes the next.
        batches: of `render`; 16 or more, since the variance is known no better than its batches are many.
        measure: (mean, variance) -> (expected, sure) floor in dB; `floor_range` if None.

    Raises:
        UnirenderError: the floor is no number of decibels, the mask is empty, or a render comes without its variance.
    """
    if not 0 < floor_db < math.inf:
        raise UnirenderError(f"noise floor: got {floor_db} dB, expected a finite number above 0")
    if not mask.any():
        raise UnirenderError("noise floor: got an empty mask, expected an object in the picture; drop the scene")

    def own_range(mean: Picture, variance: Picture) -> tuple[float, float]:
        return floor_range(mean[..., :3], variance[..., :3], mask, premultiplied)

    judge = measure or own_range

    def draw(wanted: float, number: int) -> FloorEstimate:
        count = full_spp(wanted, batches, mask.size)
        found = render(count, seed + number)
        if found.variance is None:
            raise UnirenderError(
                "noise floor: got a render without variance, expected one from several batches; "
                "render it with batches=16"
            )
        mean, variance = found.mean.astype(np.float64), found.variance.astype(np.float64)
        return FloorEstimate(mean, variance, count, *judge(mean, variance), floor_db, found.nan_pixels)

    found, number = draw(spp, 0), 0
    while not found.reached and found.spp < max_spp:
        number += 1
        growth = 10 ** ((floor_db - found.sure_db + MARGIN_DB) / 10)
        if growth > 2:
            growth = min(max(UNDERSHOOT * growth, 2), MOST_GROWTH)
        more = draw(min(found.spp * growth, max_spp) - found.spp, number)
        found = combined(found, more, judge)
    return found


def decibels(error: float) -> float:
    """PSNR of a mean squared error, for a peak of 1; inf for an error of exactly 0."""
    return math.inf if error == 0 else -10 * math.log10(error)
