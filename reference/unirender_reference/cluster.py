"""Rendering on many machines: `connect` hands out an executor over `dask.distributed` workers.

    tcp://host:port     a scheduler that runs already (`dask scheduler`, `dask worker --nthreads 1 tcp://host:port`)
    slurm, slurm:JOBS   JOBS jobs (1) of dask-jobqueue; cores, memory, queue and walltime stand in dask's own
                        configuration (`~/.config/dask/jobqueue.yaml`, section `jobqueue.slurm`)

What is promised: a task whose worker dies runs again elsewhere (tasks are pure functions), its result arrives once, and
only the calling process writes files. Results stay on the worker that made them until `result()` asks, and come from
there directly: the caller bounds how many tasks are under way, and nothing piles up in the scheduler.

Renders are bit-identical on one type of machine only (Mitsuba compiles for the CPU it finds): workers with other code
or another Mitsuba than the caller's are refused, different CPUs are logged as a warning.
"""

import contextlib
import functools
import importlib.util
import logging
import platform
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from unirender.errors import UnirenderError, UsageError
from unirender_reference import backend
from unirender_reference.cluster_machine import Machine, this_machine
from unirender_reference.workers import WorkerDied

SLURM = re.compile(r"slurm(?::([1-9]\d*))?")
SCHEDULER = re.compile(r"(?:(?:tcp|tls)://)?(?:[\w.-]+|\[[0-9a-fA-F:]+\]):\d{1,5}")
TIMEOUT = 30.0  # seconds for a scheduler to answer and for its first worker
_log = logging.getLogger("unirender.cluster")


class ClusterFuture:
    """A task's outcome, in the manner of `concurrent.futures.Future`; the result is fetched when asked for."""

    def __init__(self, future: Any) -> None:
        self._future = future

    def result(self, timeout: float | None = None) -> Any:
        """The task's result, or its exception.

        Raises:
            WorkerDied: several workers died over the task.
            UnirenderError: the scheduler is gone.
            TimeoutError: it takes longer than `timeout` seconds.
        """
        from distributed import KilledWorker

        try:
            return self._future.result(timeout)
        except KilledWorker as error:
            raise WorkerDied(f"{error.allowed_failures + 1} workers died over it (out of memory?)") from error
        except OSError as error:
            if isinstance(error, TimeoutError):
                raise
            raise UnirenderError(f"cluster: connection lost ({error}); run the same command again") from error
        except BaseException as error:
            if self._future.status not in ("cancelled", "lost") or isinstance(error, KeyboardInterrupt):
                raise
            raise UnirenderError(
                "cluster: the task was cancelled or the scheduler is gone; complete shards are kept, run the same "
                "command again"
            ) from error

    def cancel(self) -> None:
        """Forgets the task: it is not started any more; its result is dropped."""
        self._future.cancel()

    def done(self) -> bool:
        return bool(self._future.done())


class ClusterExecutor:
    """Runs functions on a cluster's workers; made by `connect`.

    Attributes:
        machines: the distinct machines found when the connection was made.
    """

    def __init__(self, client: Any, machine: Machine, machines: tuple[Machine, ...], planned: int = 0) -> None:
        self.machines = machines
        self._client = client
        self._machine = machine
        self._planned = planned

    @property
    def workers(self) -> int:
        """Tasks that run at a time: now, or as soon as every job of a batch system has started."""
        return max(self._planned, sum(self._client.nthreads().values()))

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> ClusterFuture:
        """Runs `fn(*args)` on some worker, on another one if that dies. `fn` is a pure function that pickles."""
        return ClusterFuture(self._client.submit(_run, self._machine, fn, args, pure=False))


def check_address(address: str) -> None:
    """Raises `UsageError` unless `connect` understands the address."""
    if not (SLURM if address.startswith("slurm") else SCHEDULER).fullmatch(address):
        raise UsageError(f"cluster: got {address!r}, expected tcp://host:port of a dask scheduler, slurm or slurm:JOBS")


def check_machine(address: str) -> None:
    """Raises `UnirenderError` where this machine lacks what `connect` needs, before anybody is asked for an answer."""
    _require("distributed")
    if not SLURM.fullmatch(address):
        return
    _require("dask_jobqueue")
    if shutil.which("sbatch") is None:
        raise UnirenderError("cluster slurm: no `sbatch` here; run the command on a login node of the Slurm cluster")
    options = _slurm_options()
    if not options["cores"] or not options["memory"]:
        raise UnirenderError(
            "cluster slurm: cores and memory of a job are not set; write them to ~/.config/dask/jobqueue.yaml: "
            "jobqueue: {slurm: {cores: 32, memory: 64GB, walltime: '04:00:00', queue: NAME}}"
        )


@contextlib.contextmanager
def connect(address: str, timeout: float = TIMEOUT, denoise: bool = False) -> Iterator[ClusterExecutor]:
    """An executor on the cluster at `address`; what is still under way when the context ends is cancelled.

    Args:
        address: see the module. Slurm jobs start and end with this context.
        timeout: seconds for the scheduler to answer and its first worker to be there (Slurm: the queue is waited for).
        denoise: workers have to have this process's denoiser, too.

    Raises:
        UnirenderError: dask is not installed, nobody answers, there are no workers, or they are not like this process.
    """
    check_address(address)
    check_machine(address)
    from distributed import Client

    with contextlib.ExitStack() as stack:
        planned, wait = 0, timeout
        if slurm := SLURM.fullmatch(address):
            cluster, planned = _start_slurm(int(slurm.group(1) or 1), stack)
            target, wait = cluster.scheduler_address, None
        else:
            target = address
        try:
            client: Any = stack.enter_context(
                Client(target, timeout=timeout, set_as_default=False, direct_to_workers=True, name="unirender")
            )
        except (OSError, ValueError) as error:
            raise UnirenderError(
                f"cluster: no dask scheduler answers at {address} within {timeout:g} s; start one with `dask scheduler`"
            ) from error
        try:
            client.wait_for_workers(1, wait)
        except TimeoutError as error:
            raise UnirenderError(
                f"cluster: the scheduler at {address} has no workers after {timeout:g} s; start some with "
                f"`dask worker --nthreads 1 {address}`"
            ) from error
        machine = this_machine() if denoise else replace(this_machine(), denoiser=None)
        machines = _survey(machine, client.run(this_machine))
        yield ClusterExecutor(client, machine, machines, planned)


def _start_slurm(jobs: int, stack: contextlib.ExitStack) -> tuple[Any, int]:
    """Submits jobs, a process with one thread for each core; one that ends (walltime) is submitted again.

    Returns:
        The cluster and how many processes it will have.
    """
    from dask_jobqueue.slurm import SLURMCluster

    options = _slurm_options()
    processes = options["processes"] or options["cores"]
    cluster: Any = stack.enter_context(SLURMCluster(processes=processes))
    for _ in range(jobs):
        cluster.worker_spec.update(cluster.new_worker_spec())
    try:
        cluster.sync(_submit, cluster)
    except RuntimeError as error:
        said = str(error).partition("stderr:")[2] or str(error)
        raise UnirenderError(
            f"cluster slurm: `sbatch` refused the job: {' '.join(said.split())}; "
            "change its queue, cores, memory or walltime in ~/.config/dask/jobqueue.yaml"
        ) from error
    cluster.adapt(minimum_jobs=jobs, maximum_jobs=jobs)
    _log.info("waiting for the first of %d Slurm jobs", jobs)
    return cluster, jobs * processes


def _slurm_options() -> dict[str, Any]:
    """A job's section of dask's own configuration, to which `dask_jobqueue` adds its defaults."""
    import dask_jobqueue  # noqa: F401 - it registers them
    from dask import config as dask_config

    return dask_config.get("jobqueue.slurm")


async def _submit(cluster: Any) -> None:
    """Submits the jobs of the cluster's specification; raises RuntimeError with what `sbatch` said."""
    from distributed import Status

    try:
        await cluster
    except RuntimeError:
        for job in cluster.workers.values():
            if job.job_id is None:
                job.status = Status.failed  # or closing the cluster waits for it
        raise


def _run(expected: Machine, fn: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """What a worker executes."""
    _prepare(expected)
    return fn(*args)


@functools.cache
def _prepare(expected: Machine) -> None:
    """Once in each worker process, also in those that join later: the same code as the caller's, one Dr.Jit thread."""
    _check_worker(expected, this_machine(), platform.node())
    backend.find_llvm()
    backend.set_threads(1)


def _survey(expected: Machine, found: Mapping[str, Machine]) -> tuple[Machine, ...]:
    """The distinct machines of the workers (by address), all of them fit to render."""
    for worker, machine in found.items():
        _check_worker(expected, machine, worker)
    machines = tuple(dict.fromkeys(found.values()))
    if len(machines) > 1:
        cpus = ", ".join(sorted(machine.cpu for machine in machines))
        _log.warning("workers have different CPUs (%s): renders differ in their last bits between them", cpus)
    return machines


def _check_worker(expected: Machine, found: Machine, worker: str) -> None:
    if names := expected.differences(found):
        said = ", ".join(f"{name} {getattr(found, name)} (expected {getattr(expected, name)})" for name in names)
        raise UnirenderError(f"cluster: worker {worker} has {said}; install the same versions on all machines")


def _require(module: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise UnirenderError(f"cluster: {module} is not installed; `pip install 'unirender[cluster]'`")
