"""Comparisons as terminal tables that fit 80 columns."""

import math

from rich import box
from rich.markup import escape
from rich.table import Table

from unirender_evaluation.results.compare import ColumnComparison, PairComparison, Rank
from unirender_evaluation.tables.formats import MISSING, format_number, header, signed

TITLES = ("A\n(rank)", "B\n(rank)", "A - B\n95 % interval", "n\n(obj.)")


def comparison_table(found: PairComparison) -> Table:
    """An entry for each number of two rows: means with their ranks, A - B in the number's unit with its interval."""
    same = found.a.label == found.b.label
    title = found.a.label if same else f"A: {found.a.label}, B: {found.b.label}"
    table = Table(box=box.SIMPLE_HEAD, title=escape(f"{found.heading}: {title}"), title_justify="left", pad_edge=False)
    table.add_column("number")
    for name in TITLES:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("verdict")
    for column in found.columns:
        table.add_row(*map(escape, _cells(column)))
    return table


def _cells(found: ColumnComparison) -> tuple[str, ...]:
    """A comparison as cells: number, both means with ranks, difference with interval, n, verdict."""
    digits = found.column.metric.decimals
    difference, n = MISSING, MISSING
    if found.comparison is not None:
        d = found.comparison.difference
        difference, n = signed(d.mean, digits), f"{d.n}\n({d.clusters})"
        if math.isfinite(d.low):
            difference += f"\n[{signed(d.low, digits)}, {signed(d.high, digits)}]"
    alone = ", ".join(f"{count} only in {name}" for name, count in (("A", found.only_a), ("B", found.only_b)) if count)
    return (
        f"{found.column.group} {header(found.column)}",
        _mean(found.mean_a, digits, found.rank_a),
        _mean(found.mean_b, digits, found.rank_b),
        difference,
        n,
        found.verdict + (f" ({alone})" if alone else ""),
    )


def _mean(value: float, digits: int, rank: Rank | None) -> str:
    return format_number(value, digits) + (f"\n({rank})" if rank else "")
