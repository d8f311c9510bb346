"""The report's samples: what every row scored on every sample, and a small sheet of pictures where they were kept.

The page holds the numbers once, as JSON rounded to the tables' digits; `templates/samples.js` makes a sortable table of
them, a sample a line. A sheet shows the truth above what the leading row made of it. Sheets are lossy and small, so
that a page of any suite stays a few megabytes; nothing is measured on them, and the cards of the gallery are exact.
"""

import base64
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.color import eight_bits
from unirender_evaluation.metrics import DEFAULT_VARIANT, Variant
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.report.gallery import GalleryItem, Mask, Picture, picture_size, shrink_covered
from unirender_evaluation.report.plots import heading
from unirender_evaluation.tables.build import Table
from unirender_evaluation.tables.specs import Column

SHEET_SIDE = 96  # of a picture in a sheet, pixels: at most
SHEET_QUALITY = 80  # WebP
SHEET_BYTES = 3_000_000  # of all sheets together, as they stand in the page

Place = tuple[str, str, str]  # table, protocol, sample


@dataclass(frozen=True)
class Sheet:
    """A sample's pictures: `names` above, the truth in the first line, the row `method` in the second."""

    uri: str
    width: int
    height: int
    names: tuple[str, ...]
    method: str
    caption: str


def sample_sections(
    tables: Sequence[Table], records: Sequence[Record], run: RunInfo, sheets: Mapping[Place, Sheet]
) -> list[dict[str, Any]]:
    """One section per table and protocol that has records: its numbers, rows and samples, for the page's JSON.

    Args:
        tables: give titles, columns, and the variants that are shown: those of the tables.
        records: of the run.
        run: names the rows.
        sheets: pictures by table, protocol and sample.
    """
    sections = []
    for (name, protocol, subset), group in groupby(tables, key=lambda t: (t.name, t.protocol_key, t.subset)):
        variants = list(group)
        chosen = [r for r in records if (r.table, r.protocol, r.subset) == (name, protocol, subset)]
        if not chosen:
            continue
        columns = list(_columns(sorted(variants, key=lambda table: table.variant != DEFAULT_VARIANT)))  # ours first
        methods = [row.key for row in variants[0].rows if any(r.method == row.key for r in chosen)]
        by_sample: dict[str, dict[str, Record]] = {}
        for record in chosen:
            by_sample.setdefault(record.sample, {})[record.method] = record
        suffix = "" if subset == "main" else f" ({subset})"
        sections.append(
            {
                "which": f"{name}-{protocol}",
                "title": heading(variants[0].title, protocol) + suffix,
                "columns": [view for _, _, view in columns],
                "methods": [{"label": run.method(key).label, "kind": run.method(key).kind} for key in methods],
                "samples": [
                    _sample(sample, found, methods, columns, run, sheets.get((name, protocol, sample)))
                    for sample, found in sorted(by_sample.items())
                ],
            }
        )
    return sections


def _columns(variants: Iterable[Table]) -> Iterator[tuple[str, Column, dict[str, Any]]]:
    """(metric key, column, view) of every number that some variant of a table shows, each once."""
    seen = set()
    for table in variants:
        for column in table.columns:
            key = column.key(table.variant)
            if key in seen:
                continue
            seen.add(key)
            metric = column.metric
            view = {
                "text": f"{column.group} {metric.label}",
                "unit": metric.unit,
                "arrow": metric.arrow,
                "higher": metric.higher_is_better,
                "digits": metric.decimals,
                "variant": _variant_text(table.variant),
                "key": key,
            }
            yield key, column, view


def _variant_text(variant: Variant) -> str:
    mask = {"whole": "whole frame", "masked": "inside the mask"}[variant.mask]
    return ", ".join([mask, *(word for word in (variant.space, variant.scale) if word not in ("srgb", "raw"))])


def _sample(
    sample: str,
    found: Mapping[str, Record],
    methods: Sequence[str],
    columns: Sequence[tuple[str, Column, dict[str, Any]]],
    run: RunInfo,
    sheet: Sheet | None,
) -> dict[str, Any]:
    """One line: values by row and column; a row that did not answer has null."""
    values = [
        [_number(found[m].values.get(key), c.metric.decimals) for key, c, _ in columns] if m in found else None
        for m in methods
    ]
    view: dict[str, Any] = {"id": sample, "object": next(iter(found.values())).object, "values": values}
    if sheet is not None:
        view["sheet"] = {
            "uri": sheet.uri,
            "width": sheet.width,
            "height": sheet.height,
            "names": sheet.names,
            "method": run.method(sheet.method).label,
            "caption": sheet.caption,
        }
    return view


def _number(value: float | None, digits: int) -> float | str | None:
    """Rounded as in the tables; JSON has no infinity, so that one is a string."""
    if value is None:
        return None
    return round(value, digits) if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def make_sheets(items: Iterable[GalleryItem], limit: int = SHEET_BYTES) -> dict[Place, Sheet]:
    """Sheets of samples in their order, until they would take more than `limit` bytes of the page.

    Args:
        items: samples with the pictures of their leading row; worst first, so that failures have theirs. They are made
            one by one, and no more of them than fit.
        limit: bytes of all data URIs together.
    """
    sheets: dict[Place, Sheet] = {}
    used = 0
    for item in items:
        sheet = _sheet(item)
        used += len(sheet.uri)
        if used > limit:
            break
        sheets[item.table, item.protocol, item.sample] = sheet
    return sheets


def _sheet(item: GalleryItem) -> Sheet:
    made = item.predictions[item.leader]
    names = [name for name in item.truth if name in made]
    columns = [(item.truth[name], made[name]) for name in names]
    seen = next((picture for name, picture in item.given.items() if name == "input"), None)
    if seen is not None:
        names, columns = ["input", *names], [(seen, np.ones_like(seen)), *columns]
    side = picture_size(item.mask.shape[1], SHEET_SIDE)
    masks = [item.mask] * len(columns)
    if seen is not None and item.given_mask is not None:
        masks[0] = item.given_mask
    lines = zip(*columns, strict=True)
    cover = [[_covered(picture, mask, side) for picture, mask in zip(line, masks, strict=True)] for line in lines]
    if seen is not None:
        cover[1][0] = np.zeros_like(cover[1][0])  # nothing below the input
    sheet = np.concatenate([np.concatenate(line, axis=1) for line in cover], axis=0)
    buffer = io.BytesIO()
    levels = eight_bits(sheet)
    Image.fromarray(levels).save(buffer, format="WEBP", quality=SHEET_QUALITY, method=4)
    uri = "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
    caption = " · ".join(text for text in (item.question, item.caption) if text)
    return Sheet(uri, sheet.shape[1], sheet.shape[0], tuple(names), item.leader, caption)


def _covered(picture: Picture, mask: Mask, side: int) -> Float[np.ndarray, "s t 4"]:
    return np.concatenate(shrink_covered(picture, mask, side), axis=-1)
