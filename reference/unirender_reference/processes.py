"""Worker processes that render, and work that ends in time."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from unirender.errors import UnirenderError


def start_worker() -> None:
    """Starts a worker that renders: one thread."""
    from unirender_reference.backend import set_threads

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
