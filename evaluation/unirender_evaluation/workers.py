"""Runs a suite's scenes one by one, here or in worker processes that each build the rows for themselves."""

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from unirender_evaluation.bounds import KeyOf, ceiling_jobs
from unirender_evaluation.engine import Job, content_key, method_jobs
from unirender_evaluation.mitsuba_method import mitsuba_jobs
from unirender_evaluation.physics_rows import physics_jobs, physics_scenes
from unirender_evaluation.pictures import Pictures
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row, evenly
from unirender_evaluation.subsets import STANDARD, Subsets
from unirender_evaluation.suites import Scene, Suite, load_suite
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


_here: tuple[Run, frozenset[str]] | None = None


def _start(
    build: Callable[[], Sequence[Row]],
    suite: Path,
    scenes: list[str],
    versions: Versions,
    backbones: tuple[str, ...],
    pictures: Path,
    subsets: Subsets,
    known: frozenset[str],
) -> None:
    from unirender_reference.backend import set_threads
    from unirender_reference.processes import exit_with_parent

    exit_with_parent()
    import torch

    global _here
    torch.set_num_threads(1)  # a 64 px network gains nothing from a second thread, a second process does
    set_threads(1)  # nor do renders of 64 px
    loaded = load_suite(suite)
    run = Run(loaded, build(), [loaded.scene(key) for key in scenes], versions, backbones, pictures, subsets)
    _here = run, known


def _scene(key: str) -> list[Record]:
    assert _here is not None, "the pool's initializer sets it"
    run, known = _here
    return [job.make() for job in run.jobs(run.suite.scene(key)) if not job.is_done(known.__contains__)]


def run_in_workers(
    run: Run, build: Callable[[], Sequence[Row]], scenes: list[Scene], known: frozenset[str], jobs: int
) -> Iterator[list[Record]]:
    """Records of `scenes`, a scene at a time as they come, from `jobs` processes; `build` makes the rows in each."""
    arguments = (
        build,
        run.suite.spec.path,
        [scene.key for scene in run.scenes],
        run.versions,
        run.backbones,
        run.pictures,
        run.subsets,
        known,
    )
    with ProcessPoolExecutor(jobs, get_context("spawn"), _start, arguments) as pool:
        futures = [pool.submit(_scene, scene.key) for scene in scenes]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
