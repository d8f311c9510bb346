"""The tables of the warm start: a block for each geometry, and the paired differences."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from unirender_evaluation.light_metrics import PEAK_ANGLE, SCALED_LOG_RMSE
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.multiview.tables import SECONDS, plain_column
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import INTERVAL
from unirender_evaluation.studies.cells import as_json, difference, estimate
from unirender_evaluation.studies.warm_start.measure import COLD, PICTURE, PREDICTION, STEPS, WARM
from unirender_evaluation.tables.formats import format_estimate, header, json_text, signed
from unirender_evaluation.tables.specs import Column
from unirender_evaluation.tables.text import TextTable

TITLES = {
    "known-mesh": "known mesh (normals and shadows)",
    "predicted-normals": "no mesh, predicted normals",
    "true-normals": "no mesh, true normals as a map (for reference)",
}
LABELS = {COLD: "cold", WARM: "warm", PREDICTION: "prediction alone"}
PAIRS = ((WARM, COLD), (WARM, PREDICTION))


COLUMNS = (
    plain_column("albedo", "albedo", "psnr"),
    plain_column("albedo (aligned)", "albedo", "psnr", scale="aligned"),
    plain_column("roughness", "roughness", "mse"),
    plain_column("metallic", "metallic", "mse"),
    plain_column("light", "environment", SCALED_LOG_RMSE),
    plain_column("light", "environment", PEAK_ANGLE),
    plain_column("normal", "normal", "cosine"),
    plain_column("relit", "relit", "psnr"),
    plain_column("relit (aligned)", "relit", "psnr", scale="aligned"),
    plain_column("fit", "fit", "psnr"),
    plain_column("", "time", STEPS),
    plain_column("", "time", SECONDS),
)


def block(records: Sequence[Record], geometry: str) -> list[Record]:
    """The records of one geometry, and those of the prediction on the same scenes."""
    own = [record for record in records if record.protocol == geometry]
    scenes = {record.sample for record in own}
    return own + [record for record in records if record.protocol == PICTURE and record.sample in scenes]


def tables(records: Sequence[Record], geometries: Sequence[str]) -> list[TextTable]:
    """A table for each geometry, a figure a row: cold, warm, the prediction, and the paired differences."""
    titles = ("figure", *LABELS.values(), *(f"{LABELS[a]} - {LABELS[b]}" for a, b in PAIRS))
    made = []
    for geometry in geometries:
        own = block(records, geometry)
        count = len({record.sample for record in own})
        rows = tuple(
            (
                f"{column.group} {header(column)}".strip(),
                *(_mean(own, method, column) for method in LABELS),
                *(_difference(own, a, b, column) for a, b in PAIRS),
            )
            for column in COLUMNS
        )
        made.append(
            TextTable(
                f"Warm start, {TITLES[geometry]}: n = {count}",
                titles,
                (rows,),
                NOTES if geometry == geometries[-1] else (),
            )
        )
    return made


NOTES = (
    f"Differences are paired by picture: mean [{INTERVAL}]. Inside the true "
    "mask, weighted by coverage. Fit and relit: `shade` of the result under its own light, against the picture, and "
    "under the object's other light, against Mitsuba's path tracing of the truth. Aligned: one "
    "least-squares factor in linear light, for albedo of the object, for relit of each picture.",
    "Seconds: of the optimisation; a warm start's prediction comes on top. Cold and warm have the same configuration; "
    "a stage ends early when a step gains little.",
)


def _difference(records: Sequence[Record], a: str, b: str, column: Column) -> str:
    found, digits = difference(records, a, b, column), column.metric.decimals
    if found is None:
        return "-"
    interval = "" if math.isnan(found.low) else f" [{signed(found.low, digits)}, {signed(found.high, digits)}]"
    return f"{signed(found.mean, digits)}{interval}"


def _mean(records: Sequence[Record], method: str, column: Column) -> str:
    found = estimate(records, method, column.key(DEFAULT_VARIANT))
    return "-" if found is None else format_estimate(found, column.metric.decimals)[0]


def to_json(records: Sequence[Record], geometries: Sequence[str], run: Mapping[str, Any]) -> str:
    """Means, differences with their intervals, and every record."""
    blocks = {}
    for geometry in geometries:
        own = block(records, geometry)
        means = {
            method: {c.key(DEFAULT_VARIANT): as_json(estimate(own, method, c.key(DEFAULT_VARIANT))) for c in COLUMNS}
            for method in LABELS
        }
        pairs = {
            f"{a} - {b}": {c.key(DEFAULT_VARIANT): as_json(difference(own, a, b, c)) for c in COLUMNS} for a, b in PAIRS
        }
        blocks[geometry] = {"mean": means, "difference": pairs}
    every = [json.loads(record.to_json()) for record in records]
    content = {"run": dict(run), "geometries": blocks, "records": every}
    return json_text(content)
