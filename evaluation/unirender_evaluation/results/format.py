"""Comparisons as terminal tables that fit 80 columns, as Markdown, LaTeX and JSON."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from unirender_evaluation.results.compare import ColumnComparison, Compared, PairComparison, Rank
from unirender_evaluation.statistics import CONFIDENCE, CROSSED, METHOD
from unirender_evaluation.tables.formats import MISSING, format_number, header, json_number, json_text, signed
from unirender_evaluation.tables.latex import text_latex
from unirender_evaluation.tables.text import TextTable, plain_paragraph, print_whole

NUMBER, VERDICT = "number", "verdict"
TITLES = ("A\n(rank)", "B\n(rank)", "A - B\n95 % interval", "n\n(obj.)")


def facts(told: Compared) -> list[str]:
    """What stands above the tables."""
    interval = CROSSED if told.over_lights else f"{CONFIDENCE:.0%} over objects, under these lights: {METHOD}"
    return [
        f"A: {told.source_a}",
        f"B: {told.source_b}",
        f"suite {told.run.suite} {told.run.suite_hash[:12]}, {told.variant.label}; intervals: {interval}",
        *(f"note: {line}" for line in told.notes),
    ]


def _print_text(told: Compared) -> None:
    console = Console()
    console.print("\n".join(facts(told)), markup=False, highlight=False)
    for pair in told.pairs:
        print_whole(console, comparison_table(pair))


def _print_markdown(told: Compared) -> None:
    print("\n\n".join([*map(plain_paragraph, facts(told)), *(text_table(pair).markdown() for pair in told.pairs)]))


def _print_latex(told: Compared) -> None:
    below = tuple(f"{line}." for line in facts(told))
    for pair in told.pairs:
        label = "-".join(("compare", pair.selection.table, pair.selection.protocol, pair.a.key, pair.b.key))
        print(text_latex(text_table(pair, below), label))


def _print_json(told: Compared) -> None:
    content = {
        "a": told.source_a,
        "b": told.source_b,
        "suite": told.run.suite,
        "suite_hash": told.run.suite_hash,
        "variant": told.variant.label,
        "interval": "objects-and-lights" if told.over_lights else "objects",
        "notes": told.notes,
        "numbers": [_plain(pair, column) for pair in told.pairs for column in pair.columns],
    }
    print(json_text(content), end="")


COMPARISONS: Mapping[str, Callable[[Compared], None]] = {
    "text": _print_text,
    "markdown": _print_markdown,
    "latex": _print_latex,
    "json": _print_json,
}


def text_table(pair: PairComparison, notes: tuple[str, ...] = ()) -> TextTable:
    """A pair of rows as a table of texts."""
    titles = (NUMBER, *(title.replace("\n", " ") for title in TITLES), VERDICT)
    rows = tuple(tuple(text.replace("\n", " ") for text in _cells(column)) for column in pair.columns)
    return TextTable(_title(pair), titles, (rows,), notes)


def _title(pair: PairComparison) -> str:
    same = pair.a.label == pair.b.label
    return f"{pair.heading}: {pair.a.label if same else f'A: {pair.a.label}, B: {pair.b.label}'}"


def _plain(pair: PairComparison, found: ColumnComparison) -> dict[str, Any]:
    """A number of two rows as JSON; what was not compared has no difference."""
    where, column = pair.selection, found.column
    plain: dict[str, Any] = {"table": where.table, "protocol": where.protocol, "subset": where.subset}
    plain |= {"quantity": column.quantity, "metric": column.metric.name, "a": pair.a.key, "b": pair.b.key}
    plain |= {"mean_a": json_number(found.mean_a), "mean_b": json_number(found.mean_b), "verdict": found.verdict}
    plain |= {f"rank_{x}": rank and [rank.place, rank.of] for x, rank in (("a", found.rank_a), ("b", found.rank_b))}
    plain |= {"only_a": found.only_a, "only_b": found.only_b}
    if found.comparison is None:
        return plain
    own = found.comparison.difference
    ends = {"low": json_number(own.low), "high": json_number(own.high)}
    return plain | {"difference": own.mean, **ends, "n": own.n, "objects": own.clusters}


def comparison_table(found: PairComparison) -> Table:
    """An entry for each number of two rows: means with their ranks, A - B in the number's unit with its interval."""
    table = Table(box=box.SIMPLE_HEAD, title=escape(_title(found)), title_justify="left", pad_edge=False)
    table.add_column(NUMBER)
    for name in TITLES:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column(VERDICT)
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
