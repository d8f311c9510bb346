"""The demo's worker process: answers, refusals, a time limit that stops it, a crash that costs one job."""

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import demo_jobs
import pytest

from unirender.errors import UnirenderError
from unirender_evaluation.demo.worker import Worker


@dataclass
class Dying:
    """An argument on whose way the process dies."""

    worker: Worker

    def __reduce__(self) -> tuple[type[int], tuple[int]]:
        process = self.worker._process
        assert process is not None
        process.kill()
        process.join()
        return int, (2,)


pytestmark = pytest.mark.slow


def test_jobs_run_in_another_process_and_errors_come_back() -> None:
    with Worker(demo_jobs.start, seconds=60) as worker:
        assert worker.run(demo_jobs.add, 2) == 42
        assert worker.run(demo_jobs.process) != os.getpid()
        with pytest.raises(UnirenderError, match="refused with 40"):
            worker.run(demo_jobs.refuse)
        with pytest.raises(UnirenderError, match="internal error: ZeroDivisionError"):
            worker.run(demo_jobs.fail)
        assert worker.run(demo_jobs.add, 1) == 41, "a refusal costs nothing"


def test_a_job_that_takes_too_long_is_stopped_and_the_next_one_runs(tmp_path: Path) -> None:
    with Worker(demo_jobs.start, seconds=1.5) as worker:
        before = worker.run(demo_jobs.process)
        assert worker.run(demo_jobs.sleep, 0.1) == 40, "the twin: in time"
        begun = time.monotonic()
        with pytest.raises(UnirenderError, match=r"expected at most 1\.5 s"):
            worker.run(demo_jobs.sleep_over_a_file, str(tmp_path / "where"))
        assert time.monotonic() - begun < 60
        with pytest.raises(ProcessLookupError):
            os.kill(before, 0)
        assert not Path((tmp_path / "where").read_text()).exists(), "what a visitor handed in goes with the process"
        assert worker.run(demo_jobs.process) != before


def test_a_process_that_has_nothing_to_do_forgets_the_last_picture() -> None:
    with Worker(demo_jobs.start, seconds=60, idle_seconds=0.5) as worker:
        assert [worker.run(demo_jobs.look, 7) for _ in range(2)] == [1, 1], "the twin: at once"
        time.sleep(1.5)
        assert worker.run(demo_jobs.look, 7) == 2


def test_a_process_that_dies_costs_its_job_alone() -> None:
    with Worker(demo_jobs.start, seconds=60) as worker:
        with pytest.raises(UnirenderError, match="died"):
            worker.run(demo_jobs.die)
        worker.run(demo_jobs.add, 2)
        with pytest.raises(UnirenderError, match="died"):
            worker.run(demo_jobs.add, Dying(worker))
        assert worker.run(demo_jobs.add, 2) == 42


def test_whoever_is_interrupted_while_it_starts_leaves_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    worker, ended = Worker(demo_jobs.start, seconds=60), []

    def interrupt() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(worker, "_begin", interrupt)
    monkeypatch.setattr(worker, "_end", lambda: ended.append(True))
    with pytest.raises(KeyboardInterrupt), worker:
        pass
    assert ended


def test_whoever_cannot_start_says_why() -> None:
    with pytest.raises(UnirenderError, match="no checkpoint"), Worker(demo_jobs.no_start, seconds=60):
        pass


def test_many_threads_get_their_own_answers() -> None:
    found: dict[int, int] = {}
    with Worker(demo_jobs.start, seconds=60) as worker:

        def ask(value: int) -> None:
            found[value] = worker.run(demo_jobs.add, value)

        threads = [threading.Thread(target=ask, args=(value,)) for value in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert found == {value: 40 + value for value in range(8)}
