"""Tables as Markdown, JSON and terminal text; as LaTeX: `tables.latex`.

In every format: best in bold, second underlined (on rounded values), "-" where a value does not exist, "n/a" where it
could not be computed here, ± half of the interval, n where others have more samples, a dagger on a published
value that a trivial row beats, the watermark of a partial run, and the protocol below.
"""

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from unirender_evaluation.statistics import Estimate
from unirender_evaluation.tables.build import Cell, Row, Table
from unirender_evaluation.tables.counts import cell_counts, label_n
from unirender_evaluation.tables.protocol import protocol_text
from unirender_evaluation.tables.specs import Column
from unirender_evaluation.tables.text import WIDEST, markdown_row, plain_markdown, plain_paragraph, print_whole

LARGE = 1e6
MISSING, NOT_AVAILABLE = "-", "n/a"
NO_CELL = Cell()
LABEL = 24  # letters of a row's label that a narrow terminal has on one line


def format_number(value: float, decimals: int) -> str:
    """Fixed decimals; scientific where a value is absurdly large, infinity as a symbol."""
    if not math.isfinite(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.2e}" if abs(value) >= LARGE else f"{value:.{decimals}f}"


def format_estimate(estimate: Estimate, decimals: int) -> tuple[str, str]:
    """(mean, "± half width"); the second is empty where there is no interval, or one of too few objects to print."""
    width = estimate.half_width
    return format_number(estimate.mean, decimals), "" if math.isnan(width) else f"± {format_number(width, decimals)}"


def estimate_text(estimate: Estimate | None, decimals: int) -> str:
    """Mean and half width as one text; `MISSING` where nothing was measured."""
    return MISSING if estimate is None else " ".join(format_estimate(estimate, decimals)).strip()


def header(column: Column) -> str:
    """Metric with its unit and direction."""
    unit = f" ({column.metric.unit})" if column.metric.unit else ""
    return f"{column.metric.label}{unit} {column.metric.arrow}"


def row_label(row: Row, table: Table) -> str:
    """Label with n where its cells are on fewer samples than others, and "stored" where nothing ran."""
    n = label_n(table.rows, row)
    subset = "" if n is None else f" (n = {n})"
    return row.label + subset + (" (stored)" if row.stored else "")


def few(counts: Mapping[int, int], column: int) -> str:
    """What stands behind a number on fewer samples than others, where the row's label does not say it."""
    return f" (n = {counts[column]})" if column in counts else ""


def measured_text(cell: Cell) -> str:
    """What stands in place of a number."""
    return NOT_AVAILABLE if cell.unavailable else MISSING


def to_markdown(table: Table) -> str:
    """GitHub-flavoured Markdown; columns that carry published values are doubled: "paper", then measured."""
    titles, marks = ["Method"], [":--"]
    for column, doubled in zip(table.columns, table.published_columns, strict=True):
        name = f"{column.group} {header(column)}"
        titles += [f"{name}, paper", f"{name}, here"] if doubled else [name]
        marks += ["--:", "--:"] if doubled else ["--:"]
    lines = [f"### {table.heading}", ""]
    lines += [f"> **{table.watermark}**", ""] if table.watermark else []
    lines += [markdown_row(titles), markdown_row(marks)]
    for row in table.rows:
        texts, counts = [plain_markdown(row_label(row, table))], cell_counts(table.rows, row)
        for i, (column, cell, doubled) in enumerate(row_cells(row, table)):
            digits = column.metric.decimals
            if doubled:
                published = MISSING if cell.published is None else format_number(cell.published, digits)
                texts.append(_markdown_rank(published, cell.published_rank) + ("†" if cell.dagger else ""))
            if cell.measured is None:
                texts.append(measured_text(cell))
            else:
                mean, spread = format_estimate(cell.measured, digits)
                texts.append(f"{_markdown_rank(mean, cell.measured_rank)} {spread}".strip() + few(counts, i))
        lines.append(markdown_row(texts))
    lines += ["", plain_paragraph(f"Protocol: {protocol_text(table.protocol)}.")]
    lines += [line for note in table.notes for line in ("", plain_paragraph(note))]
    return "\n".join(lines) + "\n"


def to_json(tables: Iterable[Table]) -> str:
    """Strict JSON of whole tables; NaN (no interval) becomes null, infinity the string "inf"."""
    return json_text([_plain(table) for table in tables])


def json_text(content: Any) -> str:
    """Strict JSON for people to read, too.

    Raises:
        ValueError: a number is NaN or infinite (`json_number`).
    """
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def print_tables(console: Console, tables: Sequence[Table]) -> None:
    """Prints tables one after another; what the protocols of all say alike, and notes of several, once, below them."""
    said = Counter(item for table in tables for item in dict.fromkeys(table.protocol))
    noted = Counter(note for table in tables for note in dict.fromkeys(table.notes))
    alike = [item for item, count in said.items() if count == len(tables) > 1]
    shared = [note for note, count in noted.items() if count > 1]
    for table in tables:
        protocol = tuple(item for item in table.protocol if item not in alike)
        notes = tuple(note for note in table.notes if note not in shared)
        print_table(console, dataclasses.replace(table, protocol=protocol, notes=notes))
    for line in [*([f"\nAll tables: {protocol_text(alike)}"] if alike else []), *shared]:
        console.print(line, style="dim", highlight=False, markup=False)


def print_table(console: Console, table: Table) -> None:
    """Prints a table to a terminal or a file, split by column groups where that is too narrow; a part has the rows that
    say something in it, and is wider where it has to be.
    """
    if table.watermark:
        console.print(f"[bold red]{escape(table.watermark)}[/]")
    groups = [[i for i, _ in items] for _, items in groupby(enumerate(table.columns), key=lambda item: item[1].group)]
    for number, indices in enumerate(_blocks(console, table, groups)):
        rich_table = _rich_table(table, indices)
        rich_table.title = escape(table.heading) if number == 0 else None
        print_whole(console, rich_table)
    for line in filter(None, (protocol_text(table.protocol), *table.notes)):
        console.print(line, style="dim", highlight=False, markup=False)


def _rich_table(table: Table, indices: Sequence[int]) -> RichTable:
    rich_table = RichTable(box=box.SIMPLE_HEAD, title_justify="left", title_style="bold", pad_edge=False)
    rich_table.add_column("Method")
    for i in indices:
        column, name = table.columns[i], f"{table.columns[i].group}\n{header(table.columns[i])}"
        if table.published_columns[i]:
            rich_table.add_column(f"{column.group}\npaper", justify="right", style="dim", no_wrap=True)
        rich_table.add_column(name, justify="right", no_wrap=True)
    section = None
    for row in table.rows:
        if all(row.cells[i] == NO_CELL for i in indices):
            continue
        if section is not None and row.section != section:
            rich_table.add_section()
        section = row.section
        texts, counts = [escape(row_label(row, table))], cell_counts(table.rows, row)
        for i in indices:
            cell, digits = row.cells[i], table.columns[i].metric.decimals
            if table.published_columns[i]:
                published = MISSING if cell.published is None else format_number(cell.published, digits)
                texts.append(_rich_rank(published, cell.published_rank) + ("†" if cell.dagger else ""))
            if cell.measured is None:
                texts.append(measured_text(cell))
            else:
                mean, spread = format_estimate(cell.measured, digits)
                ranked = _rich_rank(mean, cell.measured_rank)
                texts.append((f"{ranked} [dim]{spread.replace(' ', '')}[/]" if spread else mean) + few(counts, i))
        rich_table.add_row(*texts)
    return rich_table


def _blocks(console: Console, table: Table, groups: Sequence[Sequence[int]]) -> list[list[int]]:
    """Columns in as few blocks as the terminal is wide enough for, at least one column in each; groups are kept
    together where one fits."""
    blocks: list[list[int]] = []
    for group in groups:
        for part in [group] if _fits(console, table, group) else [[i] for i in group]:
            if blocks and _fits(console, table, [*blocks[-1], *part]):
                blocks[-1] += part
            else:
                blocks.append([*part])
    return blocks


def _fits(console: Console, table: Table, indices: Sequence[int]) -> bool:
    """Whether a block's numbers fit the terminal, with labels that may be broken into lines of `LABEL` letters."""
    rich_table = _rich_table(table, indices)
    rich_table.columns[0].max_width = LABEL
    wide = console.options.update(max_width=WIDEST)
    return console.measure(rich_table, options=wide).maximum <= console.width


def _rich_rank(text: str, rank: int | None) -> str:
    return {1: f"[bold]{text}[/]", 2: f"[underline]{text}[/]"}.get(rank or 0, text)


def _markdown_rank(text: str, rank: int | None) -> str:
    return {1: f"**{text}**", 2: f"<u>{text}</u>"}.get(rank or 0, text)


def row_cells(row: Row, table: Table) -> Iterator[tuple[Column, Cell, bool]]:
    """Each column with the row's cell, and whether it is doubled."""
    return zip(table.columns, row.cells, table.published_columns, strict=True)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return json_number(value) if isinstance(value, float) else value


def signed(value: float, digits: int) -> str:
    """With its sign, unless it is 0 as printed."""
    text = f"{value:+.{digits}f}"
    return text if float(text) else text[1:]


def json_number(value: float) -> float | str | None:
    """A number as JSON can hold it: infinities as text, NaN as None."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")
