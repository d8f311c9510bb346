"""The table of ingredients: means over objects and paired differences from the full method, as texts and as JSON."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby

from rich.console import Console

from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import CONFIDENCE, METHOD, unprinted_note
from unirender_evaluation.studies.cells import Cell, as_json, cell_text, row_cells
from unirender_evaluation.studies.optimiser.ingredients import FULL, GROUPS, Ingredient, changes
from unirender_evaluation.tables.formats import header, json_text
from unirender_evaluation.tables.protocol import protocol_text
from unirender_evaluation.tables.specs import Column
from unirender_evaluation.tables.text import TextTable

LEFT_OUT = ("ssim", "lpips_vgg", "lpips_alex", "peak_deg")  # columns of the multi-view table that the study has not
EVERY = slice(None)
WIDE = 130  # characters, from which on a terminal shows all columns side by side
MOST_SETTINGS = 4  # shown in a line; more are counted
NOTE = (
    "Mean over objects; in brackets the difference from the full method, paired by object, ± half of its interval; "
    "**bold** where the interval excludes 0. Seconds: transport (shared where a row changes the refinement alone) and "
    "refinement."
)


def columns() -> list[Column]:
    """Those of the multi-view table that are shown."""
    relit = [c for c in MULTIVIEW_TABLE.columns if c.quantity == "relit" and c.overrides.get("scale") == "aligned"]
    return [c for c in MULTIVIEW_TABLE.columns if c.metric.name not in LEFT_OUT and c not in relit]


@dataclass(frozen=True)
class Line:
    """A row: what is different, and its cells in the order of `columns`."""

    row: Ingredient
    cells: tuple[Cell, ...]


def summarise(rows: Sequence[Ingredient], records: Sequence[Record]) -> list[Line]:
    """The lines of the table, from records of all rows."""
    return [Line(row, row_cells(records, row.name, FULL, columns())) for row in rows]


def settings_text(row: Ingredient, full: Ingredient) -> str:
    """What the row's configuration has different, as Markdown."""
    found = changes(row.config, full.config)
    if len(found) > MOST_SETTINGS:
        return f"{len(found)} settings"
    return ", ".join(f"`{name} = {value}`" for name, value in found.items())


def tables(lines: Sequence[Line], settings: bool, shown: slice = EVERY) -> list[TextTable]:
    """A table for each group, the full method first in each; `settings` shows what is configured otherwise."""
    full = next(line for line in lines if line.row.name == FULL)
    titles = [f"{column.group} {header(column)}" for column in columns()[shown]]

    def texts(line: Line) -> tuple[str, ...]:
        pairs = list(zip(line.cells, columns(), strict=True))[shown]
        cells = [cell_text(cell, column.metric.decimals) for cell, column in pairs]
        return (line.row.label, *([settings_text(line.row, full.row)] if settings else []), *cells)

    names = ("What is different", *(["Setting"] if settings else []), *titles)
    groups = groupby((line for line in lines if line is not full), key=lambda line: line.row.group)
    found = [(GROUPS[group], tuple(map(texts, members))) for group, members in groups]
    return [TextTable(title, names, ((texts(full),), rows)) for title, rows in found or [("Ingredients", ())]]


def to_markdown(lines: Sequence[Line], protocol: Sequence[tuple[str, str]]) -> str:
    """A section for the documentation."""
    head = [
        "## What each ingredient is worth",
        "Measured by `unirender bench ingredients`: one thing at a time is different from the full method.",
        NOTE,
    ]
    body = [table.markdown().rstrip("\n") for table in tables(lines, settings=True)]
    line = f"Protocol: {protocol_text([*protocol, interval()])}."
    return "\n\n".join([*head, *_unprinted(lines), *body, line]) + "\n"


def show(console: Console, lines: Sequence[Line], protocol: Sequence[tuple[str, str]]) -> None:
    """Prints the tables to a terminal."""
    half = len(columns()) // 2
    for shown in [EVERY] if console.width >= WIDE else [slice(half), slice(half, None)]:
        for table in tables(lines, settings=False, shown=shown):
            table.show(console)
    for text in (NOTE, *_unprinted(lines), protocol_text([*protocol, interval()])):
        console.print(text, style="dim", highlight=False, markup=False)


def _unprinted(lines: Sequence[Line]) -> tuple[str, ...]:
    return unprinted_note(cell.difference for line in lines for cell in line.cells)


def interval() -> tuple[str, str]:
    """How intervals are made, for the protocol."""
    return (
        "interval",
        f"{CONFIDENCE:.0%} over objects: {METHOD}; no correction for many rows",
    )


def to_json(lines: Sequence[Line], records: Sequence[Record], protocol: Sequence[tuple[str, str]]) -> str:
    """Strict JSON: rows with their settings, means, differences and values of each object; no interval is null."""
    full = next(line for line in lines if line.row.name == FULL)
    keys = [column.key(DEFAULT_VARIANT) for column in columns()]
    rows = [
        {
            "name": line.row.name,
            "group": line.row.group,
            "label": line.row.label,
            "settings": changes(line.row.config, full.row.config),
            "metrics": {
                key: {
                    "mean": cell.mean,
                    "n": cell.n,
                    "difference": as_json(cell.difference),
                    "objects": {
                        record.object: record.values[key] for record in records if record.method == line.row.name
                    },
                }
                for key, cell in zip(keys, line.cells, strict=True)
            },
        }
        for line in lines
    ]
    content = {"protocol": dict([*protocol, interval()]), "full": asdict(full.row.config), "rows": rows}
    return json_text(content)
