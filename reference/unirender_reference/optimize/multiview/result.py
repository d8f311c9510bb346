"""The last act of a run: everything it found goes into its folder, `solution.json` last."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from unirender.system.whole_files import file_sha256
from unirender_reference.optimize.exposure import divided_views, exposure_of_views, lit
from unirender_reference.optimize.files.export import SOLUTION_FILE, write_record, write_solution
from unirender_reference.optimize.files.state import RunFolder
from unirender_reference.optimize.refine.losses import psnr_db
from unirender_reference.optimize.refine.watch import FIGURE, Watch
from unirender_reference.optimize.shape.coverage import coverage_of, mask_iou
from unirender_reference.optimize.show.plots import loss_curve
from unirender_reference.optimize.show.strips import turntable, views_strip
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.solution_scene import solution_images
from unirender_reference.optimize.views import Views
from unirender_reference.shapes import Sphere

PART, REFINE = ".result.part", "refine"
SPP = 64  # of each half of the samples; figures are of both, free of their variance


def write_result(
    solution: Solution,
    views: Views,
    folder: RunFolder,
    header: Mapping[str, Any],
    place: Sphere | None = None,
    *,
    pictures: bool = True,
    clock: Callable[[], float] | None = None,
) -> dict[str, str]:
    """Writes all files of a result; each appears whole, and `solution.json` after all others.

    Figures and pictures of linear views are at their exposure, the light is in their unit.

    Args:
        solution: what was found.
        views: what it was found from.
        folder: of the run.
        header: what the run was given: `config` as a dict, and what else goes into the record.
        place: where the object stands in its own units.
        pictures: whether to render a turntable and strips of the views.
        clock: gives the seconds of the whole run, for the record.

    Returns:
        The names of the files, with the sha256 of each.
    """
    temporary = folder.out / PART
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    write_solution(solution, temporary, place)
    exposure = exposure_of_views(views)
    views, shown = divided_views(views, exposure), lit(solution, 1 / exposure)
    every = (*views.seen, *views.held_out)
    halves = [solution_images(shown, every, SPP, seed) for seed in (0, 1)]
    if pictures:
        views_strip(views, (halves[0] + halves[1]) / 2).save(temporary / "views.png")
        turntable(shown).save(temporary / "turntable.png")
    history = folder.history()
    loss_curve(history, temporary / "loss.png")
    count = len(views.seen)
    figures = {"seen_psnr_db": psnr_db(views, views.seen, *(half[:count] for half in halves))}
    if views.held_out:
        figures["held_out_psnr_db"] = psnr_db(views, views.held_out, *(half[count:] for half in halves))
    record = {
        "object": solution.obj.name,
        "figures": {name: round(value, 3) for name, value in figures.items()},
        "figures_are": f"masked PSNR of display values, 2 x {SPP} spp, without the samples' variance",
        "mask_iou": round(mask_iou(every, coverage_of(every, solution.obj)), 4),
        "views": {"seen": count, "held_out": len(views.held_out), "hdr": views.hdr},
        "size": [views.height, views.width],
        "stages": stage_records(history, header["config"]["patience"]),
        "seconds": None if clock is None else round(clock(), 3),
        "place": None if place is None else {"center": place.center.tolist(), "radius": place.radius},
        **header,
    }
    write_record(temporary, record)
    files = sorted(path for path in temporary.rglob("*") if path.is_file())
    found = {path.relative_to(temporary).as_posix(): file_sha256(path) for path in files}
    _move_in(temporary, folder.out)
    return found


def stage_records(history: Sequence[Mapping[str, Any]], patience: int) -> list[dict[str, Any]]:
    """Steps of each stage, how many seconds it took, and of a refinement the step whose state was kept.

    What is done between two stages (charts, textures) counts for the later one.

    Args:
        history: lines of `history.jsonl`.
        patience: of the run; 0: the last state is kept, else the best by the held-out views where there are any.
    """
    rows, before = stage_table(history), 0.0
    for row in rows:
        row["seconds"], before = round(row["seconds"] - before, 3), row["seconds"]
        if not row["stage"].startswith(REFINE):
            continue
        watch = Watch(patience)
        for line in history:
            if line["stage"] == row["stage"] and FIGURE in line["values"]:
                watch.look(line["iteration"], line["values"][FIGURE])
        row["kept_step"] = row["steps"] if not patience or watch.best_db is None else watch.best_iteration
    return rows


def stage_table(history: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Steps of each stage, and the second of the run at its last step."""
    rows: dict[str, dict[str, Any]] = {}
    for line in history:
        rows[line["stage"]] = {"stage": line["stage"], "steps": line["iteration"], "seconds": line["seconds"]}
    return list(rows.values())


def _move_in(temporary: Path, out: Path) -> None:
    for path in sorted(temporary.iterdir(), key=lambda path: path.name == SOLUTION_FILE):
        target = out / path.name
        if target.is_dir():
            shutil.rmtree(target)
        path.replace(target)
    temporary.rmdir()
