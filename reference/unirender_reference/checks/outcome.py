"""`Check`: one measured statistic, the threshold it has to meet, and the verdict."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from unirender_reference.passes import Estimate
from unirender_reference.statistics import LEVEL, ZTest, z_test

ALPHA = 1e-3  # chance that a z-test of equal pictures fails, so that a table of a dozen rarely cries wolf
CONDITION_ALPHA = ALPHA / 2  # of each of its two conditions
BATCHES = 16


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        name: as on the command line.
        statistic: what `value` is.
        value: measured by this run.
        threshold: what `value` is compared with.
        relation: "<=" or ">=": passed where `value relation threshold`.
        passed: the verdict.
        note: sample sizes, tolerances, second statistics.
        seconds: wall clock.
    """

    name: str
    statistic: str
    value: float
    threshold: float
    relation: Literal["<=", ">="]
    passed: bool
    note: str = ""
    seconds: float = 0.0


def bounded(name: str, statistic: str, value: float, threshold: float, note: str = "") -> Check:
    """An error that has to stay below a threshold; NaN fails."""
    return Check(name, statistic, value, threshold, "<=", bool(value <= threshold), note)


def against_estimate(
    name: str,
    mean_a: Float[np.ndarray, "*s h w c"],
    var_a: Float[np.ndarray, "*s h w c"],
    mean_b: Float[np.ndarray, "*s h w c"],
    var_b: Float[np.ndarray, "*s h w c"],
    mask: np.ndarray,
    note: str = "",
    batches: tuple[int, int] = (BATCHES, BATCHES),
    rounding: float = 1e-4,
) -> Check:
    """The z-test of two estimates.

    The statistic is Sidak's p of all values together, or the share of values that pass where that alone fails.

    Args:
        mean_a, var_a, mean_b, var_b: estimates and their variances.
        mask: True where values count, `[*s h w]`.
        note: goes before the pass share.
        batches: that the two variances were taken from.
        rounding: relative standard deviation of what is no noise: float32, quadrature.
    """
    width, channels = mean_a.shape[-2:]

    def flat(array: np.ndarray, channels: int = channels) -> np.ndarray:
        return np.asarray(array, np.float64).reshape(-1, width, channels)

    test = z_test(
        flat(mean_a),
        flat(var_a),
        flat(mean_b),
        flat(var_b),
        flat(mask, 1),
        batches_a=batches[0],
        batches_b=batches[1],
        rounding=rounding,
        alpha=CONDITION_ALPHA,
    )
    return _from_z_test(name, test, note)


def against_truth(
    name: str,
    estimates: list[Estimate],
    truths: list[Float[np.ndarray, "h w c"]],
    mask: np.ndarray,
    note: str = "",
    rounding: float = 1e-4,
) -> Check:
    """The z-test of estimates against numbers without noise: closed forms or quadrature with an error of `rounding`.

    Args:
        estimates: with variances from `BATCHES` batches; as many channels are compared as the truth has.
        truths: one for each estimate.
        mask, note, rounding: as `against_estimate`; the mask is that of every estimate.
    """
    channels = truths[0].shape[-1]
    mean = np.stack([estimate.mean[..., :channels] for estimate in estimates])
    variance = np.stack([estimate.variance[..., :channels] for estimate in estimates if estimate.variance is not None])
    truth = np.stack(truths)
    many = np.broadcast_to(mask, mean.shape[:-1])
    return against_estimate(name, mean, variance, truth, np.zeros_like(truth), many, note, rounding=rounding)


def _from_z_test(name: str, test: ZTest, note: str) -> Check:
    family_p = float(-np.expm1(test.values * np.log1p(-np.minimum(test.min_p, 1 - 1e-12))))
    share = f"{test.pass_share:.3f} of {test.values} values have p >= {LEVEL} (at least {test.share_threshold:.3f})"
    note = f"{note}; {share}" if note else share
    if test.min_p >= test.threshold and not test.passed:
        statistic = f"share of p >= {LEVEL}"
        note = f"{note}; p {family_p:.3g}"
        return Check(name, statistic, test.pass_share, test.share_threshold, ">=", passed=False, note=note)
    return Check(name, "p (Sidak)", family_p, CONDITION_ALPHA, ">=", test.passed, note)
