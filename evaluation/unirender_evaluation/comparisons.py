"""Who beats whom: values of two rows, paired by sample, with the interval of their difference."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import DEFAULT_VARIANT, SCALES, Metric
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.statistics import FEWEST, Estimate, beats, crossed_estimate, paired_difference
from unirender_evaluation.tables.specs import Column, TableSpec

Lights = Mapping[str, tuple[str, ...]]  # sample -> the lights that its values depend on
AGREEMENT = 1e-4  # relative difference up to which two values are one measurement: another CPU rounds otherwise
OTHERS = ("trivial", "baseline", "optimisation")  # kinds of rows that ours are held against
ZERO = 1e-6  # and the absolute one, of values near zero
ROUNDING = 1e-5  # relative difference of two rows' values that decides nothing, far below the last printed digit


@dataclass(frozen=True)
class Selection:
    """Which records: one table under one protocol over one population."""

    table: str
    protocol: str
    subset: str = "main"

    def of(self, records: Iterable[Record]) -> list[Record]:
        """The records that belong to it, in their order."""
        wanted = (self.table, self.protocol, self.subset)
        return [record for record in records if (record.table, record.protocol, record.subset) == wanted]


@dataclass(frozen=True)
class Comparison:
    """Difference a - b of one number, with the verdict."""

    a: str
    b: str
    key: str  # metric key
    difference: Estimate
    a_beats_b: bool
    b_beats_a: bool
    equal: bool  # all pairs, but for rounding

    @property
    def decided(self) -> bool:
        """Whether there is an interval: with fewer than `statistics.FEWEST` objects there is none, nor of few lights
        where they count as drawn."""
        return math.isfinite(self.difference.low)

    @property
    def verdict(self) -> str:
        if not self.decided:
            few = f"fewer than {FEWEST} objects" if self.difference.clusters < FEWEST else "so few lights"
            return f"cannot be compared ({few}) with"
        if self.a_beats_b or self.b_beats_a:
            return "beats" if self.a_beats_b else "is beaten by"
        return "is level with" if self.equal else "is not told from"


def values_of(records: Iterable[Record], method: str, key: str) -> dict[str, float]:
    """Sample -> value of a method, for the records that have the metric key."""
    return {record.sample: record.values[key] for record in records if record.method == method and key in record.values}


def values_by_method(records: Iterable[Record], key: str) -> dict[str, dict[str, float]]:
    """`values_of` for every method that has the metric key, in one pass."""
    found: dict[str, dict[str, float]] = {}
    for record in records:
        if key in record.values:
            found.setdefault(record.method, {})[record.sample] = record.values[key]
    return found


def over_lights(values: Mapping[str, float], records: Iterable[Record], lights: Lights) -> Estimate:
    """Mean of values by sample, with its interval over objects and lights.

    Args:
        values: of some samples; inf allowed, NaN not.
        records: of these samples, and of others.
        lights: of these samples, and of others.

    Raises:
        UnirenderError: there are no values, or the lights of a sample are not named.
    """
    if unnamed := sorted(values.keys() - lights.keys()):
        raise UnirenderError(
            f"interval over objects and lights: the lights of {unnamed[0]!r} and {len(unnamed) - 1} more samples are "
            "not named, and the very suite is not installed, which would tell them; leave it out"
        )
    objects = {record.sample: record.object for record in records}
    return crossed_estimate(
        list(values.values()), [objects[sample] for sample in values], [lights[sample] for sample in values]
    )


def difference_over_lights(records: Sequence[Record], key: str, a: str, b: str, lights: Lights) -> Estimate:
    """Mean of a - b over the samples that both have, with its interval over objects and lights. `records` is one
    `Selection`; raises as `over_lights` does."""
    of_a, of_b = values_of(records, a, key), values_of(records, b, key)
    return over_lights({s: of_a[s] - of_b[s] for s in sorted(of_a.keys() & of_b.keys())}, records, lights)


def misleading_exact(key: str, values: Collection[float]) -> int:
    """How many samples are right to the bit where their infinite PSNR makes a mean that says nothing of the others.

    Under a fitted factor any constant becomes exact on an object of one colour, so each of them counts. As it is, a row
    that is right to the bit on all of its samples is perfect, and none counts.
    """
    exact = sum(map(math.isinf, values))
    fitted = key.partition("@")[2].split("-")[-1] in SCALES[1:]
    return exact if fitted or exact < len(values) else 0


def agree(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    """Whether the values of all keys that both have are one measurement, but for rounding (`AGREEMENT`, `ZERO`)."""
    return all(math.isclose(a[key], b[key], rel_tol=AGREEMENT, abs_tol=ZERO) for key in a.keys() & b.keys())


def without_rounding(a: Mapping[str, float], b: Mapping[str, float]) -> dict[str, float]:
    """b with the values of a where the two differ by rounding alone (`ROUNDING`), so that their difference is 0."""
    shared = {key for key in a.keys() & b.keys() if math.isclose(a[key], b[key], rel_tol=ROUNDING, abs_tol=ROUNDING**2)}
    return {key: a[key] if key in shared else value for key, value in b.items()}


def compare(records: Sequence[Record], metric: Metric, key: str, a: str, b: str) -> Comparison:
    """Paired comparison of two methods on the samples they share; `records` is one `Selection`.

    Values of a sample that differ by rounding alone count as equal in the verdict, however sure the sign is.

    Raises:
        UnirenderError: if one of the two has no such value, they share no sample, or a difference is not finite.
    """
    values = {method: values_of(records, method, key) for method in (a, b)}
    for method, found in values.items():
        if not found:
            known = ", ".join(sorted({record.method for record in records if key in record.values})) or "no method"
            raise UnirenderError(f"comparison: {method!r} has no value {key!r}; {known} has")
    clusters = {record.sample: record.object for record in records}
    better = metric.higher_is_better
    settled = without_rounding(values[a], values[b])
    return Comparison(
        a=a,
        b=b,
        key=key,
        difference=paired_difference(values[a], values[b], clusters),
        a_beats_b=beats(values[a], settled, higher_is_better=better, clusters=clusters),
        b_beats_a=beats(settled, values[a], higher_is_better=better, clusters=clusters),
        equal=all(values[a][sample] == settled[sample] for sample in values[a].keys() & settled.keys()),
    )


def under_other_lights(found: Comparison, records: Sequence[Record], metric: Metric, lights: Lights) -> Comparison:
    """The same comparison with its interval over objects and lights, by which it is judged; arguments as in
    `compare`, raises as `over_lights` does."""
    wider = difference_over_lights(records, found.key, found.a, found.b, lights)
    above, below = (False, False) if found.equal else (wider.low > 0, wider.high < 0)
    beats_beaten = (above, below) if metric.higher_is_better else (below, above)
    return replace(found, difference=wider, a_beats_b=beats_beaten[0], b_beats_a=beats_beaten[1])


def verdicts(
    spec: TableSpec,
    records: Sequence[Record],
    run: RunInfo,
    *,
    kind: str = "ours",
) -> list[tuple[Column, Comparison]]:
    """Every row of one kind against every row of the kinds `OTHERS`, column by column; `records` is one `Selection`.

    Pairs that share no sample, or have an infinite difference (identical images), have no verdict and are left out.
    """
    present = list(dict.fromkeys(record.method for record in records))
    ours = [key for key in present if run.method(key).kind == kind]
    others = [key for key in present if run.method(key).kind in OTHERS and key not in ours]
    found = []
    for column in spec.columns:
        key = column.key(DEFAULT_VARIANT)
        values = values_by_method(records, key)
        for a in ours:
            for b in others:
                common = values.get(a, {}).keys() & values.get(b, {}).keys()
                if common and all(math.isfinite(values[a][s] - values[b][s]) for s in common):
                    found.append((column, compare(records, column.metric, key, a, b)))
    return found
