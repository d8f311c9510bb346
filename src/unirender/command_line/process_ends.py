"""How the process of a command starts, and how it ends early: a signal, or a reader who left. Light to import."""

import _thread
import contextlib
import gc
import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType

from unirender.models.lean_imports import lean_imports
from unirender.system.ends import PASSED_ON_S, SIGNALS, Ended

OBJECTS = 50_000  # new ones, after which Python looks for unused cycles of them
WAIT_S, MOST_WAITS = 0.05, 200  # of a signal, for the end of an import: ten seconds in all
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


def hear_ends() -> None:
    """From now on SIGINT, SIGTERM and SIGHUP end this process in order: what is temporary is deleted, workers end.

    They are those of Ctrl-C, of a batch system or `timeout`, and of a terminal that closes. What the process ignores
    from its beginning, as nohup has it ignore SIGHUP, stays ignored. A process that is forked, as a plug-in's pool does
    it, ends as any other: it would print an error, and an import below it would have it wait.
    """
    ends = _Ends()
    before = {number: signal.getsignal(number) for number in SIGNALS}
    heard = [number for number in SIGNALS if before[number] in (signal.SIG_DFL, signal.default_int_handler)]
    for number in heard:
        signal.signal(number, ends.hear)

    def as_before() -> None:
        for number in heard:
            if signal.getsignal(number) == ends.hear:
                signal.signal(number, before[number])

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=as_before)


class _Ends:
    """Raises `Ended` on a signal, once a module that is being imported is there.

    In the middle of an import, torch aborts the process on any exception, and trimesh takes it for a library that is
    missing and goes on without.
    """

    def __init__(self) -> None:
        self.last = float("-inf")  # time of the last that was raised
        self.waiting = False  # whether one waits for the end of an import
        self.waits = 0  # since the last that was raised

    def hear(self, number: int, frame: FrameType | None) -> None:
        """The handler.

        Raises:
            Ended: no module is being imported, and the signal is none that comes again by another way.
        """
        if importing(frame) and self.waits < MOST_WAITS:
            if not self.waiting:
                self.waiting, self.waits = True, self.waits + 1
                _thread.start_new_thread(self.again, (number,))  # takes none of the locks that `threading` may hold
        elif number == signal.SIGINT or time.monotonic() - self.last > PASSED_ON_S:
            self.last, self.waits = time.monotonic(), 0
            raise Ended(number)

    def again(self, number: int) -> None:
        """Sends the signal to the main thread a little later."""
        time.sleep(WAIT_S)
        self.waiting = False
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:  # Windows
            _thread.interrupt_main(signal.Signals(number))


def importing(frame: FrameType | None) -> bool:
    """Whether a frame, or one that called it, imports a module."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


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
