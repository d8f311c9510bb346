"""Runs a suite's scenes one by one, here or in worker processes of this machine, which build the rows for themselves.

Those of a cluster: `runs.cluster`.
"""

import os
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError
from unirender.system.worker_pool import WorkerPool
from unirender_evaluation.bounds import KeyOf, ceiling_jobs
from unirender_evaluation.engine import method_jobs
from unirender_evaluation.methods.mitsuba import mitsuba_jobs
from unirender_evaluation.physics.rows import physics_jobs, physics_scenes
from unirender_evaluation.records import MethodInfo, Record, append_record
from unirender_evaluation.report.pictures import Pictures
from unirender_evaluation.rows import Row, evenly
from unirender_evaluation.store import Job, content_key
from unirender_evaluation.subsets import STANDARD, Subsets
from unirender_evaluation.suites.suite import Scene, Suite, load_suite
from unirender_evaluation.versions import Versions


@dataclass
class Run:
    """What one process needs to work on scenes: `rows` may load models, each process its own."""

    suite: Suite
    rows: Sequence[Row]
    scenes: list[Scene]  # of the whole run
    versions: Versions  # of the code and of what it depends on; part of every content key
    backbones: tuple[str, ...]  # LPIPS backbones
    pictures: Path  # folder of the gallery's predictions
    subsets: Subsets = STANDARD  # scenes of the slow parts

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
    """What a process of this machine needs to make a `Run` like the caller's; it pickles."""

    build: Callable[[], Sequence[Row]]  # makes the rows
    configs: Mapping[str, Any]  # that these rows have to have, by their keys
    suite: Path  # path of its TOML file
    scenes: tuple[str, ...]  # their keys
    versions: Versions
    backbones: tuple[str, ...]
    pictures: Path
    subsets: Subsets
    known: frozenset[str]  # content keys of records that are there
    notes: Path  # folder in which each process says what it has under way, and hands over its records (`Journals`)

    def run(self) -> Run:
        suite, rows = load_suite(self.suite), same_rows(self.build(), self.configs)
        scenes = [suite.scene(key) for key in self.scenes]
        return Run(suite, rows, scenes, self.versions, self.backbones, self.pictures, self.subsets)


_here: tuple[Run, frozenset[str], Path] | UnirenderError | None = None  # with the file that says what is under way
JOURNAL = ".jsonl"  # ends the name of a process's file of records
PAUSE = 0.2  # seconds between two looks at these files


def _start(setup: _Setup) -> None:
    """Prepares a worker: one thread, and the run of `setup`; an error waits for the first task."""
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
    """The rows as they are, if they are those of the process that asks."""
    for row in rows:
        if row.config != configs.get(row.info.key):
            raise UnirenderError(
                f"method {row.info.label!r}: its config is {row.config} in a worker process, and "
                f"{configs.get(row.info.key)} in the one that started it; expected the same whenever the method is "
                "made: no time, process or random name in it"
            )
    return rows


def _scene(key: str) -> UnirenderError | None:
    """Makes the records of a scene, each handed over at once; where a row fails, how it does."""
    assert _here is not None, "the pool's initializer sets it"
    if isinstance(_here, UnirenderError):
        return _here
    run, known, note = _here
    for job in run.jobs(run.suite.scene(key)):
        if not job.is_done(known.__contains__):
            with suppress(OSError):  # it is a help, and no more
                note.write_text(f"{job.label} on {key}", encoding="utf-8")
            try:
                append_record(note.with_suffix(JOURNAL), job.make())
            except UnirenderError as error:
                return error
    note.unlink(missing_ok=True)
    return None


class Journals:
    """The records that worker processes have made, each in a file of its own: a queue is left locked, or with half a
    record, by a process that is killed while it writes.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: Counter[Path] = Counter()  # bytes

    def new(self) -> list[Record]:
        """Those that were not there before."""
        records = []
        for path in sorted(self._folder.glob(f"*{JOURNAL}")):
            with path.open("rb") as file:
                file.seek(self._read[path])
                lines = file.read()
            whole = lines[: lines.rfind(b"\n") + 1]
            self._read[path] += len(whole)
            records += [Record.from_json(line.decode()) for line in whole.splitlines()]
        return records


def run_in_workers(
    run: Run, build: Callable[[], Sequence[Row]], scenes: list[Scene], known: frozenset[str], jobs: int
) -> Generator[list[Record], None, None]:
    """Records of `scenes`, some at a time as they come, from `jobs` processes; `build` makes the rows in each.

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
        journals = Journals(setup.notes)
        with WorkerPool(jobs, _start, setup) as pool:
            waiting = {pool.submit(_scene, scene.key) for scene in scenes}
            while waiting:
                done, waiting = wait(waiting, timeout=PAUSE, return_when=FIRST_COMPLETED)
                if records := journals.new():
                    yield records
                try:
                    errors = [future.result() for future in done]
                except BrokenProcessPool as error:
                    raise _died(setup.notes) from error
                for error in filter(None, errors):
                    raise error


def _died(notes: Path) -> UnirenderError:
    """What is said of a process that died, with what each had under way."""
    said = ", ".join(sorted(note.read_text(encoding="utf-8") for note in notes.iterdir() if note.suffix != JOURNAL))
    return UnirenderError(
        "a worker process died: above is why, if it could not start; else perhaps for want of memory"
        f"{f', or by what it computed (under way: {said})' if said else ''}. Run the same command again, with fewer "
        "--jobs"
    )
