"""What is said below a table: the rows' notes, who has fewer samples, what a sign in a cell means, what is stored."""

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from unirender_evaluation.metrics import Variant
from unirender_evaluation.statistics import UNTOLD, unprinted_note
from unirender_evaluation.tables.counts import cell_counts, label_n
from unirender_evaluation.tables.specs import TableSpec

NAMED = (
    "[Name]: the system whose values in the paper stand in this row. What is measured is the row that is named before "
    "it, another implementation, if its note does not say otherwise."
)

if TYPE_CHECKING:
    from unirender_evaluation.tables.build import Row


def table_notes(
    spec: TableSpec, rows: Sequence["Row"], variant: Variant, told: Collection[str] = (), over_lights: bool = False
) -> tuple[str, ...]:
    """The notes, in their order.

    Args:
        spec: of the table.
        rows: ranked.
        variant: how its numbers are taken.
        told: keys of the rows that are nearer to the truth than any picture tells (`told`).
        over_lights: whether its intervals are over lights, too.
    """
    shown = {column.group for column in spec.columns}
    about = [spec.description, *(remark for remark, groups in spec.remarks if not shown.isdisjoint(groups))]
    notes = [" ".join(about)] if spec.description else []
    notes += [f"{row.label}: {row.info.note}" for row in rows if row.info is not None and row.info.note]
    if any(row.info and row.label != row.info.label for row in rows):
        notes.append(NAMED)
    fewer = [f"{row.label} ({said})" for row in rows if (said := _counts_said(spec, rows, row))]
    if fewer:
        notes.append(f"Measured on fewer samples than others and not ranked: {'; '.join(fewer)}.")
    known = [row.label for row in rows if row.key in told]
    if known:
        notes.append(
            "Not ranked, since answers are the truth but for rounding or exceed the noise ceiling (verdict): "
            f"{'; '.join(known)}."
        )
    measured = [cell.measured for row in rows for cell in row.cells]
    notes += unprinted_note(measured)
    if over_lights and any(e and math.isfinite(e.mean) and math.isnan(e.half_width) for e in measured):
        notes.append(UNTOLD)
    if any(cell.dagger for row in rows for cell in row.cells):
        notes.append(
            "† The published value is worse than what the constant 0.5 scores on materials that are spread evenly over "
            "the paper's grid, as here; how those of its test objects are spread the paper does not say."
        )
    if any(cell.unavailable for row in rows for cell in row.cells):
        notes.append(
            "n/a: the weights of this LPIPS backbone are not on this machine; "
            "`python -m unirender_evaluation.lpips_convert vgg` fetches and converts them."
        )
    origins = dict.fromkeys(row.stored for row in rows if row.stored)
    stored = {origin: "; ".join(row.label for row in rows if row.stored == origin) for origin in origins}
    notes += _exact(spec, rows, variant)
    return (*notes, *(f"{labels}: stored, not measured in this run ({origin})" for origin, labels in stored.items()))


def _counts_said(spec: TableSpec, rows: Sequence["Row"], row: "Row") -> str:
    """On how many samples a row's cells stand that are on fewer than others: that behind its label, then others."""
    label, columns = label_n(rows, row), spec.columns
    others: dict[str, set[int]] = {}
    for i, n in cell_counts(rows, row).items():
        others.setdefault(columns[i].group, set()).add(n)
    found = [] if label is None else [f"n = {label}"]
    for group, counts in others.items():
        found.append(f"{group} n = {' and '.join(map(str, sorted(counts)))}")
    return ", ".join(found)


def _exact(spec: TableSpec, rows: Sequence["Row"], variant: Variant) -> tuple[str, ...]:
    """The notes on infinite means that say nothing: by a fitted scale, and by a part of the samples."""
    by_fit, by_part = [], []
    for row in rows:
        for column, cell in zip(spec.columns, row.cells, strict=True):
            if cell.measured is not None and cell.exact:
                found = by_part if column.variant(variant).scale == "raw" else by_fit
                what = f"{column.group} {column.metric.label}"
                found.append(f"{row.label} ({what}: {cell.exact} of {cell.measured.n} samples)")
    fit = "∞ under a fitted scale is an exact fit, as any constant has on an object of one colour, and is not ranked"
    part = "∞ by samples that are the truth to the bit says nothing of the others, and is not ranked"
    return tuple(f"{said}: {'; '.join(found)}." for said, found in ((fit, by_fit), (part, by_part)) if found)
