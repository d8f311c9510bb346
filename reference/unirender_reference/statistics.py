"""Are two Monte Carlo pictures the same picture? A per-pixel test with a corrected threshold.

"PSNR > 40" misses a 12 % error in roughness; this does not. For every value of the two estimates

    t = (a - b) / sqrt(var_a + var_b)

follows Student's distribution (Welch's degrees of freedom: the variances come from a few batches). Two conditions have
to hold, each against another kind of error:

    min p  >= 1 - (1 - alpha)^(1/n)             one wrong pixel (Sidak's correction for n values)
    share of p >= 0.05 at least share_bar(N)    a small error everywhere (0.95 is expected of N pixels)
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import bdtrc, bdtrik, stdtr

from unirender.errors import UnirenderError

FAMILY_ALPHA = 0.01
LEVEL = 0.05
PASS_SHARE = 0.92  # the share condition of large pictures
ROUNDING = 1e-4  # relative difference that storage and summation order may cause


@dataclass(frozen=True)
class ZTest:
    """Outcome of `z_test`.

    Attributes:
        min_p: smallest p-value.
        pass_share: share of values with p >= `LEVEL`.
        passed: both conditions hold.
        threshold: Sidak's bound on `min_p`.
        values: how many values were compared.
        share_threshold: `share_bar`, the bound on `pass_share`.
    """

    min_p: float
    pass_share: float
    passed: bool
    threshold: float
    values: int
    share_threshold: float

    def __str__(self) -> str:
        return (
            f"z-test of {self.values} values {'passed' if self.passed else 'FAILED'}: min p {self.min_p:.3g} "
            f"(threshold {self.threshold:.3g}), pass share {self.pass_share:.4f} (threshold {self.share_threshold:.4g})"
        )


def p_values(
    mean_a: Float[np.ndarray, "*s"],
    var_a: Float[np.ndarray, "*s"],
    mean_b: Float[np.ndarray, "*s"],
    var_b: Float[np.ndarray, "*s"],
    batches_a: int = 8,
    batches_b: int = 8,
    rounding: float = ROUNDING,
) -> Float[np.ndarray, "*s"]:
    """Two-sided p-value of each pair of means being equal.

    Args:
        mean_a, mean_b: estimates.
        var_a, var_b: variances of these means.
        batches_a, batches_b: how many batches each variance was taken from.
        rounding: relative standard deviation added for rounding (half precision: 5e-4).

    Raises:
        UnirenderError: shapes differ.
    """
    a, b, va, vb = (np.asarray(array, dtype=np.float64) for array in (mean_a, mean_b, var_a, var_b))
    if not a.shape == b.shape == va.shape == vb.shape:
        raise UnirenderError(
            f"z-test: got shapes {a.shape}, {va.shape}, {b.shape}, {vb.shape}, expected four equal ones"
        )
    floor = np.square(rounding * np.maximum(np.abs(a), np.abs(b)) + 1e-7)
    total = va + vb
    welch = np.square(va) / max(batches_a - 1, 1) + np.square(vb) / max(batches_b - 1, 1)
    smallest = min(batches_a, batches_b) - 1
    freedom = np.divide(np.square(total), welch, out=np.full_like(total, smallest), where=welch > 0)
    t = np.abs(a - b) / np.sqrt(total + floor)
    return 2 * stdtr(freedom, -t)


def share_bar(pixels: int, alpha: float) -> float:
    """The least share of values with p >= `LEVEL` that equal pictures reach with probability 1 - `alpha`.

    The number of independent values is that of the pixels: the channels of one share their samples and stray together
    (correlation near 1), so three of them can fail at once. That many of N pixels fail is binomial with the rate
    `LEVEL`; the bar is its quantile at `alpha`. Small pictures need it: of 150 equal pixels, 4 in 100 times fewer than
    0.92 pass. In large ones the quantile approaches 0.95, but noise that is skewed takes the share below it in pictures
    of any size; the bar therefore never exceeds `PASS_SHARE`.
    """
    most = max(int(np.ceil(bdtrik(1 - alpha, pixels, LEVEL))), 0)
    if most > 0 and bdtrc(most - 1, pixels, LEVEL) <= alpha:  # the inverse was rounded up
        most -= 1
    return min(PASS_SHARE, (pixels - most) / pixels)


def z_test(
    mean_a: Float[np.ndarray, "h w c"],
    var_a: Float[np.ndarray, "h w c"],
    mean_b: Float[np.ndarray, "h w c"],
    var_b: Float[np.ndarray, "h w c"],
    mask: Float[np.ndarray, "h w 1"] | None = None,
    *,
    batches_a: int = 8,
    batches_b: int = 8,
    rounding: float = ROUNDING,
    alpha: float = FAMILY_ALPHA,
) -> ZTest:
    """Tests that two independent estimates have the same expectation in every pixel with mask > 0.5.

    Arguments as `p_values`; a mask of None compares all pixels; `alpha` is the chance that equal pictures fail one
    condition, and so at most 2 `alpha` that they fail (a test file with many comparisons takes a smaller one).

    Raises:
        UnirenderError: shapes differ, the mask is empty, or `alpha` is no chance between 0 and 1.
    """
    if not 0 < alpha < 1:
        raise UnirenderError(f"z-test: got alpha {alpha:g}, expected a chance between 0 and 1")
    p = p_values(mean_a, var_a, mean_b, var_b, batches_a, batches_b, rounding)
    if mask is not None:
        p = p[np.broadcast_to(np.asarray(mask) > 0.5, p.shape)]
    if p.size == 0:
        raise UnirenderError("z-test: got an empty mask, expected at least one pixel")
    threshold = -np.expm1(np.log1p(-alpha) / p.size)
    bar = share_bar(p.size // mean_a.shape[-1], alpha)
    min_p, share = float(p.min()), float((p >= LEVEL).mean())
    return ZTest(min_p, share, bool(min_p >= threshold and share >= bar), float(threshold), int(p.size), bar)
