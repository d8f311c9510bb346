"""`bench run`: a suite x rows -> per-sample records, tables, verdict and report in one folder.

    records.jsonl run.json        every value with its content key; the rows and the protocol (see `records`)
    records.csv                   every value on a line of its own, for spreadsheets and data frames
    truth_check.json              what was rendered again on the spot, and how it compares (see `truth_check`)
    tables.md tables.tex tables.json     in the variants that are asked for
    verdict.txt                   who beats whom
    missing.txt                   what a stranger's row has no answer to, a line each (`runs.folder`)
    report.html                   one self-contained page
    results.json                  run.json and records.jsonl as one validated file, for others (see `results.file`)
    unused.jsonl pictures/        records that the run did not ask for; the report's pictures

Running the same command again reuses what is done.
"""

import platform
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from unirender.system.run_progress import progress_bar
from unirender.system.whole_files import replace_file
from unirender_evaluation import bounds, subsets
from unirender_evaluation.methods.mitsuba import MITSUBA
from unirender_evaluation.multiview.pictures import MultiviewPictures
from unirender_evaluation.multiview.rows import multiview_jobs, multiview_rows
from unirender_evaluation.multiview.scenes import multiview_scenes
from unirender_evaluation.physics import rows as physics_rows
from unirender_evaluation.predictions.check import check_predictions
from unirender_evaluation.records import MethodInfo, Record, RunInfo, write_csv, write_run
from unirender_evaluation.results.data import NAME as RESULTS
from unirender_evaluation.results.file import write_results
from unirender_evaluation.results.lights import sample_lights
from unirender_evaluation.rows import Row
from unirender_evaluation.runs.cluster import run_on_cluster
from unirender_evaluation.runs.config import BenchConfig, anywhere, build_rows
from unirender_evaluation.runs.folder import (
    missing_answers,
    say_missing,
    say_rows_without_values,
    unanswered,
    write_missing,
    writing_run,
)
from unirender_evaluation.runs.report import report_run
from unirender_evaluation.runs.truth_check import CheckRequest, reference_row, run_check
from unirender_evaluation.runs.workers import Run, run_in_workers
from unirender_evaluation.store import KEPT, Job, Store
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import Table, build_tables
from unirender_evaluation.tables.protocol import mask_source, with_doubts
from unirender_evaluation.tasks import scene_ids
from unirender_evaluation.truth.make import quality_summary
from unirender_evaluation.verdict import verdict_text
from unirender_evaluation.versions import installed_version, versions
from unirender_reference.folder_lock import locked, made_folder

FEW = 100  # records: fewer are not worth starting processes


@dataclass(frozen=True)
class BenchResult:
    """What a run has found; it `asked` for so many records and `computed` those that were not there, as its dry run
    counts them: without those of the truth check."""

    records: tuple[Record, ...]
    run: RunInfo
    tables: tuple[Table, ...]
    verdict: str
    truth_check: dict[str, Any]
    asked: int
    computed: int

    def __repr__(self) -> str:
        return (
            f"BenchResult(suite {self.run.suite}, {len(self.run.methods)} rows, {len(self.tables)} tables, "
            f"{self.computed} new records of {self.asked})"
        )


def run(config: BenchConfig, console: Console | None = None) -> BenchResult:
    """Runs or continues a benchmark and writes its folder (see the module).

    Raises:
        UnirenderError: unusable suite, folder, checkpoint, plug-in or predictions, no dask for a cluster, or another
            run is writing to the folder; nothing has run then. Or the folder cannot be written any more, or a method
            fails: a second run continues from there. A failed truth check or claim is no error: the verdict says so.
    """
    if config.cluster is not None:
        from unirender_reference.cluster import check_machine

        check_machine(config.cluster)
    config = anywhere(config)
    here = prepare(config)
    with made_folder(config.out), locked(config.out), writing_run(config.out):
        return _run(config, here, console or Console())


def _run(config: BenchConfig, here: Run, console: Console) -> BenchResult:
    """Answers what no record answers yet, checks the truth, and writes tables, verdict and report."""
    suite, request = here.suite, check_request(config)
    store = Store.open(config.out / "records.jsonl")
    say = partial(console.print, highlight=False, markup=False, soft_wrap=True)
    missing = missing_answers(suite, here.rows, here.scenes)
    write_missing(config.out, missing)
    say_missing(config.out, missing, say, "has files for")
    with progress_bar(console) as progress:
        check = run_check(request, here, store, progress, say)
        of_check = set(store.used)
        computed = _work(here, config, store, progress) + _optimise_views(here, config, store, progress)
    asked = len(store.used.keys() - of_check)
    records = [record for record in store.close() if record.values]
    without = unanswered(suite, here.rows, here.scenes, records)
    write_missing(config.out, without)
    news = {label: found for label, found in without.items() if found != missing.get(label)}
    say_missing(config.out, news, say, without_files=missing)
    say_rows_without_values(here.rows, records, say)
    if others := store.of_other_code():
        say(f"{others} records of other code are not used; {store.unused_path} keeps the last {KEPT} of each")
    info = _run_info(config, here, check, records)
    write_run(config.out / "run.json", info)
    write_csv(config.out / "records.csv", records)
    tables = build_tables(records, info, ALL_TABLES, config.variants)
    lights = sample_lights(suite)
    verdict = verdict_text(records, info, check, lights)
    result = BenchResult(tuple(records), info, tuple(tables), verdict, check, asked, computed)
    write_outputs(config.out, result)
    report_run(config.out, suite, info, records, tables)
    write_results(config.out / RESULTS, info, records, lights)
    return result


def prepare(config: BenchConfig) -> Run:
    """What is to be scored; nothing is computed or written.

    Raises:
        UnirenderError: unusable suite, checkpoint, plug-in or predictions.
    """
    from unirender_evaluation.lpips import available

    suite, rows, backbones = load_suite(config.suite), build_rows(config), tuple(available())
    scenes = scene_ids(suite, config.limit)
    check_predictions(rows, suite)
    return Run(suite, rows, scenes, versions(backbones), backbones, config.out / "pictures", config.subsets)


def check_request(config: BenchConfig) -> CheckRequest:
    """The truth check that a configuration asks for."""
    return CheckRequest(config.out / "truth_check.json", config.check_scenes, config.check_seed, config.recheck)


def _work(here: Run, config: BenchConfig, store: Store, progress: Progress) -> int:
    """Computes the records that are missing: on a cluster if there is one, else few of them here, many in worker
    processes. Returns how many."""
    bar = progress.add_task("methods", total=None)
    wanted: dict[str, frozenset[str]] = {}  # keys and not jobs, which hold the pictures of their scene
    for scene in here.scenes:
        wanted[scene.key] = frozenset(job.key for job in here.jobs(scene) if not job.is_done(store.has))
    scenes = [scene for scene in here.scenes if wanted[scene.key]]
    scenes.sort(key=lambda scene: -len(wanted[scene.key]))  # those with slow rows first: none is left for the end
    if not scenes:
        progress.remove_task(bar)
        return 0  # a finished run needs no cluster to write its tables again
    wanted = {scene.key: wanted[scene.key] for scene in scenes}
    total = sum(map(len, wanted.values()))
    progress.update(bar, total=total)
    if config.cluster is None and (config.jobs == 0 or total <= FEW):
        for job in (job for scene in scenes for job in here.jobs(scene) if job.key in wanted[scene.key]):
            store.add(job.make())
            progress.update(bar, advance=1, description=job.label)
        return total
    if config.cluster is not None:
        found = run_on_cluster(here, partial(build_rows, config), config.suite, wanted, config.cluster)
    else:
        done = frozenset(store.used)
        found = run_in_workers(here, partial(build_rows, config), scenes, done, min(config.jobs, len(scenes)))
    with closing(found) as finished:
        for records in finished:
            for record in records:
                store.add(record)
            progress.advance(bar, len(records))
    return total


def _views_rows(config: BenchConfig) -> list[Row]:
    """The rows of the multi-view table, if the run has one."""
    return multiview_rows() if "optimisation" in config.methods and config.subsets.views != 0 else []


def views_jobs(here: Run, config: BenchConfig) -> list[Job]:
    """Every record that the run wants of the multi-view table."""
    rows = _views_rows(config)
    scenes = multiview_scenes(here.scenes, config.subsets.views) if rows else []
    pictures = MultiviewPictures(here.pictures)
    return [
        job
        for scene in scenes
        for job in multiview_jobs(here.suite, scene, rows, here.key_of(scene), here.backbones, pictures)
    ]


def _optimise_views(here: Run, config: BenchConfig, store: Store, progress: Progress) -> int:
    """The multi-view table: one optimisation after another, in this process, since their seconds are part of it.
    Returns how many."""
    missing = [job for job in views_jobs(here, config) if not job.is_done(store.has)]
    bar = progress.add_task("multi-view", total=len(missing), visible=bool(missing))
    for job in missing:
        progress.update(bar, description=job.label)
        store.add(job.make())
        progress.advance(bar)
    return len(missing)


def _run_info(config: BenchConfig, here: Run, check: dict[str, Any], records: list[Record]) -> RunInfo:
    """What `run.json` says: suite, versions, machine, and every row that has records."""
    suite, scenes = here.suite, here.scenes
    used = {record.method for record in records}
    infos = [row.described(len(scenes)) for row in here.rows] + [
        *(row.info for row in _views_rows(config)),
        bounds.ceiling_info(suite),
        bounds.TRUE_LIGHT,
        reference_row(check, scenes),
        MITSUBA,
        *physics_rows.INFOS,
    ]
    environment = {name: installed_version(name) for name in ("unirender", "torch", "mitsuba", "numpy")}
    ceiling = quality_summary(suite)["image"]
    environment |= {
        "cpu": platform.machine(),
        "python": platform.python_version(),
        "noise ceiling": f"mean {ceiling['mean_db']:.1f} dB, min {ceiling['min_db']:.1f} dB over {ceiling['n']} images",
    }
    return RunInfo(
        suite=suite.spec.name,
        suite_hash=suite.sha256,
        resolution=suite.spec.resolution,
        methods=tuple(_described(info, records) for info in infos if info.key in used),
        coverage=float(np.mean([suite.mask(scene).mean() for scene in scenes])),
        lpips=here.backbones,
        mitsuba=str(suite.provenance["mitsuba"]),
        truth_spp=round(ceiling["mean_spp"]),
        unchecked=check.get("unchecked", ""),
        code=here.versions.code[:12],
        date=datetime.now(UTC).date().isoformat(),
        limit=subsets.partial(config.limit, len(suite.scenes)),
        seeds=(config.seed,),
        environment=environment,
    )


def _described(info: MethodInfo, records: list[Record]) -> MethodInfo:
    """A row with what its records say of it."""
    return replace(with_doubts(info, records), mask=mask_source(info.key, records))


def write_outputs(out: Path, result: BenchResult) -> None:
    """Writes tables and verdict, each moved into place when complete."""
    from unirender_evaluation.tables.formats import to_json, to_markdown
    from unirender_evaluation.tables.latex import to_latex

    writers: dict[str, Callable[[], str]] = {
        "tables.md": lambda: "\n\n".join(to_markdown(table) for table in result.tables) + "\n",
        "tables.tex": lambda: "\n\n".join(to_latex(table) for table in result.tables) + "\n",
        "tables.json": lambda: to_json(result.tables),
        "verdict.txt": lambda: result.verdict + "\n",
    }
    for name, write in writers.items():
        replace_file(out / name, write())
