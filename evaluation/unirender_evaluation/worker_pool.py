"""A pool of worker processes that Ctrl-C ends at once.

A terminal interrupts the parent and its workers alike. A worker must not notice: Mitsuba takes the signal for itself
while it renders, gives the picture up, and the pool waits for a worker that waits for work. The parent alone is
interrupted, and ends its workers, in the middle of whatever they do. It must notice at once, even if Mitsuba has
rendered in it, which leaves a handler that does not end a wait.
"""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import active_children, get_context
from types import TracebackType
from typing import Any

GRACE_SECONDS = 2  # for a worker to end by itself once it is told to


class WorkerPool(ProcessPoolExecutor):
    """`ProcessPoolExecutor` whose workers are ended where its `with` block is left by an exception.

    Args:
        workers: processes.
        start: called once in each, before its first task.
        arguments: of `start`.
    """

    def __init__(self, workers: int, start: Callable[..., None], *arguments: Any) -> None:
        super().__init__(workers, get_context("spawn"), start, arguments)
        self._strangers = set(active_children())

    def __enter__(self) -> "WorkerPool":
        if hasattr(signal, "siginterrupt"):
            signal.siginterrupt(signal.SIGINT, True)
        super().__enter__()
        return self

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """As the executor's; a process that it starts is never interrupted."""
        with interrupts_blocked():
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            workers = set(active_children()) - self._strangers
            for process in workers:
                process.terminate()
            deadline = time.monotonic() + GRACE_SECONDS
            for process in workers:
                process.join(max(deadline - time.monotonic(), 0))
                process.kill()  # one that has a handler of its own, or is deep in C
            self.shutdown(cancel_futures=True)
        return super().__exit__(kind, error, traceback)


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Holds SIGINT back until the block is left; for good in processes and threads that the block starts."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
