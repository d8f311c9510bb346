"""How the process of a command starts, and how it ends early: a signal, or a reader who left. Light to import."""

import contextlib
import gc
import io
import os
import select
import signal
import sys
from collections.abc import Iterator
from types import FrameType

from unirender.command_line import Ended
from unirender.models.lean_imports import lean_imports

OBJECTS = 50_000  # new ones, after which Python looks for unused cycles of them
READER_LEFT = 141  # exit status: as a shell reports SIGPIPE


@contextlib.contextmanager
def quick_start() -> Iterator[None]:
    """For a process of our own that ends with what is done inside: a lean start, and a quick end.

    Importing torch makes a multitude of objects that live as long as the process. Python, which looks among all of them
    for cycles that nobody uses any more, does so seldom here, and at the end of the process no more.
    """
    gc.set_threshold(OBJECTS)
    try:
        with lean_imports():
            yield
    finally:
        gc.freeze()


def end(number: int, frame: FrameType | None) -> None:
    """Asked to stop by a batch system or a terminal that closes, a command of the model ends as when it is interrupted.

    Others resume by what they have written, and end at once.

    Raises:
        Ended: always.
    """
    for each in (signal.SIGTERM, signal.SIGHUP):  # `timeout` sends it to the process and to its group
        signal.signal(each, signal.SIG_IGN)
    raise Ended(number)


def open_streams() -> None:
    """Of the standard streams, those that were closed when the process began (`>&-`) lead nowhere from now on.

    What is printed to them is lost, as whoever closed them asked for, and no file that is opened later gets it instead.
    To those that are open, letters that their encoding lacks are printed by their number, as Python does with errors.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            setattr(sys, name, os.fdopen(number, mode))
    out = sys.stdout
    if isinstance(out, io.TextIOWrapper) and (out.errors == "strict" or not out.encoding.lower().startswith("utf")):
        out.reconfigure(errors="backslashreplace")


def reader_left() -> bool:
    """Whether nobody reads the standard output any more; another pipe that breaks is an error like others."""
    output = select.poll()
    output.register(sys.stdout.fileno(), 0)
    return bool(output.poll(0))


def drop_output() -> None:
    """What is still to be printed goes nowhere: the reader of the standard output has left."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
