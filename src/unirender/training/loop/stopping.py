"""Asked to stop, a training ends its step and saves: nothing of it is lost, and no weight is left half way.

An interrupt from the keyboard, the SIGTERM of a batch system that wants its machine back and the SIGHUP of a terminal
that closes are such a request. Who asks a second time is not made to wait. A SIGTERM that comes at once after another
is no second request: a launcher such as torchrun passes on what a batch system has told all processes already.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType

from unirender.system.ends import HANG_UP, PASSED_ON_S, SIGNALS, Ended


@dataclass
class StopRequest:
    """The signal by which somebody asked; None: nobody has."""

    signal: int | None = None
    last: float = float("-inf")  # time of the last one

    @property
    def asked(self) -> bool:
        """Whether somebody asked."""
        return self.signal is not None

    @contextlib.contextmanager
    def unheard(self) -> Iterator[None]:
        """For a block that prints: where the terminal has closed, nobody reads it, and that is no error."""
        try:
            yield
        except OSError:
            if self.signal != HANG_UP:  # which may have come inside the block
                raise


@contextlib.contextmanager
def stopping_gently() -> Iterator[StopRequest]:
    """Inside, the first of `SIGNALS` is a request, and the second an `Ended`. One that nohup has ignored stays ignored.

    In a thread other than the main one, where no signal arrives, nothing changes.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def hear(number: int, frame: FrameType | None) -> None:
        now, before = time.monotonic(), request.last
        passed_on = request.signal == number == signal.SIGTERM and now - before < PASSED_ON_S
        if request.asked and not passed_on:
            raise Ended(number)
        request.signal, request.last = number, now

    heard = [number for number in SIGNALS if not (number == HANG_UP and signal.getsignal(number) == signal.SIG_IGN)]
    before = {number: signal.signal(number, hear) for number in heard}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not set from Python
