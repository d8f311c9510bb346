"""Tables: from per-sample records to rows with the published value beside the measured one.

The paper's three tables keep its rows, columns and order; a system that does not run here shows its published value
and "-" for the measured one. Each protocol is a table of its own: only the paper's protocol carries published values,
so that "given" inputs can never stand beside them. Nothing is printed without its protocol (`Table.protocol`).
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from unirender.errors import UnirenderError
from unirender_evaluation.claims import CEILING
from unirender_evaluation.comparisons import Lights, Selection, misleading_exact, over_lights, values_of
from unirender_evaluation.metrics import DEFAULT_VARIANT, LPIPS_SCALES, PUBLISHED_VARIANT, Metric, Variant
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.statistics import Estimate, mean_estimate
from unirender_evaluation.tables.counts import short_cells
from unirender_evaluation.tables.notes import table_notes
from unirender_evaluation.tables.protocol import protocol_line
from unirender_evaluation.tables.published import PublishedRow, published_tables
from unirender_evaluation.tables.specs import GRID_TOLERANCE, PROTOCOLS, TABLES, Column, TableSpec
from unirender_evaluation.tables.told import told_the_truth

OTHER_AXES = {"linear": "linear light", "aligned": "scale-aligned", "aligned_rgb": "scale-aligned per channel"}
RANKED_KINDS = ("ours", "paper", "optimisation", "baseline", "external", "trivial")  # bounds are no competitors
KIND_ORDER = ("ours", "paper", "optimisation", "external", "baseline", "trivial", "ceiling", "reference")
SECTIONS = {
    "data-driven": "Data-driven methods",
    "optimisation": "Optimisation",
    "ours": "Ours",
    "paper": "Other systems",
    "external": "Other systems",
    "baseline": "Closed form",
    "trivial": "Trivial",
    "ceiling": "Bounds",
    "reference": "Bounds",
}


@dataclass(frozen=True)
class Cell:
    """One cell: the published value and the measured estimate, either may be missing."""

    published: float | None = None
    measured: Estimate | None = None
    unavailable: bool = False  # the metric could not be computed here: "n/a" instead of "-"
    published_rank: int | None = None  # 1 = best, 2 = second, on rounded values
    measured_rank: int | None = None
    exact: int = 0  # samples that are right to the bit, and make a mean that says nothing (`misleading_exact`)
    dagger: bool = False  # published value worse than the constant's


@dataclass(frozen=True)
class Row:
    """One system."""

    key: str
    label: str
    kind: str
    section: str
    cells: tuple[Cell, ...]
    info: MethodInfo | None = None  # None = published only
    n: int = 0  # samples behind the fullest of its measured cells
    stored: str | None = None


@dataclass(frozen=True)
class Table:
    """A finished table; `tables.formats` renders it."""

    name: str
    title: str
    protocol_key: str
    protocol_label: str
    subset: str
    variant: Variant
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    protocol: tuple[tuple[str, str], ...]  # (what, value): printed with the table
    notes: tuple[str, ...] = ()
    watermark: str | None = None
    n: int = 0

    def __repr__(self) -> str:
        return f"Table({self.heading}: {len(self.rows)} rows, {len(self.columns)} columns)"

    @property
    def published_columns(self) -> tuple[bool, ...]:
        """For each column, whether any row has a published value."""
        return tuple(any(row.cells[i].published is not None for row in self.rows) for i in range(len(self.columns)))

    @property
    def heading(self) -> str:
        """The title with its protocol, where that says more, and what is counted."""
        same = self.protocol_label.casefold() == self.title.casefold()
        other = [OTHER_AXES[word] for word in (self.variant.space, self.variant.scale) if word in OTHER_AXES]
        mask = [self.variant.mask] if PROTOCOLS[self.protocol_key].framed else []
        counted = ", ".join([*mask, *other, *(() if self.subset == "main" else (self.subset,))])
        title = f"{self.title}{'' if same else f': {self.protocol_label}'}"
        return f"{title} ({counted})" if counted else title


def build_table(
    spec: TableSpec,
    records: Sequence[Record],
    run: RunInfo,
    *,
    protocol: str,
    variant: Variant = DEFAULT_VARIANT,
    subset: str = "main",
    lights: Lights | None = None,
) -> Table:
    """Aggregates records to one table.

    Args:
        spec: columns and title.
        records: of any table; those of this table, protocol and subset are used.
        run: the rows' descriptions and the protocol.
        protocol: key of `PROTOCOLS`. Published values appear only where it carries them, under `PUBLISHED_VARIANT`.
        variant: how numbers are taken, where a column does not pin it.
        subset: population.
        lights: of all samples: intervals are over objects and lights. None: over objects.

    Raises:
        UnirenderError: if the protocol is not one of the table's, a record's method is not described in `run`, or the
            lights of a sample are asked for and not named.
    """
    if protocol not in spec.protocols:
        raise UnirenderError(f"table {spec.name!r}: got protocol {protocol!r}, expected one of {spec.protocols}")
    declared = PROTOCOLS[protocol]
    chosen = Selection(spec.name, protocol, subset).of(records)
    methods = [run.method(key) for key in dict.fromkeys(record.method for record in chosen)]
    show_published = declared.published and variant == PUBLISHED_VARIANT and subset == "main"
    spec = _answered(spec, chosen, show_published)
    published_in = spec.name if show_published and spec.name in published_tables() else None
    measured = {info.key: _measured_row(spec, chosen, run, info, variant, lights) for info in methods}
    rows = _merge(published_tables()[published_in] if published_in else (), spec, measured)
    rows = [row for row in rows if any(cell != Cell() for cell in row.cells)]
    total = max((row.n for row in rows), default=0)
    asked = {CEILING, *(row.key for row in rows if row.kind == "external")}
    told = told_the_truth(spec, [record for record in chosen if record.method in asked], variant)
    rows = _rank(spec, rows, told)
    return Table(
        name=spec.name,
        title=spec.title,
        protocol_key=protocol,
        protocol_label=declared.label,
        subset=subset,
        variant=variant,
        columns=spec.columns,
        rows=tuple(rows),
        protocol=protocol_line(declared, variant, run, methods, chosen, spec.columns, published_in, lights is not None),
        notes=table_notes(spec, rows, variant, told, lights is not None),
        watermark=None if run.limit is None else f"--limit {run.limit}: a partial run, not a result",
        n=total,
    )


def build_tables(
    records: Sequence[Record],
    run: RunInfo,
    specs: Mapping[str, TableSpec] | None = None,
    variants: Sequence[Variant] | None = None,
    lights: Lights | None = None,
) -> list[Table]:
    """Every table, protocol and subset that has records.

    Args:
        records: of any table.
        run: the rows' descriptions and the protocol.
        specs: tables by name; None: those of the paper.
        variants: each table in each of these; where two differ only on axes that no column of a table has (as in the
            physics table), it appears once. None: masked, which is what we believe, and before it, where published
            values stand, the whole frame that they were taken on.
        lights: as `build_table` takes them.
    """
    tables = []
    for spec in (TABLES if specs is None else specs).values():
        for protocol in spec.protocols:
            found = [record for record in records if record.table == spec.name and record.protocol == protocol]
            for subset in dict.fromkeys(["main", *(record.subset for record in found)]):
                if not any(record.subset == subset for record in found):
                    continue
                carries = PROTOCOLS[protocol].published and subset == "main"
                usual = (PUBLISHED_VARIANT, DEFAULT_VARIANT) if carries else (DEFAULT_VARIANT,)
                for variant in usual if variants is None else _telling(spec, variants):
                    which: dict[str, Any] = {"protocol": protocol, "variant": variant, "subset": subset}
                    tables.append(build_table(spec, records, run, **which, lights=lights))
    return tables


def _telling(spec: TableSpec, variants: Sequence[Variant]) -> list[Variant]:
    """The variants that give a table other numbers than one before; axes that none of its columns has are the usual."""
    axes = {axis for column in spec.columns for axis in column.metric.axes if axis not in column.overrides}
    usual = {name: getattr(DEFAULT_VARIANT, name) for name in ("mask", "space", "scale") if name not in axes}
    return list(dict.fromkeys(dataclasses.replace(variant, **usual) for variant in variants))


def _answered(spec: TableSpec, records: Sequence[Record], show_published: bool) -> TableSpec:
    """The table without columns whose quantity nobody was asked for under this protocol."""
    asked = {key.partition(".")[0] for record in records for key in record.values}
    kept = [column for column in spec.columns if column.quantity in asked or (show_published and column.published)]
    return dataclasses.replace(spec, columns=tuple(kept))


def _measured_row(
    spec: TableSpec, records: Sequence[Record], run: RunInfo, info: MethodInfo, variant: Variant, lights: Lights | None
) -> Row:
    """A row's cells: the mean of each column over the samples that have a value."""
    own = [record for record in records if record.method == info.key]
    objects = {record.sample: record.object for record in own}
    cells, n = [], 0
    for column in spec.columns:
        values = values_of(own, info.key, column.key(variant))
        backbone = column.metric.name.removeprefix("lpips_")
        asked_for = column.metric.name.startswith("lpips_") and column.variant(variant).scale in LPIPS_SCALES
        missing = asked_for and backbone not in run.lpips
        if values:
            if lights is None:
                estimate = mean_estimate(list(values.values()), [objects[sample] for sample in values])
            else:
                estimate = over_lights(values, own, lights)
            cells.append(Cell(measured=estimate, exact=misleading_exact(column.key(variant), values.values())))
            n = max(n, estimate.n)
        else:
            answered = (key.startswith(f"{column.quantity}.") for record in own for key in record.values)
            cells.append(Cell(unavailable=missing and any(answered)))
    return Row(info.key, info.label, info.kind, SECTIONS[info.kind], tuple(cells), info, n, info.stored)


def _merge(published: Sequence[PublishedRow], spec: TableSpec, measured: Mapping[str, Row]) -> list[Row]:
    """The paper's rows in its order, a measured row in the place of its namesake, then the remaining measured rows."""
    rows, left = [], dict(measured)
    for entry in published:
        values = [entry.values.get(column.published_key) if column.published else None for column in spec.columns]
        namesakes = [row for row in left.values() if row.info and entry.is_called(row.info.published)]
        section = SECTIONS[entry.group]
        if not namesakes:
            cells = tuple(Cell(published=value) for value in values)
            rows.append(Row(f"published:{entry.name}", entry.label, "paper", section, cells))
        for position, row in enumerate(namesakes):
            pairs = zip(row.cells, values, strict=True)
            cells = tuple(dataclasses.replace(c, published=v) if position == 0 else c for c, v in pairs)
            label = f"{row.label} [{entry.label}]" if position == 0 and row.label != entry.label else row.label
            rows.append(dataclasses.replace(row, cells=cells, label=label, section=section))
            del left[row.key]
    return rows + sorted(left.values(), key=lambda row: KIND_ORDER.index(row.kind))


def _rank(spec: TableSpec, rows: Sequence[Row], told: Collection[str] = ()) -> list[Row]:
    """Ranks 1 and 2 per column on rounded values; a cell on fewer samples than the column's fullest is not ranked, nor
    is one that is infinite by a part of its samples, or by a fit, nor one of a row that was `told` the truth.
    """
    short = [short_cells(rows, row) for row in rows]
    ranked = [list(row.cells) for row in rows]
    for i, column in enumerate(spec.columns):
        cells = [row.cells[i] for row in rows]
        published = {r: cell.published for r, cell in enumerate(cells) if cell.published is not None}
        means = {r: cell.measured.mean for r, cell in enumerate(cells) if cell.measured is not None}
        competing = {r: mean for r, mean in means.items() if _competes(rows[r], told) and i not in short[r]}
        competing = {r: mean for r, mean in competing.items() if not cells[r].exact}
        published_ranks, measured_ranks = _ranks(published, column.metric), _ranks(competing, column.metric)
        trivial = [mean for r, mean in means.items() if rows[r].kind == "trivial"]
        grid = column.uniform_grid  # comparable only where the suite's materials are spread over the paper's grid
        trivial = [mean for mean in trivial if grid is not None and abs(mean - grid) <= GRID_TOLERANCE]
        for r, cell in enumerate(cells):
            ranked[r][i] = dataclasses.replace(
                cell,
                published_rank=published_ranks.get(r),
                measured_rank=measured_ranks.get(r),
                dagger=r in published and any(column.metric.better(mean, published[r]) for mean in trivial),
            )
    return [dataclasses.replace(row, cells=tuple(cells)) for row, cells in zip(rows, ranked, strict=True)]


def _competes(row: Row, told: Collection[str]) -> bool:
    return row.kind in RANKED_KINDS and row.key not in told


def _ranks(values: Mapping[int, float], metric: Metric) -> dict[int, int]:
    """Row -> 1 or 2, ties share a rank; nothing to rank with fewer than two rows."""
    if len(values) < 2:
        return {}
    rounded = {r: round(value, metric.decimals) for r, value in values.items()}
    order = sorted(set(rounded.values()), reverse=metric.higher_is_better)
    return {r: order.index(value) + 1 for r, value in rounded.items() if value in order[:2]}
