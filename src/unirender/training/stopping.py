"""Asked to stop, a training ends its step and saves: nothing of it is lost, and no weight is left half way.

An interrupt from the keyboard and the SIGTERM of a batch system that wants its machine back are such a request. Who
asks a second time is not made to wait.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass
class StopRequest:
    """Whether somebody asked."""

    asked: bool = False


@contextlib.contextmanager
def stopping_gently() -> Iterator[StopRequest]:
    """Inside, the first of `SIGNALS` is a request, and the second a `KeyboardInterrupt`.

    In a thread other than the main one, where no signal arrives, nothing changes.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def hear(number: int, frame: FrameType | None) -> None:
        if request.asked:
            raise KeyboardInterrupt
        request.asked = True

    before = {number: signal.signal(number, hear) for number in SIGNALS}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not set from Python
