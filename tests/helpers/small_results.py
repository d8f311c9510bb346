"""A small run's results in memory: three rows on four samples of two objects, two tables."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from unirender_evaluation.comparisons import Lights
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.results.data import Results, definitions
from unirender_evaluation.results.file import to_document

HASH = "0123456789abcdef" * 4
METHODS = (
    MethodInfo("ours-mean", "Ours (mean)", "ours", "Ours", 1, 1, 0, config={"checkpoint": "a"}),
    MethodInfo("input-as-albedo", "input as albedo", "trivial", config={"trivial": "input"}),
    MethodInfo("noise-ceiling", "Noise ceiling", "ceiling", config={"bound": "noise-ceiling"}),
)
SCENES = ("ball-0_l0", "ball-0_l1", "ball-1_l0", "ball-2_l0")  # of three objects
LEVELS = {"ours-mean": 20.0, "input-as-albedo": 12.0, "noise-ceiling": 46.0}
RUN = RunInfo(
    "ball", HASH, 32, METHODS, coverage=0.3, mitsuba="3.9.1", truth_spp=64, code="abc", date="2026-01-31", seeds=(0,)
)


def small_lights() -> Lights:
    """Each scene has a light of its own; all are relit by the same."""
    return {name: own for scene in SCENES for name, own in ((scene, (scene,)), (f"{scene}_to_x", (scene, "x")))}


def small_records() -> list[Record]:
    """Albedo in both masks and roughness; the relit picture without the ceiling."""
    records = []
    for method, level in LEVELS.items():
        for i, name in enumerate(SCENES):
            db = level + 0.5 * i
            values = {metric_key("albedo", "psnr", Variant(mask)): db for mask in ("masked", "whole")}
            values[metric_key("roughness", "mse")] = 1 / db
            records.append(Record("inverse", "single-image", method, name, name[:6], values))
            if method != "noise-ceiling":
                relit = {metric_key("relit", "psnr"): db - 1}
                records.append(Record("relighting", "from-image-hdri", method, f"{name}_to_x", name[:6], relit))
    return records


def small_results(source: str = "a.json", methods: tuple[str, ...] = tuple(LEVELS), **changes: Any) -> Results:
    """Results of some of the rows; `changes` are fields of the run."""
    records = tuple(record for record in small_records() if record.method in methods)
    run = replace(RUN, methods=tuple(info for info in METHODS if info.key in methods), **changes)
    return Results(run, records, definitions(records), source, small_lights())


def small_document() -> dict[str, Any]:
    """The JSON document of a whole run."""
    results = small_results()
    return to_document(results.run, results.records, results.definitions, results.lights)


def written(path: Path, document: Any) -> Path:
    """The path of a JSON file with this document."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path
