"""A process that works for the page: each job within a time limit, and a crash in it costs that job alone.

    with Worker(start, seconds=60) as worker:       # start() makes the context, in the process
        answer = worker.run(job, 1, 2)              # job(context, 1, 2), in the process

A job that is not done in time is stopped with its process, and the next one finds a new process. Files of strangers are
decoded in there, too: what a decoder does to its process it does not do to the page. The process has a folder for its
temporary files, which goes with it, however it ends: a job that was stopped leaves no picture behind.
"""

import logging
import multiprocessing
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any

from unirender.errors import UnirenderError
from unirender.pipelines.remembered import forget_pictures
from unirender.system.worker_pool import exit_with_parent, start_tracker

START_SECONDS = 300.0  # for loading a model on a busy machine
logger = logging.getLogger(__name__)


class Worker:
    """One process, one job at a time; others wait.

    Args:
        start: makes what every job gets first; importable by name, like the jobs, and so are their arguments.
        seconds: that a job may take.
        idle_seconds: without a job, after which the process lets go of what it remembers of the last pictures.
    """

    def __init__(self, start: Callable[[], Any], seconds: float, idle_seconds: float = 60.0) -> None:
        self.start, self.seconds, self.idle_seconds = start, seconds, idle_seconds
        self._lock = threading.Lock()
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> "Worker":
        """Waits until the process can work."""
        try:
            with self._lock:
                self._begin()
        except BaseException:  # an interrupt, too: the process would be left alone, and print what it makes of that
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._end()

    def run(self, job: Callable[..., Any], *arguments: Any) -> Any:
        """What `job(context, *arguments)` returns.

        Raises:
            UnirenderError: the job did; or it took too long, or its process died.
        """
        with self._lock:
            if self._process is None or not self._process.is_alive():
                self._begin()
            return self._answer(self.seconds, (job, arguments))

    def _begin(self) -> None:
        self._end()
        start_tracker()
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._folder = tempfile.TemporaryDirectory(prefix="unirender-demo-")
        arguments = (self.start, theirs, self.idle_seconds, self._folder.name)
        process = context.Process(target=_work, args=arguments, daemon=True)
        process.start()
        self._process = process
        theirs.close()
        self._answer(START_SECONDS)

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _answer(self, seconds: float, question: tuple[Callable[..., Any], tuple] | None = None) -> Any:
        """To a question, or without one to the first, which is whether `start` succeeded."""
        assert self._pipe is not None, "there is a process"
        begun = time.monotonic()
        try:
            if question is not None:
                self._pipe.send(question)
            if not self._pipe.poll(seconds):
                self._end()
                raise UnirenderError(
                    f"not done after {time.monotonic() - begun:.0f} s, and stopped; expected at most {seconds:g} s; "
                    "try a smaller picture, or again when the machine is less busy"
                )
            succeeded, answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._end()
            raise UnirenderError("the process that worked on it died; expected an answer; try another file") from error
        if not succeeded:
            raise answer
        return answer


def _work(start: Callable[[], Any], pipe: Connection, idle_seconds: float, folder: str) -> None:
    """The process: answers (whether it succeeded, the result or the error) until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends this
    exit_with_parent()
    tempfile.tempdir = folder
    context: Any = None

    def prepare(_: Any) -> None:
        nonlocal context
        context = start()

    pipe.send(_answered(prepare, None, ()))
    while True:
        try:
            if not pipe.poll(idle_seconds):
                forget_pictures()
            job, arguments = pipe.recv()
        except EOFError:
            return
        pipe.send(_answered(job, context, arguments))


def _answered(job: Callable[..., Any], context: Any, arguments: tuple) -> tuple[bool, Any]:
    try:
        return True, job(context, *arguments)
    except UnirenderError as error:
        return False, error
    except Exception as error:
        logger.exception("demo: a job failed")
        return False, UnirenderError(f"internal error: {type(error).__name__}; the server's log says where")
