"""An executor of single-threaded worker processes in which a task that kills its worker harms no other task.

Every worker is a pool of one process, so it is known which task a dead worker had. That task runs once more with no
other beside it, all the machine's memory its own; if the worker dies again, the task's future raises `WorkerDied`.
Workers start when the executor is made: their imports run while the caller makes its plan. They end with their parent,
and at once where it is interrupted (`unirender.system.worker_pool`).
"""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

from unirender.errors import UnirenderError
from unirender.system.worker_pool import WorkerPool


class WorkerDied(UnirenderError):
    """The worker process ended in the middle of a task, and again when the task ran alone."""


@dataclass
class _Task:
    """A call and the future that its caller holds."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    future: Future = field(default_factory=Future)


class LocalWorkers:
    """Processes of this machine behind `concurrent.futures`' `submit`.

    A context manager: it waits for what its workers do, or ends them where its block is left by an exception.

    Args:
        workers: how many processes.
        start: called once in every process, before its first task; what it raises ends all tasks.
    """

    def __init__(self, workers: int, start: Callable[[], None]) -> None:
        self.workers = workers
        self._start = start
        self._lock = threading.RLock()
        self._pools: set[WorkerPool] = set()
        self._idle: list[WorkerPool] = []
        self._waiting: deque[_Task] = deque()
        self._suspects: deque[_Task] = deque()  # their worker died: to be run alone
        self._running = 0
        self._alone = False  # a suspect is running
        self._broken: BaseException | None = None
        self._closed = False
        with self._lock:
            for _ in range(workers):
                self._hire()

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future:
        """Runs `function(*arguments)` in a worker; both have to be picklable."""
        task = _Task(function, arguments)
        with self._lock:
            self._waiting.append(task)
            self._dispatch()
        return task.future

    def shutdown(self) -> None:
        """Drops what has not begun and waits for the rest."""
        self._close(lambda pool: pool.shutdown(wait=True, cancel_futures=True))

    def _close(self, end: Callable[[WorkerPool], None]) -> None:
        with self._lock:
            self._closed = True
            for task in self._waiting:
                task.future.cancel()
            for task in self._suspects:
                _fail(task, CancelledError())
            pools = list(self._pools)
        with ThreadPoolExecutor(len(pools)) as threads:  # all at once: each takes a moment to end
            list(threads.map(end, pools))

    def __enter__(self) -> "LocalWorkers":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.shutdown()
        else:
            self._close(WorkerPool.end)

    def _hire(self) -> None:
        """Starts a process; it is idle once it is ready."""
        pool = WorkerPool(1)
        self._pools.add(pool)
        pool.submit(self._start).add_done_callback(lambda started: self._started(pool, started))

    def _started(self, pool: WorkerPool, started: Future) -> None:
        with self._lock:
            if started.cancelled():
                return
            if (error := started.exception()) is not None:
                if isinstance(error, BrokenProcessPool):
                    error = UnirenderError("a worker process ended while it started (out of memory?); start it again")
                self._broken = error
            self._idle.append(pool)
            self._dispatch()

    def _dispatch(self) -> None:
        """Hands tasks to idle workers: a suspect only when nothing runs, and then nothing beside it."""
        while self._broken is not None and (self._waiting or self._suspects):
            _fail((self._suspects or self._waiting).popleft(), self._broken)
        while self._idle and not self._closed and not self._alone:
            if self._suspects:
                if self._running:
                    return
                self._alone = True
                self._run(self._suspects.popleft(), self._idle.pop())
            elif self._waiting:
                task = self._waiting.popleft()
                if task.future.set_running_or_notify_cancel():
                    self._run(task, self._idle.pop())
            else:
                return

    def _run(self, task: _Task, pool: WorkerPool) -> None:
        self._running += 1
        try:
            inner = pool.submit(task.function, *task.arguments)
        except BrokenProcessPool as error:  # it died while it was idle
            inner = Future()
            inner.set_exception(error)
        inner.add_done_callback(lambda done: self._done(task, pool, done))

    def _done(self, task: _Task, pool: WorkerPool, inner: Future) -> None:
        """Hands a task's result on; where its worker died, it is tried once more with nothing beside it."""
        with self._lock:
            alone, self._alone = self._alone, False
            self._running -= 1
            error = CancelledError() if inner.cancelled() else inner.exception()
            if isinstance(error, BrokenProcessPool):
                self._pools.discard(pool)  # it ends by itself; `shutdown` would wait for a lock of this very thread
                if alone or self._closed:
                    _fail(task, WorkerDied("the worker died, and again with nothing beside it (out of memory?)"))
                else:
                    self._suspects.append(task)
                if not self._closed:
                    self._hire()
            else:
                self._idle.append(pool)
                if error is not None:
                    _fail(task, error)
                else:
                    task.future.set_result(inner.result())
            self._dispatch()


def _fail(task: _Task, error: BaseException) -> None:
    if not task.future.cancelled():
        task.future.set_exception(error)
