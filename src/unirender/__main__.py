"""The command `unirender`, also as `python -m unirender`: it can be interrupted before it is imported."""

import os
import signal
from types import FrameType


def main() -> None:
    """Entry point of the `unirender` script: `unirender.cli.main`, whose imports take some tenths of a second."""
    heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heard:
        signal.signal(signal.SIGINT, _interrupted)
    from unirender.cli import main as run

    if heard:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until `run` hears of it
    run()


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Ends the process at once: nothing has begun, and a traceback of whatever is being imported says nothing."""
    os.write(2, b"unirender: interrupted\n")
    os._exit(128 + number)


if __name__ == "__main__":
    main()
