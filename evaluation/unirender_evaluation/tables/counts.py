"""How many samples stand behind a row and each of its cells, and where a table says so.

A cell on fewer samples than the fullest row of its column is *short*: it is not ranked, and its n is printed. A row
whose cells are all short has the n of the fullest of them behind its label; short cells of another n have it beside the
number.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from unirender_evaluation.tables.build import Row


def fullest(rows: Sequence["Row"], column: int) -> int:
    """Samples of the fullest row of a column; 0 where nothing is measured."""
    return max((cell.n for row in rows if (cell := row.cells[column].measured) is not None), default=0)


def short_cells(rows: Sequence["Row"], row: "Row") -> dict[int, int]:
    """Column -> n of a row's short cells."""
    counts = {i: cell.measured.n for i, cell in enumerate(row.cells) if cell.measured is not None}
    return {i: n for i, n in counts.items() if n < fullest(rows, i)}


def label_n(rows: Sequence["Row"], row: "Row") -> int | None:
    """The n behind a row's label; None where it has no short cell, or a complete one of another n."""
    short = short_cells(rows, row)
    most = max(short.values(), default=0)
    complete = {c.measured.n for i, c in enumerate(row.cells) if c.measured is not None and i not in short}
    return most if short and complete <= {most} else None


def cell_counts(rows: Sequence["Row"], row: "Row") -> dict[int, int]:
    """Column -> n of the short cells whose n is not the one behind the row's label."""
    label = label_n(rows, row)
    return {i: n for i, n in short_cells(rows, row).items() if n != label}
