"""The report: one self-contained HTML file that works from file:// without a network.

Tables with the published value beside the measured one and the protocol below, the standing of our rows between the
trivial ones and the noise ceiling, one tick per sample, the run's verdict and paired ones, a gallery that begins with
the failures, and a table of all samples that opens to every row's numbers.
This module turns results into view models; `templates/` lays them out.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from unirender.system.whole_files import replace_file
from unirender_evaluation.comparisons import Selection, verdicts
from unirender_evaluation.metrics import Variant
from unirender_evaluation.records import METHOD_KINDS, Record, RunInfo
from unirender_evaluation.report.gallery import GalleryItem, hero, shelves, shown_width
from unirender_evaluation.report.plots import LEADING, heading, is_headline, strip_plots, tiles
from unirender_evaluation.report.samples import Place, Sheet, sample_sections
from unirender_evaluation.tables.build import Cell, Row, Table
from unirender_evaluation.tables.counts import cell_counts
from unirender_evaluation.tables.formats import (
    NOT_AVAILABLE,
    format_estimate,
    format_number,
    header,
    measured_text,
    row_label,
    to_json,
)
from unirender_evaluation.tables.specs import TABLES, TableSpec

TITLE = "Rendering and inverse rendering, scored against path tracing"
TEMPLATES = Path(__file__).parents[1] / "templates"
STATES = ("HOLDS", "FAILS", "open", "stated")  # how a line of it may begin
DENSE = 8  # columns: from here on the interval stands below its mean
KIND_NAMES = {
    "ours": "ours",
    "paper": "published only",
    "optimisation": "optimisation",
    "baseline": "closed form",
    "external": "other systems",
    "trivial": "trivial",
    "ceiling": "bounds",
    "reference": "bounds",
}


def write_report(
    path: Path,
    tables: Sequence[Table],
    gallery: Sequence[GalleryItem],
    run: RunInfo,
    records: Sequence[Record] = (),
    *,
    specs: Mapping[str, TableSpec] | None = None,
    sheets: Mapping[Place, Sheet] | None = None,
    verdict: str = "",
) -> Path:
    """Writes the report, atomically.

    Args:
        path: the HTML file.
        tables: in the order in which they are shown; variants of one table become tabs.
        gallery: samples with pictures; shown by table and protocol, worst first.
        run: rows and protocol.
        records: per-sample values for distributions, verdicts and the table of samples; none = without these sections.
        specs: columns, for tables beyond `TABLES`.
        sheets: pictures of samples for the table of samples.
        verdict: what `verdict.verdict_text` says of the run; empty = the report has no such list.

    Returns:
        The path.
    """
    specs = TABLES if specs is None else specs
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = _with_code
    most = shown_width(gallery)
    samples = sample_sections(tables, records, run, sheets or {})
    page = environment.get_template("report.html.j2").render(
        title=TITLE,
        lede=_lede(run, tables),
        watermark=next((table.watermark for table in tables if table.watermark), None),
        resolution=run.resolution,
        hero=hero(gallery, run),
        tiles=tiles(tables),
        kinds=_kinds(tables),
        blocks=[_block(list(group)) for _, group in groupby(tables, key=_identity)],
        strips=strip_plots(specs, records, run),
        claims=_claims(verdict),
        verdicts=_verdicts(specs, records, run),
        gallery=shelves(gallery, run, {name: spec.title for name, spec in specs.items()}, most),
        footer=f"{run.suite} {run.suite_hash[:12]} · code {run.code or '-'} · {run.date or 'no date'}.",
        shown=most if most < run.resolution else None,
        samples=[{"which": section["which"], "title": section["title"]} for section in samples],
        samples_json=_inline(json.dumps(samples, separators=(",", ":"), allow_nan=False, ensure_ascii=False)),
        json=_inline(to_json(tables)),
    )
    return replace_file(path, page)


def _with_code(text: str) -> Markup:
    """Text whose commands stand between backticks."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _inline(data: str) -> Markup:
    """JSON inside a script element: nothing in it ends the element."""
    return Markup(data.replace("<", "\\u003c"))


def _lede(run: RunInfo, tables: Sequence[Table]) -> str:
    truth = f"truth path-traced by Mitsuba {run.mitsuba}" if run.mitsuba else "truth"
    spp = f" at {run.truth_spp} samples per pixel" if run.truth_spp else ""
    n = max((table.n for table in tables), default=0)
    return (
        f"Suite “{run.suite}” at {run.resolution} x {run.resolution} pixels, {truth}{spp}. Up to {n} samples a table; "
        "every number with its protocol, every published value beside the one measured here."
    )


def _identity(table: Table) -> tuple[str, str, str]:
    return (table.name, table.protocol_key, table.subset)


def _block(variants: Sequence[Table]) -> dict[str, Any]:
    first = variants[0]
    suffix = "" if first.subset == "main" else f" ({first.subset})"
    title, panels = heading(first.title, first.protocol_key) + suffix, [_panel(table) for table in variants]
    for panel in panels:
        panel["name"] = f"{title}, {panel['tab']}" if len(panels) > 1 else title
    return {"title": title, "panels": panels}


def _panel(table: Table) -> dict[str, Any]:
    """A table as the report's template takes it."""
    metrics = {column.metric.name: column for column in table.columns}.values()
    return {
        "dense": len(table.columns) >= DENSE,
        "metrics": [f"{header(c)}: {c.metric.formula}; perfect {_perfect(c.metric.perfect)}" for c in metrics],
        "tab": _tab(table.variant, any(table.published_columns)),
        "groups": [(name, len(list(columns))) for name, columns in groupby(table.columns, key=lambda c: c.group)],
        "heads": [
            {"text": _unbroken(header(column)), "formula": f"{column.metric.formula} [{column.key(table.variant)}]"}
            for column in table.columns
        ],
        "sections": [
            [_row(row, table) for row in rows] for _, rows in groupby(table.rows, key=lambda row: row.section)
        ],
        "protocol": table.protocol,
        "notes": table.notes,
    }


def _unbroken(text: str) -> str:
    """Text that stays on one line, as a heading with its unit and arrow."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def _perfect(value: float) -> str:
    return f"{value:g}".replace("inf", "∞")


def _kinds(tables: Sequence[Table]) -> list[tuple[str, str]]:
    """(kind, name) of the rows' marks, for the legend."""
    present = {row.kind for table in tables for row in table.rows}
    named = {KIND_NAMES[kind]: kind for kind in METHOD_KINDS if kind in present}
    return [(kind, name) for name, kind in named.items()]


def _tab(variant: Variant, with_published: bool) -> str:
    text = {"whole": "whole frame", "masked": "inside the mask"}[variant.mask]
    other = [word for word in (variant.space, variant.scale) if word not in ("srgb", "raw")]
    return ", ".join([text + (", beside the paper" if with_published else ""), *other])


def _row(row: Row, table: Table) -> dict[str, Any]:
    counts = cell_counts(table.rows, row)
    pairs = zip(row.cells, table.columns, strict=True)
    cells = [_cell(cell, column.metric.decimals, counts.get(i)) for i, (cell, column) in enumerate(pairs)]
    label = row_label(row, table).replace("n = ", _unbroken("n = "))
    return {"label": label, "kind": row.kind, "cells": cells}


def _cell(cell: Cell, decimals: int, few: int | None) -> dict[str, Any]:
    """One cell, with its n where it is on fewer samples than others and the row's label does not say so (`few`)."""
    view: dict[str, Any] = {"value": None, "sort": "", "missing": measured_text(cell), "published": None}
    if cell.published is not None:
        view["missing"] = NOT_AVAILABLE if cell.unavailable else ""
        view["published"] = format_number(cell.published, decimals) + ("†" if cell.dagger else "")
        view["published_best"] = cell.published_rank == 1
        view["sort"] = cell.published
    if cell.measured is not None:
        value, spread = format_estimate(cell.measured, decimals)
        ends = (cell.measured.low, cell.measured.high)
        interval = f"95 % interval [{', '.join(format_number(x, decimals) for x in ends)}], " if spread else ""
        view |= {
            "value": value,
            "spread": spread,
            "n": "" if few is None else f"n = {few}",
            "sort": cell.measured.mean,
            "rank": {1: "best", 2: "second"}.get(cell.measured_rank or 0, ""),
            "title": f"{interval}n = {cell.measured.n}, {cell.measured.clusters} objects",
        }
    return view


def _claims(verdict: str) -> dict[str, Any] | None:
    """The lines of `verdict.txt` below its heading, each with the word that it begins with; None without a verdict."""
    head, *lines = verdict.splitlines() or [""]
    return {"head": head, "lines": [_claim(line.strip()) for line in lines]} if lines else None


def _claim(line: str) -> dict[str, str]:
    word, _, rest = line.partition(" ")
    return {"state": word, "text": rest.strip()} if word in STATES else {"state": "", "text": line}


def _verdicts(specs: Mapping[str, TableSpec], records: Sequence[Record], run: RunInfo) -> list[dict[str, Any]]:
    """The headline comparisons of every table, as the report's template takes them."""
    groups = []
    for spec in specs.values():
        for protocol in spec.protocols:
            chosen = Selection(spec.name, protocol).of(records)
            headlines = tuple(column for column in spec.columns if is_headline(spec.name, column))
            shown = replace(spec, columns=headlines)
            rows = []
            for column, found in (pair for kind in LEADING for pair in verdicts(shown, chosen, run, kind=kind)):
                digits, difference = column.metric.decimals, found.difference
                unit = f" {column.metric.unit}" if column.metric.unit else ""
                interval = f"[{difference.low:+.{digits}f}, {difference.high:+.{digits}f}]"
                rows.append(
                    {
                        "a": run.method(found.a).label,
                        "b": run.method(found.b).label,
                        "verdict": found.verdict,
                        "strong": found.a_beats_b,
                        "what": f"{column.group} {column.metric.label} {column.metric.arrow}",
                        "difference": f"{difference.mean:+.{digits}f}{unit}",
                        "interval": interval if difference.clusters > 1 else "-",
                        "n": f"{difference.n} ({difference.clusters} objects)",
                    }
                )
            if rows:
                groups.append({"title": heading(spec.title, protocol), "rows": rows})
    return groups
