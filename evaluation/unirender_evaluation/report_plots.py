"""View models of the report's plots: rug strips (one tick per sample) and the tiles that place our best row."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from unirender_evaluation.comparisons import Selection, values_of
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.specs import PROTOCOLS, Column, TableSpec
from unirender_evaluation.statistics import bootstrap_mean
from unirender_evaluation.table_formats import format_estimate, format_number
from unirender_evaluation.tables import Row, Table

WIDTH = 1000  # of a strip's own coordinates; strokes do not scale with it


def strip_plots(
    specs: Mapping[str, TableSpec], records: Sequence[Record], run: RunInfo, metrics: Sequence[str]
) -> list[dict[str, Any]]:
    """One plot per table, protocol and column whose metric is among `metrics`, inside the mask."""
    plots = []
    for spec in specs.values():
        for protocol in spec.protocols:
            chosen = Selection(spec.name, protocol).of(records)
            objects = {record.sample: record.object for record in chosen}
            keys = list(dict.fromkeys(record.method for record in chosen))
            for column in spec.columns:
                if column.metric.name not in metrics:
                    continue
                values = {key: values_of(chosen, key, column.key(DEFAULT_VARIANT)) for key in keys}
                values = {key: found for key, found in values.items() if found}
                if len(values) > 1:  # a lone row has nothing to be compared with
                    title = f"{column.group} {column.metric.label}, {PROTOCOLS[protocol].label}"
                    plots.append(_strip_plot(title, column, values, objects, run))
    return plots


def _strip_plot(
    title: str, column: Column, values: Mapping[str, Mapping[str, float]], objects: Mapping[str, str], run: RunInfo
) -> dict[str, Any]:
    finite = [x for found in values.values() for x in found.values() if math.isfinite(x)] or [0.0]
    low, high = min(finite), max(finite)
    span = (high - low) or 1.0
    digits = column.metric.decimals

    def at(x: float) -> str:
        return f"{min(max((x - low) / span, 0.0), 1.0) * WIDTH:.0f}"  # an infinite value sits at the edge

    rows = []
    for key, found in values.items():
        estimate = bootstrap_mean(list(found.values()), [objects[sample] for sample in found])
        interval = not math.isnan(estimate.half_width)
        rows.append(
            {
                "label": run.method(key).label,
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
        "title": title,
        "rows": rows,
        "direction": "higher is better" if column.metric.higher_is_better else "lower is better",
        "low": format_number(low, digits),
        "high": format_number(high, digits) + (f" {column.metric.unit}" if column.metric.unit else ""),
    }


def tiles(tables: Sequence[Table], metrics: Sequence[str]) -> list[dict[str, Any]]:
    """Our best row of each headline number between the worst trivial row and the ceiling, from the masked tables."""
    found = []
    for table in tables:
        if table.variant != DEFAULT_VARIANT or table.subset != "main":
            continue
        if not PROTOCOLS[table.protocol_key].published:
            continue
        for i, column in enumerate(table.columns):
            tile = _tile(table, column, i) if column.metric.name in metrics else None
            if tile is not None:
                found.append(tile)
    return found


def _tile(table: Table, column: Column, i: int) -> dict[str, Any] | None:
    metric = column.metric

    def best(kind: str) -> tuple[Row, float] | None:
        means = [
            (row, cell.mean) for row in table.rows if row.kind == kind and (cell := row.cells[i].measured) is not None
        ]
        full = [(row, mean) for row, mean in means if row.n == table.n] or means
        return max(full, key=lambda pair: pair[1] if metric.higher_is_better else -pair[1], default=None)

    ours = best("ours")
    if ours is None:
        return None
    estimate = ours[0].cells[i].measured
    assert estimate is not None
    marks = [(kind, found) for kind in ("trivial", "ours", "ceiling") if (found := best(kind)) is not None]
    finite = [mean for _, (_, mean) in marks if math.isfinite(mean)]
    everything = [c.mean for row in table.rows if (c := row.cells[i].measured) is not None and math.isfinite(c.mean)]
    low, high = min(everything), max(everything)
    worst, top = (low, max(finite)) if metric.higher_is_better else (high, min(finite))
    span = (top - worst) or 1.0
    value, spread = format_estimate(estimate, metric.decimals)
    views = [
        {
            "kind": kind,
            "at": f"{100 * min(max((mean - worst) / span, 0.0), 1.0):.1f}",
            "title": f"{row.label} {format_number(mean, metric.decimals)}",
        }
        for kind, (row, mean) in marks
    ]
    return {
        "what": f"{column.group} {metric.label} {metric.arrow}, {table.title.lower()} {table.protocol_label}",
        "value": value,
        "spread": spread,
        "unit": metric.unit,
        "by": ours[0].label,
        "marks": views,
        "aria": "; ".join(view["title"] for view in views),
    }
