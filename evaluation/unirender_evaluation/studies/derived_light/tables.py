"""The tables of the derived light: medians by object and roughness, and how far each truth's noise lies below them."""

import json
import math
from collections.abc import Mapping, Sequence
from statistics import median

from unirender_evaluation.records import Record
from unirender_evaluation.studies.derived_light.measure import (
    COVERED,
    DIFFUSE,
    FLOOR_DB,
    FULL,
    MASKED,
    PREFILTERED,
    SMALL,
    SPHERE,
    SUBPIXEL_SIDE,
    SUBPIXELS,
    SURE,
    TRUTH,
    roughness_of,
)
from unirender_evaluation.tables.formats import json_text
from unirender_evaluation.tables.text import TextTable

AIM_DB = 35.0
COLUMNS = {
    "derived": (FULL, MASKED),
    "covered whole": (FULL, COVERED),
    f"{SUBPIXEL_SIDE} x {SUBPIXEL_SIDE} normals": (SUBPIXELS, MASKED),
    "light 16 x 32": (SMALL, MASKED),
    "N = V = R": (PREFILTERED, MASKED),
}


def values_of(records: Sequence[Record], name: str, question: str, method: str, key: str) -> list[float]:
    """One figure of an object, over the lights."""
    return [
        record.values[key]
        for record in records
        if (record.object, record.protocol, record.method) == (name, question, method) and key in record.values
    ]


def table(records: Sequence[Record], questions: Sequence[str], lights: Sequence[str]) -> TextTable:
    """A section for each object, a row for each question: medians over the lights, and the lowest noise floor."""
    sections = []
    for name in dict.fromkeys(record.object for record in records):
        rows = []
        for question in questions:
            cells = [values_of(records, name, question, *which) for which in COLUMNS.values()]
            floors = values_of(records, name, question, TRUTH, MASKED)
            rows.append((f"{name}, {label(question)}", *map(_median, cells), f"{min(floors):.1f}"))
        sections.append(tuple(rows))
    title = (
        f"s (by roughness) and d from normal, roughness and light: masked PSNR in dB, median over {len(lights)} lights"
    )
    return TextTable(title, ("object", *COLUMNS, "noise floor"), tuple(sections), notes(records, lights))


def label(question: str) -> str:
    """A question as a row says it: s with its roughness."""
    return "d" if question == DIFFUSE else f"s {roughness_of(question):g}"


def notes(records: Sequence[Record], lights: Sequence[str]) -> tuple[str, ...]:
    """What a reader must know, and whether the aim was met."""
    floors = [record.values[SURE] for record in records if record.method == TRUTH]
    return (
        "Truth: Mitsuba's unshadowed pass, clipped and in sRGB as the suites score s and d, weighted by coverage. The "
        "noise floor, the least over the lights, is what a noise-free prediction would score, from the variance "
        f"between batches; two standard errors below it, all {len(floors)} truths have at least {min(floors):.1f} dB "
        f"(asked: {FLOOR_DB:g}).",
        "Derived: from one normal a pixel, the mean over its coverage, and the light at its own resolution. Covered "
        "whole: the same over the pixels in which every ray meets the object. "
        f"{SUBPIXEL_SIDE} x {SUBPIXEL_SIDE} normals: from that many a pixel, averaged; what they add is what one "
        "normal cannot say. N = V = R: the usual prefiltered lookup; it has no d of its own.",
        f"Lights: {', '.join(lights)}.",
        aim(records),
    )


def aim(records: Sequence[Record]) -> str:
    """Whether the medians reach `AIM_DB`, of the sphere and of all objects."""
    questions = list(dict.fromkeys(record.protocol for record in records))
    parts = []
    for words, names in (("the sphere", {SPHERE}), ("all objects", {record.object for record in records})):
        found = {
            question: median(v for name in names for v in values_of(records, name, question, FULL, MASKED))
            for question in questions
        }
        missed = [f"{label(question)} ({value:.1f})" for question, value in found.items() if value < AIM_DB]
        parts.append(
            f"{words}: " + (f"missed by {', '.join(missed)}" if missed else f"met, least {min(found.values()):.1f}")
        )
    return f"Aim: a median of {AIM_DB:g} dB each. " + "; ".join(parts) + "."


def _median(values: Sequence[float]) -> str:
    return f"{median(values):.1f}" if values else "-"


def to_json(records: Sequence[Record], about: Mapping[str, object]) -> str:
    """Every record, with what was measured."""
    every = [json.loads(record.to_json()) for record in records]
    medians = {
        f"{name}/{question}": {
            column: median(found)
            for column, which in COLUMNS.items()
            if (found := values_of(records, name, question, *which)) and math.isfinite(median(found))
        }
        for name in dict.fromkeys(record.object for record in records)
        for question in dict.fromkeys(record.protocol for record in records)
    }
    content = {"run": dict(about), "median_psnr_db": medians, "records": every}
    return json_text(content)
