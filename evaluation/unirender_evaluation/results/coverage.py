"""How often 95 % intervals hold the truth, by simulation: `python -m unirender_evaluation.results.coverage [SUITE]`.

Draws paired differences of two rows on the objects and lights that a suite has, where objects, lights and pictures
differ by known amounts, and counts how often each interval (`statistics`) holds their mean. The second table asks the
same of few objects whose differences have heavy tails.
"""

import math
import sys
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from unirender_evaluation.results.findings import markdown_table
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
Samples = tuple[list[str], list[tuple[str, ...]]]  # of each the object, and its lights
Draw = Callable[[np.random.Generator, int], Float[np.ndarray, " n"]]
TAILS: Mapping[str, Draw] = {  # of mean TRUE
    "normal": lambda rng, n: TRUE + rng.normal(size=n),
    "Student's t, 3": lambda rng, n: TRUE + rng.standard_t(3, size=n),
    "exponential": lambda rng, n: TRUE * rng.exponential(size=n),
    "log-normal": lambda rng, n: TRUE * np.exp(rng.normal(size=n) - 0.5),
}


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


def tails(draw: Draw, count: int, trials: int = TRIALS, seed: int = 0) -> tuple[float, float]:
    """Shares of the bootstrap's intervals of `count` objects with a sample each, and of Student's, that hold the mean.

    Args:
        draw: of values, whose mean is `TRUE`.
        count: at least `FEW` objects, from which on `mean_estimate` is the bootstrap.
        trials: draws.
        seed: of them.
    """
    from scipy.special import stdtrit

    rng, held, reach = np.random.default_rng(seed), np.zeros(2), float(stdtrit(count - 1, (1 + CONFIDENCE) / 2))
    for trial in range(trials):
        values = draw(rng, count)
        bootstrap, half = mean_estimate(values, seed=trial), reach * values.std(ddof=1) / math.sqrt(count)
        held += [bootstrap.low <= TRUE <= bootstrap.high, abs(values.mean() - TRUE) <= half]
    return float(held[0] / trials), float(held[1] / trials)


def lights_table(structures: Mapping[str, Samples]) -> str:
    """Coverage by structure (lines) and by how much objects and lights differ, over objects / over both, in percent."""
    head = ["objects and lights", *(f"objects {o:g}, lights {s:g}" for o, s in SPREADS)]
    lines = [
        [name, *(" / ".join(f"{100 * held:.0f}" for held in coverage(samples, *spread)) for spread in SPREADS)]
        for name, samples in structures.items()
    ]
    return markdown_table(head, lines)


def tails_table() -> str:
    """Coverage by the differences' tails and the number of objects, bootstrap / Student's t, in percent."""
    counts = (21, 30, 40, 50, 100)
    lines = [
        [name, *(" / ".join(f"{100 * held:.1f}" for held in tails(draw, count)) for count in counts)]
        for name, draw in TAILS.items()
    ]
    return markdown_table(["differences", *map(str, counts)], lines)


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
    print(tails_table())
