"""How often 95 % intervals hold the truth: `python -m unirender_evaluation.pages.coverage [SUITE [RESULTS]]`.

Draws paired differences of two rows on the objects and lights that a suite has, where objects, lights and pictures
differ by known amounts, and counts how often each interval (`statistics`) holds their mean. A second table takes what
the objects of stored results have for all there is, draws as few of them as a suite may have, and counts how often
their interval holds the mean of all: Student's t, which `statistics` has, and a bootstrap of objects.
"""

import math
import sys
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender_evaluation.claims import run_claims
from unirender_evaluation.comparisons import Selection, values_of
from unirender_evaluation.pages.findings import markdown_table
from unirender_evaluation.results.data import Results
from unirender_evaluation.results.file import read_results
from unirender_evaluation.statistics import (
    CONFIDENCE,
    FEWEST_LIGHTS,
    crossed_estimate,
    mean_estimate,
    paired_difference,
)
from unirender_evaluation.suites.suite import Suite, load_suite

TRUE = 1.0  # the mean difference
TRIALS = 1000
SPREADS = ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 2.0))  # of objects and lights; pictures: 1
DRAWS = 200  # of stored objects, for each number
COUNTS = (5, 10, 20, 30, 40, 50, 60)  # of objects that are drawn
RESAMPLES = 1000  # of a bootstrap
Samples = tuple[list[str], list[tuple[str, ...]]]  # of each the object, and its lights
Objects = list[Float[np.ndarray, " _"]]  # the values of each


def of_suite(suite: Suite, relit: bool) -> Samples:
    """A sample for each scene: under its light, or relit by that object's other one."""
    lights = [(s.light, suite.other_light(s).light) if relit else (s.light,) for s in suite.scenes]
    return [scene.object for scene in suite.scenes], lights


def of_few_lights(objects: int, lights: int, relit: bool) -> Samples:
    """Two samples an object, under lights that differ, each light about equally often (`suites.lights`)."""
    rng, order = np.random.default_rng(0), np.empty(0, int)
    while len(order) < 2 * objects:
        longer = np.concatenate([order, rng.permutation(lights)])
        pairs = longer[: len(longer) // 2 * 2].reshape(-1, 2)
        order = longer if (pairs[:, 0] != pairs[:, 1]).all() else order
    pairs = [(f"l{first}", f"l{second}") for first, second in order[: 2 * objects].reshape(-1, 2)]
    both = [own for first, second in pairs for own in ((first, second), (second, first))]
    return [f"o{i // 2}" for i in range(2 * objects)], both if relit else [own[:1] for own in both]


def coverage(
    samples: Samples, of_objects: float, of_lights: float, trials: int = TRIALS, seed: int = 0
) -> tuple[float, float]:
    """Shares of the intervals over objects, and over objects and lights, that hold the mean difference of two rows.

    Args:
        samples: what is drawn; all have as many lights.
        of_objects: standard deviation of the difference between objects; between pictures it is 1.
        of_lights: between lights, of all places together.
        trials: draws.
        seed: of them.
    """
    objects, lights = samples
    object_of = np.unique(objects, return_inverse=True)[1]
    names = np.unique(np.array(lights), return_inverse=True)[1].reshape(len(objects), -1)
    keys, rng, held = [str(i) for i in range(len(objects))], np.random.default_rng(seed), np.zeros(2)
    for _ in range(trials):
        level = 20 + rng.normal(size=len(keys))  # how hard a picture is for both rows
        lit = of_lights * rng.normal(size=names.max() + 1)[names].sum(axis=1) / math.sqrt(names.shape[1])
        gain = TRUE + of_objects * rng.normal(size=object_of.max() + 1)[object_of] + lit + rng.normal(size=len(keys))
        a, b = dict(zip(keys, level + gain, strict=True)), dict(zip(keys, level, strict=True))
        found = (
            paired_difference(a, b, dict(zip(keys, objects, strict=True))),
            crossed_estimate([a[key] - b[key] for key in keys], objects, lights),
        )
        held += [estimate.low <= TRUE <= estimate.high for estimate in found]
    return float(held[0] / trials), float(held[1] / trials)


def stored_differences(results: Results) -> list[Objects]:
    """What the claims of a run are about, of those on all of its objects: the differences of A and B. Rows that are
    level, and answers that are the truth to the bit, are left out."""
    count = len({record.object for record in results.records})
    found: list[Objects] = []
    for claim in run_claims(results.records, results.run):
        records = Selection(claim.table, claim.protocol).of(results.records)
        a, b = (values_of(records, row, claim.key) for row in (claim.a, claim.b))
        object_of = {record.sample: record.object for record in records}
        of_object: dict[str, list[float]] = {}
        for sample in sorted(a.keys() & b.keys()):
            of_object.setdefault(object_of[sample], []).append(a[sample] - b[sample])
        differences = [np.array(own) for own in of_object.values()]
        together = np.concatenate(differences)
        if len(differences) == count and np.isfinite(together).all() and together.any():
            found.append(differences)
    return found


def coverage_of_draws(objects: Objects, count: int, draws: int, seed: int = 0) -> tuple[float, float]:
    """Shares of Student's intervals and of the bootstrap's of `count` objects that hold the mean of all.

    Args:
        objects: all there are.
        count: how many of them are drawn, each as often as it comes.
        draws: trials.
        seed: of them.
    """
    true, rng, held = float(np.concatenate(objects).mean()), np.random.default_rng(seed), np.zeros(2)
    for _ in range(draws):
        drawn = [objects[i] for i in rng.integers(len(objects), size=count)]
        sizes = np.array([len(own) for own in drawn])
        student = mean_estimate(np.concatenate(drawn), np.repeat(np.arange(count), sizes).tolist())
        low, high = bootstrap(np.array([own.sum() for own in drawn]), sizes)
        held += [student.low <= true <= student.high, low <= true <= high]
    return float(held[0] / draws), float(held[1] / draws)


def bootstrap(sums: Float[np.ndarray, " k"], sizes: Int[np.ndarray, " k"]) -> tuple[float, float]:
    """Percentile interval of sum(sums) / sum(sizes), whose clusters are drawn with replacement."""
    picked = _picked(len(sums))
    means = (picked @ sums) / (picked @ sizes)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


@lru_cache(maxsize=1)
def _picked(count: int) -> Float[np.ndarray, "draws k"]:
    """How often each draw has each of `count` clusters."""
    draws = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    return np.stack([np.bincount(draw, minlength=count) for draw in draws]).astype(np.float64)


def lights_table(structures: Mapping[str, Samples]) -> str:
    """Coverage by structure (lines) and by how much objects and lights differ, over objects / over both, in percent."""
    head = ["objects and lights", *(f"objects {o:g}, lights {s:g}" for o, s in SPREADS)]
    lines = [
        [name, *(" / ".join(f"{100 * held:.0f}" for held in coverage(samples, *spread)) for spread in SPREADS)]
        for name, samples in structures.items()
    ]
    return markdown_table(head, lines)


def draws_table(results: Results) -> str:
    """Coverage by how many objects of stored results are drawn, in percent: the mean over the differences that claims
    are about, Student's t / bootstrap, and Student's of the one that it holds least often."""
    found = stored_differences(results)
    held = 100 * np.array(
        [[coverage_of_draws(objects, count, DRAWS, seed) for count in COUNTS] for seed, objects in enumerate(found)]
    )
    means = [f"{student:.1f} / {resampled:.1f}" for student, resampled in held.mean(axis=0)]
    least = [f"{student:.1f}" for student in held[:, :, 0].min(axis=0)]
    lines = [[f"mean of {len(found)} differences", *means], ["the least of them, Student's t", *least]]
    low, high = least_by_chance(len(found), DRAWS)
    return (
        f"{markdown_table([f'objects of {results.run.suite}', *map(str, COUNTS)], lines)}\n"
        f"Of {len(found)} that hold as often as they say, each for itself, the least would be {100 * low:.1f} to "
        f"{100 * high:.1f}."
    )


def least_by_chance(numbers: int, draws: int) -> tuple[float, float]:
    """Between which shares the least of so many lies in 95 of 100 cases, if all intervals hold as often as they say.

    Args:
        numbers: whose intervals are counted, each by draws of its own.
        draws: of each.
    """
    from scipy.special import bdtr

    at_most = 1 - (1 - bdtr(np.arange(draws + 1), draws, CONFIDENCE)) ** numbers  # the least has k that hold, or fewer
    low, high = np.searchsorted(at_most, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]) / draws
    return float(low), float(high)


def structures(suite: Suite) -> dict[str, Samples]:
    """A suite's, and as many objects under fewer lights."""
    count = len({scene.object for scene in suite.scenes})
    found = {f"{suite.spec.name}{', relit' * relit}": of_suite(suite, relit) for relit in (False, True)}
    for lights in (FEWEST_LIGHTS, 6, 8, 12):
        for relit in (False, True):
            found[f"{count} under {lights}{', relit' * relit}"] = of_few_lights(count, lights, relit)
    return found


if __name__ == "__main__":
    print(lights_table(structures(load_suite(sys.argv[1] if len(sys.argv) > 1 else "tiny"))))
    if sys.argv[2:]:
        print(draws_table(read_results(Path(sys.argv[2]))))
