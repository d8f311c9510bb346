"""What the tables of studies share: columns, and cells that say how far a row is from the one it is compared with."""

import math
from dataclasses import dataclass

from unirender_evaluation.metrics import METRICS, Metric
from unirender_evaluation.statistics import Estimate
from unirender_evaluation.tables.formats import format_number, json_number, signed
from unirender_evaluation.tables.specs import Column


def study_column(group: str, quantity: str, metric: Metric | str, **overrides: str) -> Column:
    """A column of a metric, or of one of the benchmark's by its name; the paper has no number for it."""
    return Column(group, quantity, METRICS[metric] if isinstance(metric, str) else metric, overrides, published=False)


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


def cell_text(cell: Cell, decimals: int) -> str:
    """`27.90 (**-1.20 ± 0.40**)`."""
    text = format_number(cell.mean, decimals)
    if cell.difference is None:
        return text
    change = signed(cell.difference.mean, decimals)
    if not math.isnan(cell.difference.half_width):
        change += f" ± {format_number(cell.difference.half_width, decimals)}"
    return f"{text} (**{change}**)" if cell.decided else f"{text} ({change})"


def as_json(found: Estimate | None) -> dict[str, float | str | int | None] | None:
    """An estimate for JSON; None where there is none."""
    if found is None:
        return None
    mean, low, high = map(json_number, (found.mean, found.low, found.high))
    return {"mean": mean, "low": low, "high": high, "n": found.n, "objects": found.clusters}
