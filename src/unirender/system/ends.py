"""How a process ends early: the signals, what they raise, and what an error came of. Light to import."""

import signal
from collections.abc import Iterator

PASSED_ON_S = 2.0  # seconds in which a signal may come again by another way: `timeout` tells a process and its group
HANG_UP: int = getattr(signal, "SIGHUP", 0)  # 0, which is no signal: Windows has none
SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, *filter(None, [HANG_UP]))


class Ended(KeyboardInterrupt):
    """The signal `args[0]` came."""


def interrupted(error: BaseException) -> bool:
    """Whether an error is Ctrl-C, or comes of it: Dr.Jit's loops wrap it."""
    return any(isinstance(cause, KeyboardInterrupt) for cause in causes(error))


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error, what it came of, and so on back to the first."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
