"""`bench run`: a suite x rows -> per-sample records, tables, verdict and report in one folder.

    records.jsonl run.json        every value with its content key; the rows and the protocol (see `records`)
    truth_check.json              what was rendered again on the spot, and how it compares
    tables.md tables.tex tables.json
    verdict.txt                   who beats whom
    report.html                   one self-contained page

Running the same command again reuses what is done.
"""

import hashlib
import importlib.metadata
import json
import os
import platform
import secrets
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from unirender.errors import UnirenderError
from unirender_evaluation import bounds, physics_rows
from unirender_evaluation.engine import (
    Prediction,
    Store,
    code_version,
    content_key,
    record_of,
    score,
)
from unirender_evaluation.physics import PHYSICS_TABLE
from unirender_evaluation.pictures import Pictures
from unirender_evaluation.records import Record, RunInfo, write_run
from unirender_evaluation.report import write_report
from unirender_evaluation.rows import (
    LazyPipeline,
    Row,
    check_rows,
    our_rows,
    plugin_rows,
    prediction_rows,
    trivial_rows,
    weights_hash,
)
from unirender_evaluation.specs import TABLES
from unirender_evaluation.suites import Scene, Suite, load_suite
from unirender_evaluation.tables import Table, build_tables
from unirender_evaluation.tasks import PROTOCOLS, scene_ids, tasks
from unirender_evaluation.truth import quality_summary
from unirender_evaluation.truth_check import TruthCheck, check_truth
from unirender_evaluation.verdict import verdict_text
from unirender_evaluation.workers import Run, run_in_workers

GROUPS = ("ours", "trivial", "plugins")
FEW = 100  # records: fewer are not worth starting processes


@dataclass(frozen=True)
class BenchConfig:
    """A benchmark run.

    Attributes:
        suite: name of a bundled suite, or path of a TOML file.
        out: folder of the run; an earlier run in it is continued.
        checkpoint: folder of our model; None = the shipped one.
        methods: groups of rows: ours, trivial, plugins.
        predictions: name -> folder of somebody's predictions.
        limit: scenes (evenly spaced); the tables are then watermarked.
        seed: of sampling methods.
        check_scenes: scenes that Mitsuba renders again on the spot.
        check_seed: chooses them; None = drawn anew in a new folder, kept in a folder that is continued.
        jobs: worker processes, each with one thread; 0 = all in this one.
        device: of our model.
        sample_scenes: scenes of the sampling rows; 0 = leave them out.
    """

    suite: str = "tiny"
    out: Path = Path("results")
    checkpoint: Path | None = None
    methods: tuple[str, ...] = GROUPS
    predictions: dict[str, Path] = field(default_factory=dict)
    limit: int | None = None
    seed: int = 0
    check_scenes: int = 4
    check_seed: int | None = None
    jobs: int = 2
    device: str = "cpu"
    sample_scenes: int = 4


@dataclass(frozen=True)
class BenchResult:
    """What a run has found; `computed` counts the records that were not there before."""

    records: tuple[Record, ...]
    run: RunInfo
    tables: tuple[Table, ...]
    verdict: str
    truth_check: dict[str, Any]
    computed: int


def shipped_checkpoint() -> Path:
    """Folder of the checkpoint in the package."""
    return Path(str(resources.files("unirender"))) / "checkpoints" / "tiny"


def build_rows(config: BenchConfig) -> list[Row]:
    """The rows that a configuration asks for.

    Raises:
        UnirenderError: unknown group, no checkpoint, broken predictions, or two rows of one name.
    """
    unknown = sorted(set(config.methods) - set(GROUPS))
    if unknown:
        raise UnirenderError(f"methods: got {', '.join(unknown)}, expected some of {', '.join(GROUPS)}")
    rows: list[Row] = []
    if "ours" in config.methods:
        folder = config.checkpoint or shipped_checkpoint()
        rows += our_rows(
            LazyPipeline(lambda: _load_pipeline(folder, config.device)),
            weights_hash(folder),
            config.seed,
            config.sample_scenes,
        )
    if "trivial" in config.methods:
        rows += [*trivial_rows(), bounds.shade_row()]
    if "plugins" in config.methods:
        rows += plugin_rows()
    return check_rows(rows + prediction_rows(config.predictions))


def _load_pipeline(folder: Path, device: str) -> Any:
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

    pipeline = UniRenderPipeline.from_pretrained(folder).to(device)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def run(config: BenchConfig, console: Console | None = None) -> BenchResult:
    """Runs or continues a benchmark and writes its folder (see the module).

    Raises:
        UnirenderError: unusable suite, checkpoint or predictions. A failed truth check or claim is no error: the
            verdict says so.
    """
    console = console or Console()
    suite, rows = load_suite(config.suite), build_rows(config)
    scenes = scene_ids(suite, config.limit)
    config.out.mkdir(parents=True, exist_ok=True)
    code, backbones = code_version(), _backbones()
    version = f"{code}/{'+'.join(backbones)}"
    store = Store.open(config.out / "records.jsonl")
    before = set(store.known)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=not console.is_terminal) as progress:
        check = _truth_check(config, suite, store, version, backbones, progress)
        here = Run(suite, rows, scenes, version, backbones, config.out / "pictures")
        _work(here, config, store, progress)
    records = [record for record in store.close() if record.values]
    info = _run_info(config, suite, scenes, rows, check, records, code, backbones)
    write_run(config.out / "run.json", info)
    specs = {**TABLES, "physics": PHYSICS_TABLE}
    tables = build_tables(records, info, specs)
    verdict = verdict_text(records, info, check)
    result = BenchResult(tuple(records), info, tuple(tables), verdict, check, len({r.key for r in records} - before))
    write_outputs(config.out, result)
    pictures = Pictures(config.out / "pictures", suite, scenes)
    main = next((row.info.key for row in rows if row.info.kind == "ours"), rows[0].info.key if rows else "")
    write_report(config.out / "report.html", tables, pictures.items(records, main), info, records, specs=specs)
    return result


def _work(here: Run, config: BenchConfig, store: Store, progress: Progress) -> None:
    """Computes the records that are missing, few of them here, many in worker processes."""
    missing = {scene.key: [job for job in here.jobs(scene) if not job.is_done(store.has)] for scene in here.scenes}
    scenes = [scene for scene in here.scenes if missing[scene.key]]
    total = sum(map(len, missing.values()))
    bar = progress.add_task("methods", total=total, visible=total > 0)
    if config.jobs == 0 or total <= FEW:
        for job in (job for scene in scenes for job in missing[scene.key]):
            store.add(job.make())
            progress.update(bar, advance=1, description=job.label)
        return
    missing.clear()  # they hold the pictures of all scenes
    done = frozenset(store.used)
    for records in run_in_workers(here, partial(build_rows, config), scenes, done, min(config.jobs, len(scenes))):
        for record in records:
            store.add(record)
        progress.advance(bar, len(records))


def _backbones() -> tuple[str, ...]:
    from unirender_evaluation.lpips import available

    return tuple(available())


def _truth_check(
    config: BenchConfig, suite: Suite, store: Store, version: str, backbones: tuple[str, ...], progress: Progress
) -> dict[str, Any]:
    """Renders a random part of the truth again unless this was done before; scores the renders as a row."""
    path = config.out / "truth_check.json"
    identity = hashlib.sha256(
        json.dumps([suite.sha256, config.check_seed, config.check_scenes, version]).encode()
    ).hexdigest()
    check: dict[str, Any] = {}
    if path.exists():
        with suppress(json.JSONDecodeError):
            check = json.loads(path.read_text(encoding="utf-8"))
    keys = check.get("record_keys", [])
    if check.get("identity") == identity and all([store.has(key) for key in keys]):
        return check
    bar = progress.add_task("Mitsuba: truth check", total=None)
    outcome: TruthCheck | None = None
    seed = secrets.randbits(31) if config.check_seed is None else config.check_seed
    for step in check_truth(suite, config.check_scenes, seed):
        progress.advance(bar)
        if isinstance(step, TruthCheck):
            outcome = step
    assert outcome is not None
    check = outcome.summary() | {"identity": identity, "checked_scenes": outcome.summary()["scenes"]}
    images, info = bounds.reference_images(outcome), bounds.reference_info(check)
    keys = []
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, list(suite.scenes)):
            image, maps = bounds.reference_prediction(task, images, suite)
            if image is None and maps is None:
                continue
            key = content_key(suite, task.scene, task.identity, info.config, version)
            if not store.has(key):
                store.add(record_of(task, info, score(task, Prediction(image, maps), backbones), key))
            keys.append(key)
    progress.remove_task(bar)
    check["record_keys"] = keys
    _write_text(path, json.dumps(check, indent=1) + "\n")
    return check


def _run_info(
    config: BenchConfig,
    suite: Suite,
    scenes: list[Scene],
    rows: list[Row],
    check: dict[str, Any],
    records: list[Record],
    code: str,
    backbones: tuple[str, ...],
) -> RunInfo:
    used = {record.method for record in records}
    infos = [row.info for row in rows] + [bounds.CEILING, bounds.reference_info(check), *physics_rows.INFOS]
    quality = quality_summary(suite)
    versions = {name: _version(name) for name in ("unirender", "torch", "mitsuba", "numpy")}
    ceiling = quality["image"]
    versions |= {
        "cpu": platform.machine(),
        "python": platform.python_version(),
        "noise ceiling": f"mean {ceiling['mean_db']:.1f} dB, min {ceiling['min_db']:.1f} dB over {ceiling['n']} images",
    }
    return RunInfo(
        suite=suite.spec.name,
        suite_hash=suite.sha256,
        resolution=suite.spec.resolution,
        methods=tuple(info for info in infos if info.key in used),
        coverage=float(np.mean([suite.mask(scene).mean() for scene in scenes])),
        lpips=backbones,
        mitsuba=str(suite.provenance["mitsuba"]),
        truth_spp=round(ceiling["mean_spp"]),
        code=code[:12],
        date=datetime.now(UTC).date().isoformat(),
        limit=config.limit,
        seeds=(config.seed,),
        environment=versions,
    )


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def write_outputs(out: Path, result: BenchResult) -> None:
    """Writes tables and verdict, each moved into place when complete."""
    from unirender_evaluation.table_formats import to_json, to_latex, to_markdown

    writers: dict[str, Callable[[], str]] = {
        "tables.md": lambda: "\n\n".join(to_markdown(table) for table in result.tables) + "\n",
        "tables.tex": lambda: "\n\n".join(to_latex(table) for table in result.tables) + "\n",
        "tables.json": lambda: to_json(result.tables),
        "verdict.txt": lambda: result.verdict + "\n",
    }
    for name, write in writers.items():
        _write_text(out / name, write())


def _write_text(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
