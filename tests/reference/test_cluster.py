"""Rendering on `dask.distributed` workers: separate processes over TCP, one of them killed; Slurm by a stand-in."""

import dataclasses
import importlib.util
import json
import logging
import os
import shutil
import signal
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import unirender
import unirender_reference
from unirender.errors import UnirenderError
from unirender_reference import cluster, cluster_machine
from unirender_reference.backend import VARIANT_VARIABLE
from unirender_reference.cluster import ClusterExecutor, connect
from unirender_reference.cluster_machine import this_machine
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.workers import WorkerDied

PATIENCE = 120  # seconds for a worker to start on a busy machine; what is waited for takes a few

# What `sbatch` and `scancel` do, with processes of this machine for jobs. The script is gone when `sbatch` is back.
SBATCH = """#!/bin/sh
folder=$(dirname "$0")
cp "$1" "$folder/job.sh"
setsid bash "$folder/job.sh" > "$folder/job.log" 2>&1 &
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
kill -- "-$1" 2> /dev/null
"""


@pytest.fixture(scope="module", autouse=True)
def code(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Workers run a copy of the packages: those that start after somebody edited a file would rightly be refused."""
    folder = tmp_path_factory.mktemp("code")
    digest = cluster_machine._code_hash()
    for package in (unirender, unirender_reference):
        shutil.copytree(package.__path__[0], folder / package.__name__)
    this_machine.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster_machine, "_code_hash", lambda: digest)
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        yield
    this_machine.cache_clear()


@pytest.fixture(scope="module")
def scheduler(code: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A scheduler and two workers with nannies; a task may cost one worker its life, not two."""
    distributed = pytest.importorskip("distributed")
    from dask import config as dask_config

    with (
        dask_config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            protocol="tcp",
            dashboard_address=":0",
            local_directory=str(tmp_path_factory.mktemp("dask")),
            silence_logs=logging.CRITICAL,
        ) as local,
    ):
        yield local


@pytest.fixture
def executor(scheduler: Any) -> Iterator[ClusterExecutor]:
    with connect(scheduler.scheduler_address) as connected:
        yield connected


def process_ids(executor: ClusterExecutor) -> set[int]:
    return set(executor._client.run(os.getpid).values())


def test_a_function_runs_elsewhere_and_its_error_comes_back(executor: ClusterExecutor) -> None:
    assert executor.workers == 2
    assert executor.machines == (this_machine(),)
    assert executor.submit(os.getpid).result(20) in process_ids(executor) - {os.getpid()}
    with pytest.raises(ValueError, match="invalid literal"):
        executor.submit(int, "x").result(20)


@pytest.mark.long
def test_a_killed_worker_costs_nothing(scheduler: Any, tmp_path: Path) -> None:
    """SIGKILL in the middle: the data set is that of local processes, byte for byte, each group once."""
    config = DatasetConfig(objects=8, pairs=3, resolution=16, vary="basis", out=tmp_path / "cluster", spp=4)
    killed: list[int] = []
    with connect(scheduler.scheduler_address) as executor:

        def progress(done: int, total: int) -> None:
            if done == 2 and not killed:
                killed.append(min(process_ids(executor)))
                os.kill(killed[0], signal.SIGKILL)

        report = generate(config, progress, executor)
        executor._client.wait_for_workers(2, 20)
        assert killed
        assert killed[0] not in process_ids(executor)
    assert report.groups == 8
    local = dataclasses.replace(config, out=tmp_path / "local", workers=1)
    generate(local)
    names = sorted(path.name for path in local.out.iterdir())
    assert names == sorted(path.name for path in config.out.iterdir())
    for name in names:
        assert (config.out / name).read_bytes() == (local.out / name).read_bytes(), name
    keys: list[str] = []
    for path in config.out.glob("*.tar"):
        with tarfile.open(path) as tar:
            keys += [name.removesuffix(".json") for name in tar.getnames() if name.endswith(".json")]
    assert len(keys) == len(set(keys)) == 8
    assert json.loads((config.out / "manifest.json").read_text())["complete"] is True


@pytest.mark.slow
def test_a_task_that_kills_its_workers_is_given_up(executor: ClusterExecutor) -> None:
    with pytest.raises(WorkerDied, match="2 workers died over it"):
        executor.submit(os._exit, 1).result(60)
    assert executor.submit(int, "7").result(30) == 7


def test_a_cancelled_task_says_so(executor: ClusterExecutor) -> None:
    future = executor.submit(int, "7")
    future.cancel()
    with pytest.raises(UnirenderError, match="cancelled or the scheduler is gone"):
        future.result(20)


@pytest.fixture
def other_variant(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This process asks for another Mitsuba variant than the workers, which run already."""
    this_machine.cache_clear()
    monkeypatch.setenv(VARIANT_VARIABLE, "cuda_ad_rgb")
    yield
    this_machine.cache_clear()


def test_workers_unlike_the_caller_are_refused(scheduler: Any, other_variant: None) -> None:
    with (
        pytest.raises(UnirenderError, match=r"worker tcp://\S+ has variant llvm_ad_rgb \(expected cuda_ad_rgb\)"),
        connect(scheduler.scheduler_address),
    ):
        pass


@pytest.mark.parametrize("field", ["mitsuba", "code"])
def test_workers_that_join_later_are_checked_too(
    field: str, executor: ClusterExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executor, "_machine", dataclasses.replace(this_machine(), **{field: "3.0"}))
    with pytest.raises(UnirenderError, match=rf"has {field} \S+ \(expected 3.0\); install the same versions"):
        executor.submit(int, "7").result(20)


def test_different_cpus_are_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    mine = this_machine()
    other = dataclasses.replace(mine, cpu="x86_64 Abacus")
    assert cluster._survey(mine, {"a": mine, "b": mine}) == (mine,)
    assert not caplog.records
    assert cluster._survey(mine, {"a": mine, "b": other}) == (mine, other)
    assert "different CPUs" in caplog.text
    assert "Abacus" in caplog.text


@pytest.mark.parametrize(
    "address", ["", "nowhere", "tcp://host", "slurm:0", "slurm:many", "http://host:80", "host:1:2"]
)
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(UnirenderError, match="expected tcp://host:port of a dask scheduler, slurm or slurm:JOBS"):
        cluster.check_address(address)


@pytest.mark.parametrize(
    "address", ["tcp://10.0.0.1:8786", "tls://node-1.lan:1", "node:8786", "tcp://[::1]:9", "slurm:64"]
)
def test_addresses(address: str) -> None:
    cluster.check_address(address)


def test_nobody_answers() -> None:
    with (
        pytest.raises(UnirenderError, match=r"no dask scheduler answers at tcp://127.0.0.1:1 within 0.5 s"),
        connect("tcp://127.0.0.1:1", 0.5),
    ):
        pass


def test_a_scheduler_without_workers() -> None:
    distributed = pytest.importorskip("distributed")
    empty = distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=":0", silence_logs=50)
    with (
        empty as local,
        pytest.raises(UnirenderError, match=r"has no workers after 0\.5 s"),
        connect(local.scheduler_address, 0.5),
    ):
        pass


@pytest.mark.parametrize(("address", "missing"), [("tcp://127.0.0.1:1", "distributed"), ("slurm", "dask_jobqueue")])
def test_dask_is_an_extra(address: str, missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    genuine = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == missing else genuine(name))
    with (
        pytest.raises(UnirenderError, match=rf"{missing} is not installed; `pip install 'unirender\[cluster\]'`"),
        connect(address),
    ):
        pass


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path with `sbatch` and `scancel`, and a configuration for jobs of two cores."""
    pytest.importorskip("dask_jobqueue")
    from dask import config as dask_config

    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    options = {"cores": 2, "memory": "2GB", "local-directory": str(tmp_path), "walltime": "00:10:00"}
    scheduler = {"host": "127.0.0.1", "dashboard_address": ":0"}
    with dask_config.set(
        {"jobqueue.slurm": {**dask_config.get("jobqueue.slurm"), **options, "scheduler-options": scheduler}}
    ):
        yield tmp_path


@pytest.mark.long
def test_slurm_jobs_are_processes_with_one_thread_for_each_core(slurm: Path) -> None:
    with connect("slurm:1") as executor:
        assert executor.workers == 2
        executor._client.wait_for_workers(2, PATIENCE)
        assert set(executor._client.nthreads().values()) == {1}
        assert executor.submit(int, "7").result(PATIENCE) == 7


def test_slurm_says_why_a_job_was_refused(slurm: Path) -> None:
    (slurm / "sbatch").write_text("#!/bin/sh\necho 'invalid partition specified: nowhere' >&2\nexit 1\n")
    with pytest.raises(UnirenderError, match=r"`sbatch` refused the job: .*invalid partition"), connect("slurm"):
        pass


def test_slurm_needs_the_size_of_a_job(slurm: Path) -> None:
    from dask import config as dask_config

    with (
        dask_config.set({"jobqueue.slurm.cores": None}),
        pytest.raises(UnirenderError, match=r"cores and memory of a job are not set; write them to ~/.config/dask"),
        connect("slurm"),
    ):
        pass


def test_slurm_needs_sbatch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UnirenderError, match="no `sbatch` here"), connect("slurm"):
        pass
