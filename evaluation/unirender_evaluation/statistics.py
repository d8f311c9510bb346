"""Intervals and paired tests, over objects.

Samples of one object (several lights, several edits) are not independent, so intervals are over objects: Student's t
with the variance of a ratio of sums, since objects may have unequal numbers of samples (Cochran 1977, section 6.4); the
estimate is the plain mean over samples. On draws of 5 to 60 objects from stored results it holds the truth more often
than a bootstrap of objects does, on average over what is claimed (`pages.coverage`).

Of two objects Student's t is 12.7 standard errors wide to each side, and has no width at all where the two happen to
agree: below `FEWEST` objects there is no interval, and nothing is decided.

"A beats B" means: the paired 95 % interval of the difference excludes 0, on the better side.

All of this is for the lights that the suite has: a light that several objects share counts as often as they have it.
`crossed_estimate` counts lights as drawn, too.
"""

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CONFIDENCE = 0.95
FEWEST = 3  # objects from which on there is an interval
FEWEST_LIGHTS = 5  # from which on it is told what holds under others; Student's t is then 2.8 errors to each side
LEAST_SEEN = 0.1  # of the variance that lights make, in residuals: what all samples share is in none
METHOD = "Student's t"  # as protocol lines say it
CROSSED = f"{CONFIDENCE:.0%} over objects and lights, both as draws: two-way clusters, Student's t"
INTERVAL = f"{CONFIDENCE:.0%} interval over objects ({METHOD})"  # as notes do
UNTOLD = (
    f"Numbers of fewer than {FEWEST} objects, or under fewer than {FEWEST_LIGHTS} lights, have no ±: what they would "
    "be under others is not told."
)
UNPRINTED = f"Numbers of fewer than {FEWEST} objects have no ±: an interval of so few says next to nothing."


@dataclass(frozen=True)
class Estimate:
    """A mean with its interval.

    `low` and `high` are NaN where no interval exists: fewer than `FEWEST` clusters, or an infinite value among them.
    """

    mean: float
    low: float
    high: float
    n: int  # samples
    clusters: int  # objects

    @property
    def half_width(self) -> float:
        """Half the width of the interval, NaN where there is none."""
        return (self.high - self.low) / 2


def unprinted_note(estimates: Iterable[Estimate | None]) -> tuple[str, ...]:
    """The note below a table that has numbers without ± for being of few objects; empty where it has none."""
    return (UNPRINTED,) if any(e and math.isfinite(e.mean) and e.clusters < FEWEST for e in estimates) else ()


def mean_estimate(
    values: Sequence[float] | Float[np.ndarray, " n"], clusters: Sequence[Hashable] | None = None
) -> Estimate:
    """Mean with its interval over clusters.

    Args:
        values: one per sample; inf allowed (then there is no interval), NaN not.
        clusters: what each sample belongs to, e.g. its object; None = every sample for itself.

    Raises:
        UnirenderError: if there are no values, a value is NaN, or lengths differ.
    """
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or x.size == 0 or np.isnan(x).any():
        raise UnirenderError(f"mean: got {x.size} values of shape {x.shape}, expected at least one and no NaN")
    labels = list(range(x.size)) if clusters is None else list(clusters)
    if len(labels) != x.size:
        raise UnirenderError(f"mean: got {x.size} values and {len(labels)} cluster labels, expected as many")
    count, mean = len(set(labels)), float(x.mean())
    if count < FEWEST or not np.isfinite(x).all():
        return Estimate(mean, math.nan, math.nan, x.size, count)
    half = student_half_width(_ratio_variance(*_cluster_sums(x, labels)), count - 1)
    return Estimate(mean, mean - half, mean + half, x.size, count)


def student_half_width(variance: float, degrees: int) -> float:
    """Half of the interval of a mean with this variance, estimated with so many degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees, (1 + CONFIDENCE) / 2) * math.sqrt(variance))


def _ratio_variance(sums: Float[np.ndarray, " k"], sizes: Int[np.ndarray, " k"]) -> float:
    """Variance of sum(sums) / sum(sizes), of independent clusters."""
    count = len(sums)
    residuals = sums - sizes * (sums.sum() / sizes.sum())
    return float(count / (count - 1) * np.square(residuals).sum() / sizes.sum() ** 2)


def crossed_estimate(
    values: Sequence[float] | Float[np.ndarray, " n"],
    objects: Sequence[str],
    lights: Sequence[tuple[str, ...]],
) -> Estimate:
    """Mean with its interval where objects and lights are both draws: samples that share any of them go together.

    Student's, with one degree of freedom less than the rarer of the two has members. The variance is that over objects
    plus that over lights less that of samples which share both, and which both have counted (Cameron, Gelbach and
    Miller 2011); where that is below one of the first two, the larger of them. Lights of a sample that has two, in one
    of whose places another sample has one of them, go together as well (dyads: Aronow, Samii and Assenova 2015).

    Args:
        values: one per sample; inf allowed (then there is no interval), NaN not.
        objects: of each sample.
        lights: of each sample, all that its value depends on, in their places: of a relit picture that of the input,
            then that it is relit by.

    Returns:
        No interval (NaN) of fewer than `FEWEST` objects or `FEWEST_LIGHTS` lights, nor where nearly all samples share
        one.

    Raises:
        UnirenderError: there are no values, one is NaN, or lengths differ.
    """
    x = np.asarray(values, dtype=np.float64)
    if not 0 < len(x) == len(objects) == len(lights) or np.isnan(x).any():
        raise UnirenderError(
            f"mean over objects and lights: got {len(x)} values, {len(objects)} objects and {len(lights)} lights, "
            "expected as many of each, at least one, and no NaN"
        )
    mean, counts = float(x.mean()), (len(set(objects)), light_count(lights))
    terms = _light_terms(tuple(objects), tuple(lights)) if counts[0] >= FEWEST and counts[1] >= FEWEST_LIGHTS else None
    if terms is None or not np.isfinite(x).all():
        return Estimate(mean, math.nan, math.nan, len(x), counts[0])
    over_objects = _ratio_variance(*_cluster_sums(x, objects))
    over_lights, over_both = (float((x - mean) @ (term @ (x - mean))) for term in terms)
    variance = max(over_objects + over_lights - over_both, over_objects, over_lights)
    half = student_half_width(variance, min(counts) - 1)
    return Estimate(mean, mean - half, mean + half, len(x), counts[0])


def light_count(lights: Sequence[tuple[str, ...]]) -> int:
    """How many lights samples have: of those that have several each, the fewest in one place."""
    return min(len(set(names)) for names in zip(*lights, strict=False))


@lru_cache(maxsize=16)  # of all rows and metrics of a table
def _light_terms(objects: tuple[str, ...], lights: tuple[tuple[str, ...], ...]) -> "list[csr_array] | None":
    """Quadratic forms of residuals, (n, n): variance over lights, and of what lights and objects share; None: untold.

    Each is scaled to be unbiased where samples differ by nothing but what it is over. With one light a sample, and as
    many samples each, this is the usual k / (k - 1) of k lights.
    """
    of_object, of_light = _belongs([(name,) for name in objects]), _belongs(lights)
    of_both = _belongs([tuple((name, light) for light in own) for name, own in zip(objects, lights, strict=True)])
    share_light, n = (of_light @ of_light.T).sign(), len(objects)
    terms = []
    for members, shared in ((of_light, share_light), (of_both, share_light * (of_object @ of_object.T))):
        sums, reach = members.sum(axis=0), shared @ members
        true = np.square(sums).sum()  # times n^2: variance of the mean, if each cluster adds a draw of variance 1
        seen = (members * reach).sum() - 2 / n * sums @ reach.sum(axis=0) + shared.sum() / n**2 * true
        if seen < LEAST_SEEN * true:
            return None
        terms.append(shared * (true / seen / n**2))
    return terms


def _belongs(labels: Sequence[tuple[Hashable, ...]]) -> "csr_array":
    """(n, k): 1 where a sample has a label."""
    from scipy.sparse import csr_array

    columns = {label: i for i, label in enumerate(dict.fromkeys(label for own in labels for label in own))}
    where = sorted({(row, columns[label]) for row, own in enumerate(labels) for label in own})
    return csr_array((np.ones(len(where)), tuple(zip(*where, strict=True))), shape=(len(labels), len(columns)))


def _cluster_sums(
    x: Float[np.ndarray, " n"], labels: Sequence[Hashable]
) -> tuple[Float[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Sum and number of the samples of each cluster, in the order of their first samples."""
    members: dict[Hashable, int] = {}
    index = np.array([members.setdefault(label, len(members)) for label in labels])
    return np.bincount(index, weights=x), np.bincount(index)


def paired_difference(
    a: Mapping[str, float],
    b: Mapping[str, float],
    clusters: Mapping[str, Hashable] | None = None,
) -> Estimate:
    """Mean of a - b over the samples that both have, with its paired interval.

    Args:
        a: sample -> value.
        b: sample -> value.
        clusters: sample -> what is drawn, e.g. its object; None = every sample for itself.

    Raises:
        UnirenderError: if the two share no sample, or a difference is not finite (two identical images: inf - inf).
    """
    common = sorted(a.keys() & b.keys())
    if not common:
        raise UnirenderError(f"paired test: the methods share no sample ({len(a)} and {len(b)} of their own)")
    pairs = np.array([(a[sample], b[sample]) for sample in common])
    with np.errstate(invalid="ignore"):  # inf - inf: refused below, by name
        differences = pairs[:, 0] - pairs[:, 1]
    if not np.isfinite(differences).all():
        bad = [sample for sample, d in zip(common, differences, strict=True) if not math.isfinite(d)]
        raise UnirenderError(
            f"paired test: the difference on {bad[0]!r} (and {len(bad) - 1} more) is not finite: an identical image "
            "has an infinite PSNR; compare the MSE"
        )
    labels = None if clusters is None else [clusters[sample] for sample in common]
    return mean_estimate(differences, labels)


def beats(
    a: Mapping[str, float],
    b: Mapping[str, float],
    *,
    higher_is_better: bool,
    clusters: Mapping[str, Hashable] | None = None,
) -> bool:
    """Whether a beats b: the paired 95 % interval excludes 0 on the better side.

    Without an interval (fewer than `FEWEST` objects in common) nothing beats anything.
    """
    difference = paired_difference(a, b, clusters)
    return difference.low > 0 if higher_is_better else difference.high < 0


def paired_p_value(a: Mapping[str, float], b: Mapping[str, float], clusters: Mapping[str, Hashable]) -> float:
    """Two-sided p of Student's t for no difference of a and b over the samples that both have; 1 with fewer than
    `FEWEST` clusters.

    Args:
        a: sample -> value.
        b: sample -> value; differences have to be finite, and one sample shared.
        clusters: sample -> what is drawn, e.g. its object.
    """
    from scipy.special import stdtr

    common = sorted(a.keys() & b.keys())
    x = np.array([a[sample] - b[sample] for sample in common])
    sums, sizes = _cluster_sums(x, [clusters[sample] for sample in common])
    if len(sums) < FEWEST or not x.mean():  # which may be the mean of every object, too
        return 1.0
    with np.errstate(divide="ignore"):  # differences that are all alike
        t = np.abs(x.mean()) / np.sqrt(_ratio_variance(sums, sizes))
    return float(2 * stdtr(len(sums) - 1, -t))


def holm(p_values: Sequence[float]) -> list[bool]:
    """Which of several hypotheses are refused, with a chance of one in twenty of any false refusal (Holm 1979)."""
    order = np.argsort(p_values, kind="stable")
    refused = [False] * len(p_values)
    for rank, index in enumerate(order):
        if p_values[index] > (1 - CONFIDENCE) / (len(p_values) - rank):
            break
        refused[index] = True
    return refused
