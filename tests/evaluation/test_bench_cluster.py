"""`bench run --cluster` on `dask.distributed` workers, separate processes over TCP: the run of this machine alone."""

import contextlib
import importlib.util
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress
from tiny_suites import make_suite, write_suite

from unirender.errors import UnirenderError, UsageError
from unirender_evaluation.bounds import CEILING_KEY
from unirender_evaluation.records import Record
from unirender_evaluation.runs import benchmark
from unirender_evaluation.runs.benchmark import _work, prepare
from unirender_evaluation.runs.cluster import AHEAD, Order, cluster_scene, run_on_cluster
from unirender_evaluation.runs.command import BenchRun
from unirender_evaluation.runs.config import BenchConfig, anywhere, build_rows
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.store import Job, Store
from unirender_evaluation.subsets import Subsets
from unirender_evaluation.suites.suite import Scene
from unirender_evaluation.versions import Versions
from unirender_reference import cluster

SMALL = Subsets(sample=0, optimise=0, views=0, shade=1, physics=1, mitsuba=0)
RENDERED = ("physics", "shade")  # labels of records that Mitsuba makes


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """The address of a scheduler with two workers, which run in another folder than this process."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        protocol="tcp",
        dashboard_address=":0",
        local_directory=str(tmp_path / "dask"),
        silence_logs=logging.CRITICAL,
    ) as local:
        yield local.scheduler_address


def trivial(folder: Path) -> tuple[BenchConfig, Run]:
    """A run of the trivial rows on two closed-form objects."""
    suite = folder / "suite" / "ball.toml"
    if not suite.is_file():
        write_suite(suite.parent)
    config = BenchConfig(suite=str(suite), out=folder / "out", methods=("trivial",), subsets=SMALL)
    return config, prepare(config)


def quick(run: Run, scene: Scene) -> list[Job]:
    return [job for job in run.jobs(scene) if not job.label.startswith(RENDERED)]


def wanted_of(run: Run) -> dict[str, frozenset[str]]:
    return {scene.key: frozenset(job.key for job in quick(run, scene)) for scene in run.scenes}


@pytest.mark.long
def test_records_and_pictures_are_those_of_one_machine(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the suite was named by a relative path. What is stored is not computed again."""
    config, run = trivial(tmp_path)
    here = [job.make() for scene in run.scenes for job in quick(run, scene)]
    pictures = {path.name: path.read_bytes() for path in run.pictures.iterdir()}
    assert len(here) > 50
    assert len(pictures) > 20
    elsewhere, store = replace(run, pictures=tmp_path / "elsewhere"), Store.open(tmp_path / "records.jsonl")
    stored = next(record for record in here if record.method == CEILING_KEY)
    store.lay_by(stored)
    monkeypatch.chdir(tmp_path)
    _work(
        elsewhere, anywhere(replace(config, suite="suite/ball.toml", cluster=scheduler)), store, Progress(disable=True)
    )
    found = store.used
    assert all(found[r.key] == replace(r, seconds=found[r.key].seconds) for r in here)
    assert any(record.table == "physics" and record.values for record in found.values()), "Mitsuba's, too"
    assert stored.key not in store.path.read_text()
    made = {path.name: path.read_bytes() for path in elsewhere.pictures.iterdir()}
    assert made.items() >= pictures.items()
    assert not [name for name in made if not name.endswith(".png")]


class SlowFirst:
    """An executor of two workers: of twelve scenes the first is done when all others have been taken."""

    workers, scenes = 2, 12

    def __init__(self) -> None:
        self.open: list[str] = []
        self.taken: list[str] = []
        self.most = 0

    def submit(self, _: Callable[..., Any], order: Order, scene: str, wanted: frozenset[str]) -> "Answer":
        self.open.append(scene)
        self.most = max(self.most, len(self.open))
        return Answer(self, scene, next(iter(wanted)))


class Answer(cluster.ClusterFuture):
    """What it promises of one scene: one record, one picture."""

    def __init__(self, executor: SlowFirst, scene: str, key: str) -> None:
        super().__init__(None)
        self.executor, self.scene, self.key = executor, scene, key

    def done(self) -> bool:
        return self.scene != "s0" or len(self.executor.taken) == self.executor.scenes - 1

    def result(self, timeout: float | None = None) -> tuple[list[Record], dict[str, bytes]]:
        assert self.done(), "waits for one scene while others are done"
        self.executor.open.remove(self.scene)
        self.executor.taken.append(self.scene)
        record = Record("physics", "given", "method", self.scene, "ball", {}, self.key)
        return [record], {f"{self.scene}.png": self.scene.encode()}


def test_a_slow_scene_holds_up_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is taken when it is done, so that a killed run has it; the next one then takes its place."""
    executor = SlowFirst()
    monkeypatch.setattr(cluster, "connect", lambda _: contextlib.nullcontext(executor))
    suite = make_suite(tmp_path / "suite")
    run = Run(suite, (), list(suite.scenes), Versions("test"), (), tmp_path / "pictures")
    wanted = {f"s{i}": frozenset({f"key{i}"}) for i in range(executor.scenes)}
    found = [record for records in run_on_cluster(run, tuple, "ball", wanted, "somewhere") for record in records]
    assert {record.sample: frozenset({record.key}) for record in found} == wanted
    assert found[-1].sample == "s0"
    assert executor.most == AHEAD * executor.workers
    assert {path.name: path.read_bytes().decode() for path in run.pictures.iterdir()} == {f"{k}.png": k for k in wanted}


def test_a_finished_run_asks_for_no_cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its tables can be written again where there is none; with one record less it does ask."""
    config, run = trivial(tmp_path)
    jobs = [replace(job, kept=True) for scene in run.scenes for job in run.jobs(scene)]
    monkeypatch.setattr(run, "jobs", lambda scene: [job for job in jobs if scene == run.scenes[0]])
    asked: list[str] = []

    def connect(address: str) -> Any:
        asked.append(address)
        raise UnirenderError("no scheduler")

    monkeypatch.setattr(cluster, "connect", connect)
    config, store = replace(config, cluster="tcp://127.0.0.1:1"), Store(tmp_path / "records.jsonl")
    for job in jobs[1:]:
        store.lay_by(Record("physics", "given", "method", job.key, "ball", {}, job.key))
    with pytest.raises(UnirenderError, match="no scheduler"):
        _work(run, config, store, Progress(disable=True))
    assert asked == [config.cluster]
    store.lay_by(Record("physics", "given", "method", jobs[0].key, "ball", {}, jobs[0].key))
    _work(run, config, store, Progress(disable=True))
    assert asked == [config.cluster]
    assert store.used.keys() == {job.key for job in jobs}


@pytest.mark.long
def test_a_worker_that_is_not_like_this_machine_is_refused(tmp_path: Path) -> None:
    """Other code, another truth, other rows: what a worker would say, said here."""
    config, run = trivial(tmp_path)
    order = Order.of(run, partial(build_rows, config), config.suite)
    scene, wanted = next(iter(wanted_of(run).items()))
    for wrong, message in (
        (replace(order, versions=Versions("other")), "a worker has other code"),
        (replace(order, suite_sha256="other"), "a worker has another truth"),
    ):
        with pytest.raises(UnirenderError, match=message):
            cluster_scene(replace(wrong, name=message), scene, wanted)
    poor = replace(order, name="poor", build=partial(build_rows, replace(config, methods=())))
    with pytest.raises(UnirenderError, match=f"does not know .* of the records of {scene}"):
        cluster_scene(poor, scene, wanted)
    records, _ = cluster_scene(replace(order, name="good"), scene, wanted)
    assert {record.key for record in records} == wanted


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"cluster": "tcp://here:8786", "jobs": 2}, UsageError, "--jobs 2: expected none with --cluster"),
        ({"cluster": "somewhere"}, UsageError, "cluster: got 'somewhere', expected tcp://host:port"),
    ],
)
def test_options(options: dict[str, Any], error: type[UnirenderError], message: str) -> None:
    with pytest.raises(error, match=message):
        BenchRun(**options).run()


def test_without_dask_nothing_has_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The truth check, minutes of a suite, comes before any worker is asked for."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    config, _ = trivial(tmp_path)
    with pytest.raises(UnirenderError, match=r"distributed is not installed; `pip install 'unirender\[cluster\]'`"):
        benchmark.run(replace(config, cluster="tcp://127.0.0.1:1"))
    assert not config.out.exists()
