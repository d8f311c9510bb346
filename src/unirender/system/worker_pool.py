"""A pool of worker processes that end with their parent, and at once where it is interrupted.

A pool's workers outlive a parent that is killed (`kill -9`): nobody is left to tell them, and each holds Mitsuba, torch
and the memory of its last task. So each waits for its parent, too (`exit_with_parent`).

A terminal interrupts the parent and its workers alike. A worker must not notice: Mitsuba takes the signal for itself
while it renders, gives the picture up, and the pool waits for a worker that waits for work. The parent alone is
interrupted, and ends its workers, in the middle of whatever they do. It must notice at once, even if Mitsuba has
rendered in it, which leaves a handler that does not end a wait.
"""

import contextlib
import multiprocessing.connection
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import parent_process, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from types import TracebackType
from typing import Any

GRACE_SECONDS = 2  # for a worker to end by itself once it is told to


class _Starting(SpawnContext):
    """The spawn context, which knows the processes that it made."""

    def __init__(self) -> None:
        super().__init__()
        self.made: list[SpawnProcess] = []

    def Process(  # pyright: ignore[reportIncompatibleVariableOverride] - it is called as the class would be
        self, *args: Any, **kwargs: Any
    ) -> SpawnProcess:
        self.made.append(SpawnProcess(*args, **kwargs))
        return self.made[-1]


class WorkerPool(ProcessPoolExecutor):
    """`ProcessPoolExecutor` whose workers end with their parent, and where its `with` block is left by an exception.

    Args:
        workers: processes.
        start: called once in each, before its first task.
        arguments: of `start`.
    """

    def __init__(self, workers: int, start: Callable[..., None] | None = None, *arguments: Any) -> None:
        start_tracker()
        self._starting = _Starting()
        super().__init__(workers, self._starting, _begin, (start, *arguments))

    def __enter__(self) -> "WorkerPool":
        if hasattr(signal, "siginterrupt"):
            signal.siginterrupt(signal.SIGINT, True)
        super().__enter__()
        return self

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """As the executor's; a process that it starts is never interrupted."""
        with signal_blocked(signal.SIGINT):
            return super().submit(fn, *args, **kwargs)

    def end(self) -> None:
        """Ends the workers, in the middle of whatever they do; tasks that are not done fail."""
        started = [process for process in self._starting.made if process.pid is not None]
        for process in started:
            process.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        for process in started:
            process.join(max(deadline - time.monotonic(), 0))
            process.kill()  # one that has a handler of its own, or is deep in C
        self.shutdown(cancel_futures=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            self.end()
        return super().__exit__(kind, error, traceback)


def _begin(start: Callable[..., None] | None, *arguments: Any) -> None:
    exit_with_parent()
    if start is not None:
        start(*arguments)


def exit_with_parent() -> None:
    """Ends this process at once, with status 1, when the process that started it is gone, however that ended.

    Call it once in a worker that no `WorkerPool` started. A daemon thread waits for the parent; nothing of the worker's
    is cleaned up.

    Raises:
        RuntimeError: this process was not started by `multiprocessing`.
    """
    parent = parent_process()
    if parent is None:
        raise RuntimeError("exit_with_parent: called in the main process, expected a worker of multiprocessing")

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def start_tracker() -> None:
    """Starts the process in which `multiprocessing` notes what workers share, so that it outlives a closing terminal.

    That process ignores the other two signals by itself. On SIGHUP it would end before this one, which then starts a
    second one that knows of nothing and prints a `KeyError` for all that it is to forget.
    """
    if hasattr(signal, "pthread_sigmask"):
        with signal_blocked(signal.SIGHUP):
            resource_tracker.ensure_running()


@contextlib.contextmanager
def signal_blocked(number: int) -> Iterator[None]:
    """Holds a signal back until the block is left; for good in processes and threads that the block starts."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
