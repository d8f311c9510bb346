"""Worker processes: what one that dies takes with it, and work that ends in time."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from unirender.errors import UnirenderError
from unirender.system.worker_pool import WorkerPool
from unirender_reference.processes import time_limit
from unirender_reference.workers import LocalWorkers, WorkerDied


def square(number: int) -> int:
    return number * number


def deadly(log: Path, times: int) -> int:
    """Kills its own process the first `times` times; returns how often it was begun."""
    with log.open("a") as stream:
        stream.write(f"begin {os.getpid()}\n")
    begun = log.read_text().count("begin")
    if begun <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return begun


def slow(log: Path) -> None:
    """Notes when it begins and ends."""
    with log.open("a") as stream:
        stream.write("in\n")
    time.sleep(0.3)
    with log.open("a") as stream:
        stream.write("out\n")


def ready() -> None:
    """Nothing to do before the first task."""


def interrupted_once(log: Path) -> str:
    """Is interrupted as a terminal does it, and goes on."""
    os.kill(os.getpid(), signal.SIGINT)
    log.touch()
    return "done"


def endless(log: Path) -> None:
    log.touch()
    time.sleep(600)


def refuse() -> None:
    raise UnirenderError("no LLVM here")


def fail() -> None:
    raise UnirenderError("a bad file")


@pytest.fixture(scope="module")
def workers():
    with LocalWorkers(2, ready) as made:
        yield made


def test_results_and_exceptions_come_back(workers: LocalWorkers) -> None:
    futures = [workers.submit(square, i) for i in range(20)]
    bad = workers.submit(fail)
    assert [future.result(30) for future in futures] == [i * i for i in range(20)]
    with pytest.raises(UnirenderError, match="a bad file"):
        bad.result(30)
    assert workers.submit(square, 3).result(30) == 9


def test_a_task_that_kills_its_worker_is_tried_once_more_alone(workers: LocalWorkers, tmp_path: Path) -> None:
    log = tmp_path / "log"
    futures = [workers.submit(slow, log) for _ in range(3)]
    twice = workers.submit(deadly, log, 2)
    once = workers.submit(deadly, tmp_path / "once", 1)
    futures += [workers.submit(slow, log) for _ in range(3)]
    with pytest.raises(WorkerDied, match="again with nothing beside it"):
        twice.result(60)
    assert once.result(60) == 2
    for future in futures:  # nobody else's task is lost
        future.result(60)
    lines = log.read_text().split("\n")
    begun = [i for i, line in enumerate(lines) if line.startswith("begin")]
    assert len(begun) == 2
    before = lines[: begun[1]]
    assert before.count("in") == before.count("out")  # the second time, nothing else was under way
    assert workers.submit(square, 4).result(30) == 16


def test_a_worker_that_cannot_start_fails_every_task() -> None:
    with LocalWorkers(1, refuse) as broken:
        futures = [broken.submit(square, i) for i in range(3)]
        for future in futures:
            with pytest.raises(UnirenderError, match="no LLVM here"):
                future.result(30)


def test_what_has_not_begun_is_dropped(tmp_path: Path) -> None:
    with LocalWorkers(1, ready) as few:
        futures = [few.submit(slow, tmp_path / "log") for _ in range(8)]
        futures[0].result(30)
    assert sum(future.cancelled() for future in futures) >= 5
    assert (tmp_path / "log").read_text().count("in") == (tmp_path / "log").read_text().count("out")


def test_workers_do_not_notice_an_interrupt_and_end_with_that_of_their_parent(tmp_path: Path) -> None:
    began = None
    with pytest.raises(KeyboardInterrupt), LocalWorkers(2, ready) as workers:  # noqa: PT012 - the block is the test
        assert workers.submit(interrupted_once, tmp_path / "interrupted").result(30) == "done"
        workers.submit(endless, tmp_path / "endless")
        while not (tmp_path / "endless").exists():
            time.sleep(0.01)
        began = time.monotonic()
        raise KeyboardInterrupt
    assert began is not None
    assert time.monotonic() - began < 30


def test_work_over_its_limit_ends() -> None:
    def busy(seconds: float) -> None:
        with time_limit(0.2, "loading it"):
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                pass

    with pytest.raises(UnirenderError, match=r"loading it: not done after 0\.2 s"):
        busy(10)
    busy(0)
    time.sleep(0.3)  # the alarm was taken back


def test_another_thread_has_no_limit() -> None:
    reached: list[bool] = []

    def work() -> None:
        with time_limit(0.05, "work"):
            time.sleep(0.15)
            reached.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [True]


def test_a_pool_is_shut_down_by_no_thread_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of a pool whose worker died holds the pool's lock since Python 3.12.1: it would wait for itself."""
    genuine, by = WorkerPool.shutdown, []

    def shutdown(pool: WorkerPool, **options: bool) -> None:
        by.append(threading.current_thread() is pool._executor_manager_thread)
        genuine(pool, **options)

    monkeypatch.setattr(WorkerPool, "shutdown", shutdown)
    with LocalWorkers(1, ready) as workers:
        assert workers.submit(deadly, tmp_path / "log", 1).result(30) == 2
    assert by
    assert not any(by)
