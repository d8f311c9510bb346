"""View models of the report's plots: rug strips (one tick per sample) and the tiles that place our best row."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from unirender_evaluation.comparisons import Selection, values_of
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.statistics import Estimate, mean_estimate
from unirender_evaluation.tables.build import Row, Table
from unirender_evaluation.tables.formats import format_estimate, format_number
from unirender_evaluation.tables.lights import LIGHT_TABLE
from unirender_evaluation.tables.specs import PROTOCOLS, Column, TableSpec

HEADLINE = ("psnr", "mse", "cosine")  # metrics of the verdicts, the tiles and the distributions
LIGHT_HEADLINE = ("log_rmse_scaled", "peak_deg", "rmse_relative")  # and of the light's, where its level is left free
WIDTH = 1000  # of a strip's own coordinates; strokes do not scale with it
FEW = " (n\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}{})"  # behind the label of a row that has fewer samples than the others
LEADING = ("ours", "external")  # kinds whose rows the report is about; the first that is there
MARKED = ("trivial", "baseline", "optimisation", "external", "ours")  # kinds whose best row is marked on a tile's scale


def is_headline(table: str, column: Column) -> bool:
    """Whether verdicts, tiles and distributions show a column; of a light's balls the aligned ones alone."""
    if table == LIGHT_TABLE.name:
        return column.metric.name in LIGHT_HEADLINE and column.overrides.get("scale") != "raw"
    return column.metric.name in HEADLINE


def strip_plots(specs: Mapping[str, TableSpec], records: Sequence[Record], run: RunInfo) -> list[dict[str, Any]]:
    """One plot per table, protocol and headline, inside the mask where there is one."""
    plots = []
    for spec in specs.values():
        for protocol in spec.protocols:
            chosen = Selection(spec.name, protocol).of(records)
            objects = {record.sample: record.object for record in chosen}
            keys = list(dict.fromkeys(record.method for record in chosen))
            for column in spec.columns:
                if not is_headline(spec.name, column):
                    continue
                values = {key: values_of(chosen, key, column.key(DEFAULT_VARIANT)) for key in keys}
                values = {key: found for key, found in values.items() if found}
                if len(values) > 1:  # a lone row has nothing to be compared with
                    plots.append(_strip_plot(column, values, objects, run) | {"table": heading(spec.title, protocol)})
    return plots


def _strip_plot(
    column: Column, values: Mapping[str, Mapping[str, float]], objects: Mapping[str, str], run: RunInfo
) -> dict[str, Any]:
    """One strip for each row, best first: `values` by row and sample, `objects` by sample."""
    finite = [x for found in values.values() for x in found.values() if math.isfinite(x)] or [0.0]
    low, high = min(finite), max(finite)
    span = (high - low) or 1.0
    digits, most = column.metric.decimals, max(map(len, values.values()))

    def at(x: float) -> str:
        return f"{min(max((x - low) / span, 0.0), 1.0) * WIDTH:.0f}"  # an infinite value sits at the edge

    rows = []
    for key, found in values.items():
        estimate = mean_estimate(list(found.values()), [objects[sample] for sample in found])
        interval = not math.isnan(estimate.half_width)
        rows.append(
            {
                "label": run.method(key).label + (FEW.format(len(found)) if len(found) < most else ""),
                "kind": run.method(key).kind,
                "rug": "".join(f"M{x} 4V18" for x in sorted({at(x) for x in found.values()}, key=int)),
                "ci": f"M{at(estimate.low)} 11H{at(estimate.high)}" if interval else "",
                "mean": f"M{at(estimate.mean)} 0V22",
                "value": format_number(estimate.mean, digits),
                "order": estimate.mean if math.isfinite(estimate.mean) else math.copysign(1e9, estimate.mean),
            }
        )
    rows.sort(key=lambda row: row["order"], reverse=column.metric.higher_is_better)
    return {
        "title": f"{column.group} {column.metric.label}",
        "rows": rows,
        "direction": "higher is better" if column.metric.higher_is_better else "lower is better",
        "low": format_number(low, digits),
        "high": format_number(high, digits) + (f" {column.metric.unit}" if column.metric.unit else ""),
    }


def heading(title: str, protocol: str) -> str:
    """A table's title with its protocol, where that says more."""
    label = PROTOCOLS[protocol].label if protocol in PROTOCOLS else protocol
    return title if label.casefold() == title.casefold() else f"{title}: {label}"


def tiles(tables: Sequence[Table]) -> list[dict[str, Any]]:
    """The best row of the leading kind between the trivial rows and what nobody can pass, from the masked tables: the
    paper's under its own protocols, and the light's."""
    found = []
    for table in tables:
        if table.variant != DEFAULT_VARIANT or table.subset != "main":
            continue
        if not (PROTOCOLS[table.protocol_key].published or table.name == LIGHT_TABLE.name):
            continue
        for i, column in enumerate(table.columns):
            tile = _tile(table, column, i) if is_headline(table.name, column) else None
            if tile is not None:
                found.append(tile)
    return found


@dataclass(frozen=True)
class Scale:
    """A straight scale from the worst trivial row (0) to what nobody can pass (1): the ceiling, or a perfect value.

    A PSNR without a ceiling has no finite end; its scale is linear in the RMS error, which ends at 0.
    """

    start: float
    end: float

    @property
    def of_error(self) -> bool:
        """Whether positions are those of the RMS error behind a PSNR."""
        return math.isinf(self.end)

    def at(self, value: float) -> float:
        """Position of a value, in [0, 1]."""
        start, end, x = (10 ** (-v / 20) if self.of_error else v for v in (self.start, self.end, value))
        return min(max((x - start) / (end - start), 0.0), 1.0) if end != start else 1.0


def _tile(table: Table, column: Column, i: int) -> dict[str, Any] | None:
    """Where the best row of the leading kind stands in a column, the table's i-th; None without such a row."""
    metric = column.metric
    measured = [(row, cell) for row in table.rows if (cell := row.cells[i].measured) is not None]
    full = max((cell.n for _, cell in measured), default=0)

    def best(kind: str) -> tuple[Row, Estimate] | None:
        of_kind = [(row, cell) for row, cell in measured if row.kind == kind]
        complete = [(row, cell) for row, cell in of_kind if cell.n == full]
        sign = 1 if metric.higher_is_better else -1
        return max(complete or of_kind, key=lambda pair: sign * pair[1].mean, default=None)

    def text(row: Row, cell: Estimate) -> str:
        subset = FEW.format(cell.n) if cell.n < full else ""
        return f"{row.label}: {format_number(cell.mean, metric.decimals)}{subset}"

    ours = next((found for kind in LEADING if (found := best(kind)) is not None), None)
    if ours is None:
        return None
    ceiling = best("ceiling")
    end = metric.perfect if ceiling is None else ceiling[1].mean
    complete = [(row, cell) for row, cell in measured if cell.n == full and math.isfinite(cell.mean)] or [ours]
    lowest = [pair for pair in complete if pair[0].kind == "trivial"] or complete
    start = (min if metric.higher_is_better else max)(lowest, key=lambda pair: pair[1].mean)
    scale = Scale(start[1].mean, end)
    marks = [(kind, found) for kind in MARKED if (found := best(kind)) is not None and found[0] != start[0]]
    value, spread = format_estimate(ours[1], metric.decimals)
    views = [
        {"kind": kind, "at": f"{100 * scale.at(cell.mean):.1f}", "title": text(row, cell)}
        for kind, (row, cell) in marks
    ]
    end_text = f"perfect: {_perfect(scale)}" if ceiling is None else text(*ceiling)
    return {
        "what": f"{column.group} {metric.label} {metric.arrow}",
        "table": heading(table.title, table.protocol_key),
        "value": value,
        "spread": spread,
        "unit": metric.unit,
        "by": ours[0].label,
        "marks": views,
        "start": text(*start),
        "start_kind": start[0].kind,
        "end": end_text,
        "end_kind": "perfect" if ceiling is None else "ceiling",
        "aria": "; ".join([text(*start), *(view["title"] for view in views), f"end of the scale: {end_text}"]),
    }


def _perfect(scale: Scale) -> str:
    return "no error (scale of RMS error)" if scale.of_error else f"{scale.end:g}"
