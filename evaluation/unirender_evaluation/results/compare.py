"""Two files' results against each other: the same row of both, or any two rows, sample by sample.

Every column of every table under every protocol that both rows answered: both means over the samples that they share,
the difference A - B with its paired interval over objects, the verdict, and each row's rank in its own run.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from unirender.errors import UnirenderError, UsageError
from unirender.system.wording import meant, near
from unirender_evaluation.comparisons import (
    Comparison,
    Lights,
    Selection,
    compare,
    misleading_exact,
    under_other_lights,
    values_by_method,
    values_of,
)
from unirender_evaluation.metrics import Metric, Variant
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.results.data import Results
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import RANKED_KINDS
from unirender_evaluation.tables.specs import Column, TableSpec

A, B = "A", "B"  # method keys of the two rows while they are compared


@dataclass(frozen=True)
class Rank:
    """A row's place among the competing rows of its run, on rounded means; ties share one."""

    place: int
    of: int

    def __str__(self) -> str:
        return f"{self.place} of {self.of}"


@dataclass(frozen=True)
class ColumnComparison:
    """One number of two rows. `comparison` is None where the difference is not finite."""

    column: Column
    mean_a: float
    mean_b: float
    comparison: Comparison | None
    rank_a: Rank | None
    rank_b: Rank | None
    only_a: int  # samples that B did not answer
    only_b: int

    @property
    def verdict(self) -> str:
        """In words."""
        if self.comparison is None:
            return "not compared: an identical picture has an infinite PSNR"
        return f"A {self.comparison.verdict} B".removesuffix(" with B")


@dataclass(frozen=True)
class PairComparison:
    """Two rows on one table under one protocol and population."""

    selection: Selection
    a: MethodInfo
    b: MethodInfo
    columns: tuple[ColumnComparison, ...]

    @property
    def heading(self) -> str:
        """Which table, under which protocol."""
        where = self.selection
        return f"{where.table}/{where.protocol}" + ("" if where.subset == "main" else f" ({where.subset})")


@dataclass(frozen=True)
class Compared:
    """What `bench compare` found.

    Attributes:
        source_a: of the first file.
        source_b: of the second.
        run: of the first; the second is of the same suite.
        variant: of the numbers.
        over_lights: whether intervals are over lights, too.
        notes: in what else the files differ.
        pairs: the comparisons.
    """

    source_a: str
    source_b: str
    run: RunInfo
    variant: Variant
    over_lights: bool
    notes: tuple[str, ...]
    pairs: tuple[PairComparison, ...]


def chosen_pairs(a: RunInfo, b: RunInfo, methods: Sequence[str]) -> list[tuple[MethodInfo, MethodInfo]]:
    """The rows to compare: those of `methods`, each `KEY` (of both files) or `KEY=KEY` (of A, of B); without any, all
    that both files have.

    Raises:
        UnirenderError: a file has no such row, or the two share none.
        UsageError: a method of another form.
    """
    if not methods:
        shared = [info.key for info in a.methods if any(info.key == other.key for other in b.methods)]
        if not shared:
            raise UnirenderError(
                "compare: the files have no row of the same name; name two with --method KEY=KEY: A has "
                f"{_keys(a)}; B has {_keys(b)}"
            )
        return [(a.method(key), b.method(key)) for key in shared]
    pairs = []
    for text in methods:
        first, separator, second = text.partition("=")
        if not first or (separator and not second):
            raise UsageError(f"--method {text}: expected KEY, a row of both files, or KEY=KEY, one of A and one of B")
        pairs.append((_row(a, first, A), _row(b, second or first, B)))
    return pairs


def compare_pair(
    a: Results,
    b: Results,
    info_a: MethodInfo,
    info_b: MethodInfo,
    variant: Variant,
    specs: Iterable[TableSpec] = ALL_TABLES.values(),
    lights: Lights | None = None,
) -> Iterator[PairComparison]:
    """Two rows on every table and protocol that both answered; see the module.

    Args:
        a: the first file; comparable with the second (`merge.check_comparable`), which may be the same.
        b: the second file.
        info_a: a row of a.
        info_b: a row of b.
        variant: of the metrics, where a column does not pin it.
        specs: the tables, with the columns that are wanted.
        lights: of all samples: intervals and verdicts are over objects and lights. None: over objects.
    """
    present = {name: _selections(file.records, info.key) for name, file, info in ((A, a, info_a), (B, b, info_b))}
    for spec in specs:
        for selection in (s for s in present[A] if s.table == spec.name and s in present[B]):
            ours, theirs = selection.of(a.records), selection.of(b.records)
            pair = [replace(r, method=A) for r in ours if r.method == info_a.key]
            pair += [replace(r, method=B) for r in theirs if r.method == info_b.key]
            columns = []
            for column in spec.columns:
                found = _compare_column(pair, column, variant, lights)
                if found is not None:
                    ranks = {
                        "rank_a": rank(ours, a.run, column.metric, column.key(variant), info_a.key),
                        "rank_b": rank(theirs, b.run, column.metric, column.key(variant), info_b.key),
                    }
                    columns.append(replace(found, **ranks))
            if columns:
                yield PairComparison(selection, info_a, info_b, tuple(columns))


def rank(records: Sequence[Record], run: RunInfo, metric: Metric, key: str, method: str) -> Rank | None:
    """A row's rank in its own run; None for a bound, for a row on fewer samples than the fullest one, and where it
    is infinite of a part (`misleading_exact`).

    Args:
        records: of one `Selection`.
        run: describes their rows.
        metric: its direction and decimals.
        key: metric key.
        method: the row.
    """
    values = values_by_method(records, key)
    fullest = max(map(len, values.values()), default=0)
    ranked = [info.key for info in run.methods if info.kind in RANKED_KINDS]
    competing = [row for row in ranked if row in values and len(values[row]) == fullest]
    telling = [row for row in competing if not misleading_exact(key, values[row].values())]
    means = {row: sum(values[row].values()) / fullest for row in telling}
    if method not in means:
        return None
    rounded = {row: round(mean, metric.decimals) for row, mean in means.items()}
    return Rank(1 + sum(metric.better(other, rounded[method]) for other in rounded.values()), len(rounded))


def _compare_column(
    pair: Sequence[Record], column: Column, variant: Variant, lights: Lights | None
) -> ColumnComparison | None:
    """The two rows' numbers; None where they share no sample of it."""
    key = column.key(variant)
    a, b = values_of(pair, A, key), values_of(pair, B, key)
    common = a.keys() & b.keys()
    if not common:
        return None
    finite = all(math.isfinite(a[sample] - b[sample]) for sample in common)
    comparison = compare(pair, column.metric, key, A, B) if finite else None
    if comparison is not None and lights is not None:
        comparison = under_other_lights(comparison, pair, column.metric, lights)
    return ColumnComparison(
        column=column,
        mean_a=sum(a[sample] for sample in common) / len(common),
        mean_b=sum(b[sample] for sample in common) / len(common),
        comparison=comparison,
        rank_a=None,
        rank_b=None,
        only_a=len(a.keys() - common),
        only_b=len(b.keys() - common),
    )


def _selections(records: Sequence[Record], method: str) -> list[Selection]:
    return list(dict.fromkeys(Selection(r.table, r.protocol, r.subset) for r in records if r.method == method))


def _row(run: RunInfo, key: str, file: str) -> MethodInfo:
    found = next((info for info in run.methods if info.key == key), None)
    if found is None:
        known = [info.key for info in run.methods]
        hint = meant(near(key, known)) or f"; it has {_keys(run)}"
        raise UnirenderError(f"compare: {file} has no row {key!r}{hint}")
    return found


def _keys(run: RunInfo) -> str:
    return ", ".join(info.key for info in run.methods) or "none"
