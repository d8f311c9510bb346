"""The report: one self-contained HTML file that works from file:// without a network.

Tables with the published value beside the measured one and the protocol below, the standing of our rows between the
trivial ones and the noise ceiling, one tick per sample, paired verdicts, and a gallery that begins with the failures.
This module turns results into view models; `templates/` lays them out.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from unirender_evaluation.comparisons import Selection, verdicts
from unirender_evaluation.gallery import GalleryItem, data_uri, flip_map
from unirender_evaluation.metrics import DEFAULT_VARIANT, Variant
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.report_plots import strip_plots, tiles
from unirender_evaluation.specs import PROTOCOLS, TABLES, TableSpec
from unirender_evaluation.table_formats import (
    NOT_AVAILABLE,
    format_estimate,
    format_number,
    header,
    measured_text,
    row_label,
    to_json,
)
from unirender_evaluation.tables import Cell, Row, Table

TEMPLATES = Path(__file__).parent / "templates"
HEADLINE = ("psnr", "mse", "cosine")  # metrics of the verdicts, the tiles and the distributions
FLIP_TEXT = "FLIP {:.3f}"


def write_report(
    path: Path,
    tables: Sequence[Table],
    gallery: Sequence[GalleryItem],
    run: RunInfo,
    records: Sequence[Record] = (),
    *,
    specs: Mapping[str, TableSpec] | None = None,
    title: str = "Rendering and inverse rendering, scored against path tracing",
) -> Path:
    """Writes the report, atomically.

    Args:
        path: the HTML file.
        tables: in the order in which they are shown; variants of one table become tabs.
        gallery: samples with pictures; shown by table and protocol, worst first.
        run: rows and protocol.
        records: per-sample values for distributions and verdicts; none = these sections are left out.
        specs: columns, for tables beyond `TABLES`.
        title: heading of the page.

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
    page = environment.get_template("report.html.j2").render(
        title=title,
        lede=_lede(run, tables),
        watermark=next((table.watermark for table in tables if table.watermark), None),
        resolution=run.resolution,
        hero=_hero(gallery, run),
        tiles=tiles(tables, HEADLINE),
        blocks=[_block(list(group)) for _, group in groupby(tables, key=_identity)],
        strips=strip_plots(specs, records, run, HEADLINE),
        verdicts=_verdicts(specs, records, run),
        gallery=_gallery(gallery, run),
        footer=f"{run.suite} {run.suite_hash[:12]} · code {run.code or '-'} · {run.date or 'no date'}.",
        json=Markup(to_json(tables).replace("</", "<\\/")),
    )
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(page)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    return path


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
    return {
        "title": f"{first.title}: {first.protocol_label}{suffix}",
        "panels": [_panel(table) for table in variants],
    }


def _panel(table: Table) -> dict[str, Any]:
    return {
        "tab": _tab(table.variant, any(table.published_columns)),
        "groups": [(name, len(list(columns))) for name, columns in groupby(table.columns, key=lambda c: c.group)],
        "heads": [
            {"text": header(column), "formula": f"{column.metric.formula} [{column.key(table.variant)}]"}
            for column in table.columns
        ],
        "sections": [
            [_row(row, table) for row in rows] for _, rows in groupby(table.rows, key=lambda row: row.section)
        ],
        "protocol": table.protocol,
        "notes": table.notes,
    }


def _tab(variant: Variant, with_published: bool) -> str:
    text = {"whole": "whole frame", "masked": "inside the mask"}[variant.mask]
    other = [word for word in (variant.space, variant.scale) if word not in ("srgb", "raw")]
    return ", ".join([text + (", beside the paper" if with_published else ""), *other])


def _row(row: Row, table: Table) -> dict[str, Any]:
    pairs = zip(row.cells, table.columns, strict=True)
    return {
        "label": row_label(row, table),
        "kind": row.kind,
        "cells": [_cell(cell, column.metric.decimals) for cell, column in pairs],
    }


def _cell(cell: Cell, decimals: int) -> dict[str, Any]:
    view: dict[str, Any] = {"value": None, "sort": "", "missing": measured_text(cell), "published": None}
    if cell.published is not None:
        view["missing"] = NOT_AVAILABLE if cell.unavailable else ""
        view["published"] = format_number(cell.published, decimals) + ("†" if cell.dagger else "")
        view["published_best"] = cell.published_rank == 1
        view["sort"] = cell.published
    if cell.measured is not None:
        value, spread = format_estimate(cell.measured, decimals)
        low, high = (format_number(x, decimals) if x == x else "-" for x in (cell.measured.low, cell.measured.high))
        view |= {
            "value": value,
            "spread": spread,
            "sort": cell.measured.mean,
            "rank": {1: "best", 2: "second"}.get(cell.measured_rank or 0, ""),
            "title": f"95 % interval [{low}, {high}], n = {cell.measured.n}, {cell.measured.clusters} objects",
        }
    return view


def _verdicts(specs: Mapping[str, TableSpec], records: Sequence[Record], run: RunInfo) -> list[dict[str, Any]]:
    groups = []
    for spec in specs.values():
        for protocol in spec.protocols:
            chosen = Selection(spec.name, protocol).of(records)
            rows = []
            for column, found in verdicts(spec, chosen, run, variant=DEFAULT_VARIANT) if chosen else ():
                if column.metric.name not in HEADLINE:
                    continue
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
                groups.append({"title": f"{spec.title}: {PROTOCOLS[protocol].label}", "rows": rows})
    return groups


def _which(item: GalleryItem) -> str:
    return f"{item.table}-{item.protocol}"


def _which_label(item: GalleryItem) -> str:
    protocol = PROTOCOLS[item.protocol].label if item.protocol in PROTOCOLS else item.protocol
    return f"{item.table}, {protocol}"


def _hero(gallery: Sequence[GalleryItem], run: RunInfo) -> dict[str, Any] | None:
    """What was given, and what the first row of ours made of it, on the median sample: picked by rank, not by eye."""
    ours = {info.key for info in run.methods if info.kind == "ours"}
    candidates = [item for item in gallery if item.table == "inverse" and ours & item.predictions.keys()]
    if not candidates:
        return None
    item = sorted(candidates, key=lambda item: -item.badness)[len(candidates) // 2]
    method = next(key for key in item.predictions if key in ours)
    pictures = [*item.given.items(), *item.predictions[method].items()]
    return {
        "pictures": [(name, data_uri(picture, item.mask)) for name, picture in pictures],
        "caption": f"{run.method(method).label} on the sample of median score: {item.caption} ({item.sample}).",
    }


def _gallery(gallery: Sequence[GalleryItem], run: RunInfo) -> list[dict[str, Any]]:
    """Cards by table and protocol, worst first in each."""
    groups = []
    for which in dict.fromkeys(_which(item) for item in gallery):
        items = sorted((item for item in gallery if _which(item) == which), key=lambda item: -item.badness)
        cards = [_card(item, run, f"{which}-{rank}", f"{rank} of {len(items)}") for rank, item in enumerate(items, 1)]
        groups.append({"which": which, "title": _which_label(items[0]), "cards": cards})
    return groups


def _card(item: GalleryItem, run: RunInfo, identity: str, rank: str) -> dict[str, Any]:
    names = list(item.truth)
    return {
        "id": identity,
        "caption": item.caption,
        "sub": f"{rank} · {item.sample}",
        "names": names,
        "truth": [data_uri(picture, item.mask) for picture in item.truth.values()],
        "given": [(f"given: {name}", data_uri(picture, item.mask)) for name, picture in item.given.items()],
        "rows": [
            {"label": label, "cells": [_prediction(item, cells[n], n, run) if n in cells else None for n in names]}
            for label, cells in picture_rows(item, run)
        ],
    }


def picture_rows(item: GalleryItem, run: RunInfo) -> list[tuple[str, dict[str, str]]]:
    """(label, map -> method key): a row per method, but trivial methods for different maps share rows."""
    rows: list[tuple[str, dict[str, str]]] = []
    shared: list[dict[str, str]] = []
    for method, made in item.predictions.items():
        cells = {name: method for name in item.truth if name in made}
        if run.method(method).kind != "trivial" or len(item.truth) == 1:
            rows.append((run.method(method).label, cells))
            continue
        free = next((row for row in shared if not row.keys() & cells.keys()), None)
        if free is None:
            shared.append(cells)
        else:
            free.update(cells)
    return rows + [("Trivial", cells) for cells in shared]


def _prediction(item: GalleryItem, method: str, name: str, run: RunInfo) -> dict[str, str]:
    picture = item.predictions[method][name]
    error, mean = flip_map(picture, item.truth[name], item.mask)
    score, label = item.scores.get(method, {}).get(name, ""), run.method(method)
    alone = label.kind != "trivial" or len(item.truth) == 1
    return {
        "uri": data_uri(picture, item.mask),
        "name": "" if alone else label.label,
        "score": score,
        "flip": data_uri(error, item.mask),
        "flip_mean": FLIP_TEXT.format(mean),
    }


def worst_samples(records: Iterable[Record], key: str, method: str, *, higher_is_better: bool, count: int) -> list[str]:
    """Samples on which a method scores worst by a metric key, worst first: what to hand to the gallery."""
    values = {
        record.sample: record.values[key] for record in records if record.method == method and key in record.values
    }
    return sorted(values, key=lambda sample: values[sample] if higher_is_better else -values[sample])[:count]
