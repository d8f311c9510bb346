"""What the tables of studies share: means, paired differences, and cells that say how far a row is
from the one that it is compared with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from unirender_evaluation.comparisons import values_of
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import Estimate, mean_estimate, paired_difference
from unirender_evaluation.tables.formats import format_number, json_number, signed
from unirender_evaluation.tables.specs import Column


@dataclass(frozen=True)
class Cell:
    """One number of a row."""

    mean: float  # over objects
    n: int  # how many
    difference: Estimate | None  # from the row that all are compared with (None in that row itself), paired

    @property
    def decided(self) -> bool:
        """Whether the interval of the difference excludes 0."""
        return self.difference is not None and (self.difference.low > 0 or self.difference.high < 0)


def row_cells(records: Sequence[Record], method: str, base: str, columns: Sequence[Column]) -> tuple[Cell, ...]:
    """The cells of a row in the order of the columns, compared with the row `base`."""
    objects = {record.sample: record.object for record in records}
    found = []
    for column in columns:
        own, other = (values_of(records, name, column.key(DEFAULT_VARIANT)) for name in (method, base))
        change = None if method == base else paired_difference(own, other, objects)
        found.append(Cell(sum(own.values()) / len(own), len(own), change))
    return tuple(found)


def cell_text(cell: Cell, decimals: int) -> str:
    """`27.90 (**-1.20 ± 0.40**)`."""
    text = format_number(cell.mean, decimals)
    if cell.difference is None:
        return text
    change = signed(cell.difference.mean, decimals)
    if not math.isnan(cell.difference.half_width):
        change += f" ± {format_number(cell.difference.half_width, decimals)}"
    return f"{text} (**{change}**)" if cell.decided else f"{text} ({change})"


def estimate(records: Sequence[Record], method: str, key: str) -> Estimate | None:
    """The mean of one value over the records of a method; None where none has it."""
    own = [record for record in records if record.method == method and key in record.values]
    return mean_estimate([r.values[key] for r in own], [r.object for r in own]) if own else None


def difference(records: Sequence[Record], a: str, b: str, column: Column) -> Estimate | None:
    """a - b of one column, paired by sample; None where there is none or one is infinite."""
    first, second = (values_of(records, method, column.key(DEFAULT_VARIANT)) for method in (a, b))
    common = first.keys() & second.keys()
    if not common or not all(math.isfinite(values[sample]) for values in (first, second) for sample in common):
        return None
    return paired_difference(first, second, {record.sample: record.object for record in records})


def as_json(found: Estimate | None) -> dict[str, float | str | int | None] | None:
    """An estimate for JSON; None where there is none."""
    if found is None:
        return None
    mean, low, high = map(json_number, (found.mean, found.low, found.high))
    return {"mean": mean, "low": low, "high": high, "n": found.n, "objects": found.clusters}
