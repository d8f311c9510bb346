"""Worker processes that end with their parent, and work that ends in time.

A pool's workers outlive a parent that is killed (`kill -9`): nobody is left to tell them, and each holds Mitsuba, torch
and the memory of its last task. Every pool of this project therefore starts its workers with `exit_with_parent`.
"""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from unirender.errors import UnirenderError


def exit_with_parent() -> None:
    """Ends this process at once, with status 1, when the process that started it is gone, however that ended.

    Call it once in a worker: as `initializer` of a `multiprocessing.Pool` or a `ProcessPoolExecutor`, or first in an
    initializer of your own. A daemon thread waits for the parent; nothing of the worker's is cleaned up.

    Raises:
        RuntimeError: this process was not started by `multiprocessing`.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("exit_with_parent: called in the main process, expected a worker of multiprocessing")

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def start_worker() -> None:
    """An initializer of workers that render: one thread each, and none outlives its parent."""
    from unirender_reference.backend import set_threads

    exit_with_parent()
    set_threads(1)


class TimeLimitPassed(UnirenderError):
    """Something took longer than it may."""


@contextlib.contextmanager
def time_limit(seconds: float, what: str) -> Iterator[None]:
    """Ends the block with an error when it takes longer.

    An alarm signal: it cuts short Python code, and a call of C code when that returns. Only a process's main thread can
    set one, so in any other thread (a worker of dask) the block has no limit.

    Args:
        seconds: the limit.
        what: begins the error message.

    Raises:
        TimeLimitPassed: the limit was passed.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(_signal: int, _frame: FrameType | None) -> None:
        raise TimeLimitPassed(f"{what}: not done after {seconds:g} s, expected less; simplify it")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
