"""A run of `unirender bench sampling`: measures with progress, prints, writes."""

import os
from collections.abc import Sequence

from rich.console import Console

from unirender_evaluation.records import Record
from unirender_evaluation.studies.about import code_digest, today
from unirender_evaluation.studies.folder import open_folder, write_files
from unirender_evaluation.studies.progress import collect
from unirender_evaluation.studies.sampling import tables
from unirender_evaluation.studies.sampling.measure import PROTOCOLS, SamplingStudy, measure
from unirender_evaluation.studies.sampling.plots import draw_reliability, draw_steps
from unirender_evaluation.suites.suite import Scene
from unirender_evaluation.versions import installed_version

NAME = "sampling"
STEPS_PLOT, RELIABILITY_PLOT = "sampling.png", "calibration.png"


def run(what: SamplingStudy, scenes: Sequence[Scene], console: Console) -> list[Record]:
    """Measures what is missing and writes `sampling.md`, `.json`, `.png` and `calibration.png`."""
    with open_folder(what.out):
        total = len(scenes) * len(what.settings) * len(PROTOCOLS)
        records, computed = collect(measure(what, scenes), total, "sampling", console)
        about = protocol(what, scenes)
        made = tables.tables(records, what.settings, about)
        files: dict[str, str | bytes] = {
            f"{NAME}.md": "\n".join(table.markdown() for table in made),
            f"{NAME}.json": tables.to_json(records, what.settings, about),
            STEPS_PLOT: draw_steps(records, what.settings),
        }
        if (shown := tables.headline(what.settings)) is not None:
            files[RELIABILITY_PLOT] = draw_reliability(records, shown)
        write_files(what.out, files)
        for table in made:
            table.show(console)
        names = ", ".join(files)
        console.print(f"{computed} new records of {len(records)}; {what.out}: {names}", highlight=False, markup=False)
        return records


def protocol(what: SamplingStudy, scenes: Sequence[Scene]) -> tuple[tuple[str, str], ...]:
    """(what, value) pairs: everything one must know to compare a figure with one's own."""
    size, objects = what.suite.spec.resolution, {scene.object for scene in scenes}
    return (
        ("pictures", f"{len(scenes)} of {len(objects)} objects, 8-bit sRGB, {size} x {size} px, one material each"),
        ("given", "decompose: picture, mask, camera; render: true maps, s and d of one of the suite's edits"),
        ("maps", "not closed"),
        ("mask", "inside the true mask, weighted by coverage"),
        ("colour", "sRGB"),
        ("scale alignment", "none"),
        ("sampler", f"{what.sampler}; mean: one step from the fixed noise"),
        ("seed", str(what.seed)),
        ("device", what.device),
        ("weights", what.weights[:12]),
        ("suite", f"{what.suite.spec.name} {what.suite.sha256[:12]}"),
        ("cores", str(os.cpu_count())),
        ("code", f"{code_digest(what.code)}, torch {installed_version('torch')}"),
        ("date", today()),
    )
