"""The table of training choices: means over scenes, and paired differences from the first row."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from typing import Any

from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.multiview.tables import plain_column
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import INTERVAL, unprinted_note
from unirender_evaluation.studies.cells import Cell, as_json, cell_text, row_cells
from unirender_evaluation.studies.training.choices import PLAIN, QUESTIONS, Choice
from unirender_evaluation.tables.formats import header, json_text
from unirender_evaluation.tables.text import TextTable

COLUMNS = (
    plain_column("albedo", "albedo", "psnr"),
    plain_column("normal", "normal", "cosine"),
    plain_column("roughness", "roughness", "mse"),
    plain_column("metallic", "metallic", "mse"),
    plain_column("render of true maps", "render", "psnr"),
    plain_column("edit", "edit", "psnr"),
    plain_column("own maps, own render", "again", "psnr"),
    plain_column("own maps, Mitsuba", "again_mitsuba", "psnr"),
)
NOTE = (
    f"Mean over scenes; in brackets the paired difference from the first row, ± half of its "
    f"{INTERVAL}; **bold** where the interval excludes 0, each number by itself: of equal rows one in twenty "
    "or more does by chance. Masked, sRGB. Own maps: the network's decomposition (not closed), rendered by the network "
    "and shaded by Mitsuba, against the picture. The networks are far from fully trained: the table says what helps "
    "early, at this size."
)


def cells(records: Sequence[Record], method: str) -> tuple[Cell, ...]:
    """The cells of a row in the order of `COLUMNS`."""
    return row_cells(records, method, PLAIN, COLUMNS)


def table(rows: Sequence[Choice], records: Sequence[Record]) -> TextTable:
    """A row for each choice, those that answer one question together."""
    sections, differences = [], []
    for group, members in groupby(rows, key=lambda row: row.group):
        lines = []
        for row in members:
            own = cells(records, row.name)
            differences += [cell.difference for cell in own]
            texts = [cell_text(cell, column.metric.decimals) for cell, column in zip(own, COLUMNS, strict=True)]
            lines.append((f"{QUESTIONS[group]}: {row.label}" if group else row.label, *texts))
        sections.append(tuple(lines))
    titles = ("training", *(f"{column.group} {header(column)}" for column in COLUMNS))
    count = len({record.sample for record in records})
    notes = (NOTE, *unprinted_note(differences))
    return TextTable(f"Choices of training: n = {count}", titles, tuple(sections), notes)


def to_json(rows: Sequence[Choice], records: Sequence[Record], run: Mapping[str, Any]) -> str:
    """Configurations, means, differences with their intervals, and every record."""
    lines = {
        row.name: {
            "label": row.label,
            "config": asdict(row.config),
            "cells": {
                c.key(DEFAULT_VARIANT): {"mean": cell.mean, "n": cell.n, "difference": as_json(cell.difference)}
                for c, cell in zip(COLUMNS, cells(records, row.name), strict=True)
            },
        }
        for row in rows
    }
    every = [json.loads(record.to_json()) for record in records]
    return json_text({"run": dict(run), "rows": lines, "records": every})
