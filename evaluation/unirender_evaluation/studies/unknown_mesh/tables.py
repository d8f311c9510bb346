"""The tables of the unknown meshes: an object a row, their mean, and the aims."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.multiview.settings import MultiviewSettings
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE, SECONDS
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import INTERVAL, Estimate, mean_estimate, unprinted_note
from unirender_evaluation.studies.cells import as_json
from unirender_evaluation.studies.unknown_mesh.scoring import CHAMFER, MASK_IOU, NORMAL_COSINE, SHAPE, STEEP, STEEP_DEG
from unirender_evaluation.tables.formats import estimate_text, format_number, header, json_text
from unirender_evaluation.tables.specs import Column
from unirender_evaluation.tables.text import TextTable
from unirender_reference.multiview import ELEVATIONS_DEG

SHAPE_COLUMNS = (
    Column("", SHAPE, MASK_IOU),
    Column("", SHAPE, NORMAL_COSINE),
    Column("", SHAPE, CHAMFER),
    Column(f"from {STEEP_DEG:g}° above and below", STEEP, MASK_IOU),
    Column(f"from {STEEP_DEG:g}° above and below", STEEP, NORMAL_COSINE),
)
LOOK_COLUMNS = tuple(
    column for column in MULTIVIEW_TABLE.columns if column.quantity != "time" and "lpips" not in column.metric.name
)


@dataclass(frozen=True)
class Aim:
    """A value that each object shall reach."""

    name: str
    column: Column
    bound: float

    def met(self, value: float) -> bool:
        return value >= self.bound if self.column.metric.higher_is_better else value <= self.bound

    @property
    def text(self) -> str:
        return f"{self.name} {'>=' if self.column.metric.higher_is_better else '<='} {self.bound:g}"


AIMS = (
    Aim("mask IoU", SHAPE_COLUMNS[0], 0.97),
    Aim("normal cosine", SHAPE_COLUMNS[1], 0.93),
    Aim("seconds", Column("", "time", SECONDS), 600.0),
)


def tables(records: Sequence[Record], names: Mapping[str, str], settings: MultiviewSettings) -> list[TextTable]:
    """Shape, looks and seconds."""
    stages = [key.split(".")[0].removeprefix("time_") for key in records[-1].values if key.startswith("time_")]
    times = (*(Column(stage, f"time_{stage}", SECONDS) for stage in stages), Column("all", "time", SECONDS))
    given = f"{settings.seen} views, no mesh"
    return [
        _table(f"Shape: {given}", SHAPE_COLUMNS, records, names, (*shape_notes(settings), *aim_notes(records))),
        _table(f"Materials and light: {given}", LOOK_COLUMNS, records, names, look_notes(settings)),
        _table(
            f"Seconds: {given}",
            times,
            records,
            names,
            ("Wall clock of each stage to its last step; all: with the result's files.",),
        ),
    ]


def _table(
    title: str, columns: Sequence[Column], records: Sequence[Record], names: Mapping[str, str], notes: tuple[str, ...]
) -> TextTable:
    keys = [column.key(DEFAULT_VARIANT) for column in columns]
    rows = [
        (
            names[record.sample],
            *(_cell(record.values.get(key), column) for key, column in zip(keys, columns, strict=True)),
        )
        for record in records
    ]
    means = [_mean(records, key) for key in keys]
    texts = (estimate_text(mean, column.metric.decimals) for mean, column in zip(means, columns, strict=True))
    titles = ("object", *(f"{column.group} {header(column)}".strip() for column in columns))
    sections = (tuple(rows), ((f"mean (n = {len(records)})", *texts),))
    return TextTable(title, titles, sections, (*notes, *unprinted_note(means)))


def _cell(value: float | None, column: Column) -> str:
    return "-" if value is None else format_number(value, column.metric.decimals)


def _mean(records: Sequence[Record], key: str) -> Estimate | None:
    values = [record.values[key] for record in records if key in record.values]
    return mean_estimate(values) if values else None


def aim_notes(records: Sequence[Record]) -> tuple[str, ...]:
    """How many objects reach each aim, and what the mean is."""
    notes = []
    for aim in AIMS:
        values = [record.values[aim.column.key(DEFAULT_VARIANT)] for record in records]
        mean = format_number(sum(values) / len(values), aim.column.metric.decimals)
        notes.append(f"Aim: {aim.text}: {sum(map(aim.met, values))} of {len(values)} objects, mean {mean}.")
    return tuple(notes)


def shape_notes(settings: MultiviewSettings) -> tuple[str, ...]:
    """What the figures of the shape are."""
    columns, elevations = (MASK_IOU, NORMAL_COSINE, CHAMFER), ELEVATIONS_DEG[: settings.seen]
    return (
        f"Given: {settings.seen} pictures (8-bit sRGB) with soft masks and cameras all around, at elevations of "
        f"{min(elevations):g}° to {max(elevations):g}°. Scored from {settings.held_out} cameras midway between them; "
        "the steep ones stand where no picture was taken.",
        "; ".join(f"{metric.label}: {metric.formula}" for metric in columns) + ".",
        f"Means: ± half of the {INTERVAL}.",
    )


def look_notes(settings: MultiviewSettings) -> tuple[str, ...]:
    """What the figures of the looks are."""
    return (
        "As in the multi-view table, by rendered buffers: inside the true mask, weighted by coverage; what the result "
        "does not cover there is black, with roughness and metallic 0. Aligned: one "
        "least-squares factor in linear light, for albedo of the object, for relit of each picture.",
        f"Maps: all {settings.seen + settings.held_out} cameras; novel view and relit: the held-out ones, "
        f"{settings.truth_spp} spp, against results at {settings.spp} spp.",
    )


def to_json(records: Sequence[Record], names: Mapping[str, str], run: Mapping[str, Any]) -> str:
    """Everything: what ran, the aims, every value of every object and the means of what the tables show."""
    means = {}
    for column in (*SHAPE_COLUMNS, *LOOK_COLUMNS, AIMS[-1].column):
        key = column.key(DEFAULT_VARIANT)
        values = [record.values[key] for record in records if key in record.values]
        if values:
            means[key] = as_json(mean_estimate(values))
    aims = [{"name": aim.name, "key": aim.column.key(DEFAULT_VARIANT), "bound": aim.bound} for aim in AIMS]
    objects = [{"name": names[record.sample], **json.loads(record.to_json())} for record in records]
    content = {"run": dict(run), "aims": aims, "mean": means, "objects": objects}
    return json_text(content)
