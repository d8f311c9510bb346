"""A run of `unirender bench warm-start`: measures with progress, prints, writes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from unirender_evaluation.records import Record
from unirender_evaluation.studies.about import description
from unirender_evaluation.studies.folder import open_folder, write_study
from unirender_evaluation.studies.progress import collect
from unirender_evaluation.studies.warm_start import tables
from unirender_evaluation.studies.warm_start.measure import WarmStart, measure
from unirender_evaluation.suites.suite import Scene

NAME = "warm_start"


def our_method(checkpoint: Path | None) -> Any:
    """Our model as the benchmark's row asks it: one step, the mean."""
    from unirender_evaluation.claims import OURS
    from unirender_evaluation.runs.config import BenchConfig, build_rows

    rows = build_rows(BenchConfig(methods=("ours",), checkpoint=checkpoint))
    return next(row.method for row in rows if row.info.key == OURS)


def run(what: WarmStart, scenes: Sequence[Scene], console: Console) -> list[Record]:
    """Measures what is missing and writes `warm_start.md` and `warm_start.json`."""
    with open_folder(what.out):
        total = len(scenes) * len(list(what.questions()))
        records, computed = collect(measure(what, scenes), total, "warm start", console)
        made = tables.tables(records, what.geometries)
        prediction = f"{what.base.name} {what.base.config.get('weights', '')[:12]}".strip()
        about = description(what.suite, what.code, prediction=prediction)
        counts = f"{computed} new records of {len(records)}"
        content = tables.to_json(records, what.geometries, about)
        write_study(what.out / NAME, made, about, content, counts, console)
        return records
