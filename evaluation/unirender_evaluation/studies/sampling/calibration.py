"""How well the spread of diffusion samples tells their error: definitions, on arrays and nothing else.

Notation: x_1 .. x_N samples of one value (a pixel's channel), m their mean, s their standard deviation (N - 1 in the
denominator), y the truth, w a pixel's weight. If truth and samples are draws of one distribution, then
E (m - y)^2 = (1 + 1/N) E s^2, whatever its shape.

    ratio        sqrt(E_w (m - y)^2) / sqrt((1 + 1/N) E_w s^2); 1: calibrated, above 1: too sure
    coverage     weighted share of truths inside m +- q s sqrt(1 + 1/N), q the 95 % quantile of Student's t with N - 1
                 degrees of freedom: 0.90 for normal distributions of any widths
    rank         Spearman's correlation of spread and error, pixels of weight >= 0.5: sqrt of the channels' mean s^2 and
                 (m - y)^2
    rank, scenes the same between scenes, over all of a scene's pixels
    bins         pixels by the octave of their spread: for the reliability curve

Values are compared as scored: albedo, s and d as display values (clipped, sRGB), normals by component, materials as
they are, light as ln(x + 0.01) at the prediction's texels, weighted by solid angle; all else by coverage.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata
from scipy.stats import t as student_t

from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import texel_solid_angles
from unirender.light.resampling import resample_environment
from unirender_evaluation.metrics import LOG_EPSILON

MAPS = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment")
CONFIDENCE = 0.90  # of the interval
INSIDE = 0.5  # weight from which a pixel takes part in a rank correlation
LEAST_RANKED = 3  # pixels or scenes
CONSTANT = 1e-9  # relative difference that is rounding
LOW_OCTAVE, HIGH_OCTAVE = -12, 3  # spreads below 2^-12 count in the first bin, above 2^3 in the last


@dataclass(frozen=True)
class Bin:
    """Pixels whose spread lies in [2^octave, 2^(octave + 1))."""

    octave: int  # of the spread
    weight: float  # sum of the pixels' weights, as a share of the scene's
    squared_error: float  # weighted sum of (m - y)^2
    variance: float  # weighted sum of (1 + 1/N) s^2: what the squared error should be


@dataclass(frozen=True)
class Calibration:
    """One map of one scene."""

    squared_error: float  # E_w (m - y)^2
    variance: float  # E_w s^2
    expected: float  # (1 + 1/N) E_w s^2
    coverage: float  # of the interval
    rank: float | None  # between pixels; None where spread or error is the same everywhere
    bins: tuple[Bin, ...]  # those that have pixels

    def values(self, name: str) -> dict[str, float]:
        """As a record's values."""
        found = {"squared_error": self.squared_error, "variance": self.variance, "expected": self.expected}
        found |= {"coverage": self.coverage} | ({} if self.rank is None else {"rank": self.rank})
        for bin_ in self.bins:
            parts = {"weight": bin_.weight, "squared_error": bin_.squared_error, "variance": bin_.variance}
            found |= {f"bin[{bin_.octave}].{part}": value for part, value in parts.items()}
        return {f"{name}.spread.{key}": value for key, value in found.items()}

    @classmethod
    def of_values(cls, name: str, values: Mapping[str, float]) -> "Calibration | None":
        """Inverse of `values`; None where the record has none of that map."""
        prefix = f"{name}.spread."
        own = {key.removeprefix(prefix): value for key, value in values.items() if key.startswith(prefix)}
        if not own:
            return None
        octaves = [k for k in range(LOW_OCTAVE, HIGH_OCTAVE + 1) if f"bin[{k}].weight" in own]
        bins = tuple(
            Bin(k, *(own[f"bin[{k}].{part}"] for part in ("weight", "squared_error", "variance"))) for k in octaves
        )
        totals = {key: own[key] for key in ("squared_error", "variance", "expected", "coverage")}
        return cls(**totals, rank=own.get("rank"), bins=bins)


@dataclass(frozen=True)
class Pooled:
    """One map over several scenes, all of which count alike."""

    rms_error: float  # of the mean
    rms_spread: float  # root of the mean s^2
    ratio: float  # see the module; infinite without spread
    rank_scenes: float | None  # None with fewer than three scenes
    bins: tuple[Bin, ...]  # weights and sums added up


def calibrate(
    samples: Float[np.ndarray, "n p c"], truth: Float[np.ndarray, "p c"], weights: Float[np.ndarray, " p"]
) -> Calibration:
    """Spread against error of one map.

    Args:
        samples: at least two.
        truth: of the same pixels.
        weights: >= 0, not all 0.

    Raises:
        UnirenderError: fewer than two samples, or no weight.
    """
    count, total = len(samples), float(weights.sum(dtype=np.float64))
    if count < 2 or total <= 0:
        raise UnirenderError(
            f"calibration: got {count} samples and a weight of {total:g}, expected at least 2 samples and an object"
        )
    x, w = samples.astype(np.float64), weights.astype(np.float64) / total
    error, variance = x.mean(axis=0) - truth, x.var(axis=0, ddof=1)
    inflation = 1 + 1 / count
    half_width = student_t.ppf(0.5 + CONFIDENCE / 2, count - 1) * np.sqrt(inflation * variance)
    inside = (np.abs(error) <= half_width).mean(axis=1)
    pixel_error, pixel_variance = np.square(error).mean(axis=1), variance.mean(axis=1)
    covered = weights >= INSIDE * weights.max()
    return Calibration(
        squared_error=float(w @ pixel_error),
        variance=float(w @ pixel_variance),
        expected=float(w @ pixel_variance) * inflation,
        coverage=float(w @ inside),
        rank=rank_correlation(pixel_variance[covered], pixel_error[covered]),
        bins=_bins(pixel_variance, pixel_error, w, inflation),
    )


def rank_correlation(spread: Float[np.ndarray, " n"], error: Float[np.ndarray, " n"]) -> float | None:
    """Spearman's; None for fewer than three values, or where one side is constant to rounding."""
    if len(spread) < LEAST_RANKED or any(np.allclose(x, x[0], rtol=CONSTANT, atol=0) for x in (spread, error)):
        return None
    return float(np.corrcoef(rankdata(spread), rankdata(error))[0, 1])


def pool(found: Sequence[Calibration]) -> Pooled:
    """Over at least one scene."""
    error, variance, expected = (
        np.array([getattr(one, name) for one in found]) for name in ("squared_error", "variance", "expected")
    )
    mean_error, mean_expected = float(error.mean()), float(expected.mean())
    sums: dict[int, list[float]] = {}
    for bin_ in (bin_ for one in found for bin_ in one.bins):
        total = sums.setdefault(bin_.octave, [0.0, 0.0, 0.0])
        for i, value in enumerate((bin_.weight, bin_.squared_error, bin_.variance)):
            total[i] += value
    return Pooled(
        rms_error=math.sqrt(mean_error),
        rms_spread=math.sqrt(float(variance.mean())),
        ratio=math.sqrt(mean_error / mean_expected) if mean_expected > 0 else math.inf,
        rank_scenes=rank_correlation(variance, error),
        bins=tuple(Bin(octave, *sums[octave]) for octave in sorted(sums)),
    )


def scene_calibration(samples: Sequence[Intrinsics], truth: Intrinsics) -> dict[str, Calibration]:
    """Every map that samples and truth have, of one scene."""
    found = {}
    for name in MAPS:
        target = getattr(truth, name)
        drawn = [getattr(sample, name) for sample in samples]
        if target is None or any(value is None for value in drawn):
            continue
        if name == "environment":
            rows, columns = drawn[0].shape[:2]
            if target.shape != drawn[0].shape:
                target = resample_environment(target, (rows, columns))
            weights = texel_solid_angles(rows, columns).ravel()
        else:
            weights = truth.require("mask")["mask"].ravel()
        flat = [compared(name, value).reshape(-1, value.shape[-1]) for value in (*drawn, target)]
        found[name] = calibrate(np.stack(flat[:-1]), flat[-1], weights)
    return found


def compared(name: str, value: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """A map in the units in which spread and error are compared."""
    if name in ("albedo", "specular", "diffuse"):
        return image_srgb(value)
    return np.log(np.maximum(value, 0) + LOG_EPSILON) if name == "environment" else value


def _bins(
    variance: Float[np.ndarray, " p"], error: Float[np.ndarray, " p"], w: Float[np.ndarray, " p"], inflation: float
) -> tuple[Bin, ...]:
    octave = np.floor(0.5 * np.log2(np.maximum(variance, 4.0**LOW_OCTAVE))).astype(int).clip(LOW_OCTAVE, HIGH_OCTAVE)
    made = []
    for k in sorted(set(octave[w > 0].tolist())):
        own = w * (octave == k)
        made.append(Bin(k, float(own.sum()), float(own @ error), float(own @ variance) * inflation))
    return tuple(made)
