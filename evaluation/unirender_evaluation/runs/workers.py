"""Runs a suite's scenes one by one, here or in worker processes of this machine, which build the rows for themselves.

Those of a cluster: `runs.cluster`.
"""

import os
import tempfile
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError
from unirender.worker_pool import WorkerPool
from unirender_evaluation.bounds import KeyOf, ceiling_jobs
from unirender_evaluation.engine import method_jobs
from unirender_evaluation.methods.mitsuba import mitsuba_jobs
from unirender_evaluation.physics.rows import physics_jobs, physics_scenes
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.report.pictures import Pictures
from unirender_evaluation.rows import Row, evenly
from unirender_evaluation.store import Job, content_key
from unirender_evaluation.subsets import STANDARD, Subsets
from unirender_evaluation.suites.suite import Scene, Suite, load_suite
from unirender_evaluation.versions import Versions


@dataclass
class Run:
    """What one process needs to work on scenes: `rows` may load models, each process its own.

    Attributes:
        suite: the suite.
        rows: the rows.
        scenes: of the whole run.
        versions: of the code and of what it depends on; part of every content key.
        backbones: LPIPS backbones.
        pictures: folder of the gallery's predictions.
        subsets: scenes of the slow parts.
    """

    suite: Suite
    rows: Sequence[Row]
    scenes: list[Scene]
    versions: Versions
    backbones: tuple[str, ...]
    pictures: Path
    subsets: Subsets = STANDARD

    def jobs(self, scene: Scene) -> Iterator[Job]:
        """Every record that the run wants of one scene, the multi-view table's aside."""
        key_of = self.key_of(scene)
        keeper = Pictures(self.pictures, self.suite, self.scenes)
        yield from method_jobs(self.suite, self.rows, self.scenes, scene, self.versions, self.backbones, keeper)
        yield from ceiling_jobs(self.suite, scene, key_of, self.backbones)
        yield from mitsuba_jobs(self.suite, self.scenes, scene, key_of, self.backbones, self.subsets.mitsuba)
        chosen = physics_scenes(self.suite, self.scenes, self.subsets.physics)
        if scene in chosen:
            with_mitsuba = scene in evenly(chosen, self.subsets.mitsuba)
            yield from physics_jobs(self.suite, scene, self.rows, key_of, with_mitsuba)

    def key_of(self, scene: Scene) -> KeyOf:
        """Makes the content keys of records of a scene."""

        def key_of(what: str, info: MethodInfo, uses: Collection[str]) -> str:
            return content_key(self.suite, scene, what, info.config, self.versions.of(uses))

        return key_of


@dataclass(frozen=True)
class _Setup:
    """What a process of this machine needs to make a `Run` like the caller's; it pickles.

    Attributes:
        build: makes the rows, which have to have these `configs`, by their keys.
        suite: path of its TOML file.
        scenes: their keys.
        versions, backbones, pictures, subsets: as in `Run`.
        known: content keys of records that are there.
        notes: folder in which each process says what it has under way.
    """

    build: Callable[[], Sequence[Row]]
    configs: Mapping[str, Any]
    suite: Path
    scenes: tuple[str, ...]
    versions: Versions
    backbones: tuple[str, ...]
    pictures: Path
    subsets: Subsets
    known: frozenset[str]
    notes: Path

    def run(self) -> Run:
        suite, rows = load_suite(self.suite), same_rows(self.build(), self.configs)
        scenes = [suite.scene(key) for key in self.scenes]
        return Run(suite, rows, scenes, self.versions, self.backbones, self.pictures, self.subsets)


_here: tuple[Run, frozenset[str], Path] | UnirenderError | None = None  # with the file that says what is under way


def _start(setup: _Setup) -> None:
    import threadpoolctl
    import torch

    from unirender_reference.backend import set_threads

    global _here
    torch.set_num_threads(1)  # a 64 px network gains nothing from a second thread, a second process does
    set_threads(1)  # nor do renders of 64 px
    try:
        run = setup.run()
    except UnirenderError as error:  # is raised by the first task: a pool says nothing of what its beginning raises
        _here = error
        return
    threadpoolctl.threadpool_limits(1)  # nor do numpy's products, and those of what a row has imported
    _here = run, setup.known, setup.notes / str(os.getpid())


def same_rows(rows: Sequence[Row], configs: Mapping[str, Any]) -> Sequence[Row]:
    """The rows as they are, if they are those of the process that asks.

    Args:
        rows: made here.
        configs: made there, by the rows' keys.

    Raises:
        UnirenderError: a row has another configuration here, so that its records would have other keys.
    """
    for row in rows:
        if row.config != configs.get(row.info.key):
            raise UnirenderError(
                f"method {row.info.label!r}: its config is {row.config} in a worker process, and "
                f"{configs.get(row.info.key)} in the one that started it; expected the same whenever the method is "
                "made: no time, process or random name in it"
            )
    return rows


def _scene(key: str) -> tuple[list[Record], UnirenderError | None]:
    """The records of a scene; where a row fails those that were made before, and how it fails."""
    assert _here is not None, "the pool's initializer sets it"
    if isinstance(_here, UnirenderError):
        return [], _here
    run, known, note = _here
    records = []
    for job in run.jobs(run.suite.scene(key)):
        if not job.is_done(known.__contains__):
            with suppress(OSError):  # it is a help, and no more
                note.write_text(f"{job.label} on {key}", encoding="utf-8")
            try:
                records.append(job.make())
            except UnirenderError as error:
                return records, error
    note.unlink(missing_ok=True)
    return records, None


def run_in_workers(
    run: Run, build: Callable[[], Sequence[Row]], scenes: list[Scene], known: frozenset[str], jobs: int
) -> Generator[list[Record], None, None]:
    """Records of `scenes`, a scene at a time as they come, from `jobs` processes; `build` makes the rows in each.

    Raises:
        UnirenderError: a worker process died, or could not make the rows; what a row raises comes as it is.
    """
    with tempfile.TemporaryDirectory() as folder:
        setup = _Setup(
            build=build,
            configs={row.info.key: row.config for row in run.rows},
            suite=run.suite.spec.path,
            scenes=tuple(scene.key for scene in run.scenes),
            versions=run.versions,
            backbones=run.backbones,
            pictures=run.pictures,
            subsets=run.subsets,
            known=known,
            notes=Path(folder),
        )
        with WorkerPool(jobs, _start, setup) as pool:
            futures = [pool.submit(_scene, scene.key) for scene in scenes]
            try:
                for future in as_completed(futures):
                    records, error = future.result()
                    yield records
                    if error is not None:
                        raise error
            except BrokenProcessPool as error:
                raise _died(setup.notes) from error


def _died(notes: Path) -> UnirenderError:
    """What is said of a process that died, with what each had under way."""
    said = ", ".join(sorted(note.read_text(encoding="utf-8") for note in notes.iterdir()))
    return UnirenderError(
        "a worker process died: above is why, if it could not start; else perhaps for want of memory"
        f"{f', or by what it computed (under way: {said})' if said else ''}. Run the same command again, with fewer "
        "--jobs"
    )
