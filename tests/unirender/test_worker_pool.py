"""Workers end with their parent, even if that is killed; without the guard they do not."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from unirender.system import worker_pool
from unirender.system.worker_pool import WorkerPool, exit_with_parent

PARENT = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from unirender.system.worker_pool import WorkerPool, exit_with_parent

def hang():
    print(os.getpid(), flush=True)
    time.sleep(60)

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    initializer = exit_with_parent if sys.argv[2] == "guarded" else None
    if sys.argv[1] == "ours":
        WorkerPool(1).submit(hang).result()
    elif sys.argv[1] == "executor":
        pool = ProcessPoolExecutor(1, mp_context=context, initializer=initializer)
        pool.submit(hang).result()
    else:
        pool = context.Pool(1, initializer=initializer)
        pool.apply(hang)
"""


def orphan(folder: Path, pool: str, guard: str) -> int:
    """The id of a busy worker whose parent was just killed."""
    (folder / "parent.py").write_text(PARENT)
    command = [sys.executable, str(folder / "parent.py"), pool, guard]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        os.kill(parent.pid, signal.SIGKILL)
        parent.stdout.close()  # or the context waits for the worker, which holds the pipe
    return worker


def running(pid: int) -> bool:
    """Whether the process is there and no zombie."""
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_text())
    except OSError:
        return False


def ends(pid: int, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while running(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not running(pid)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc")
@pytest.mark.parametrize("pool", ["ours", "executor", "pool"])
def test_a_guarded_worker_ends_with_its_parent(pool: str, tmp_path: Path) -> None:
    assert ends(orphan(tmp_path, pool, "guarded"), 10)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc")
def test_an_unguarded_worker_lives_on(tmp_path: Path) -> None:
    worker = orphan(tmp_path, "executor", "unguarded")
    try:
        assert not ends(worker, 0.5)
    finally:
        os.kill(worker, signal.SIGKILL)


def test_a_pool_ends_its_own_workers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another one may begin while it does, in another thread."""
    one, other, blocked = WorkerPool(1), WorkerPool(1), worker_pool.signal_blocked

    @contextlib.contextmanager
    def meanwhile(number: int) -> Iterator[None]:
        monkeypatch.setattr(worker_pool, "signal_blocked", blocked)
        other.submit(os.getpid).result()
        with blocked(number):
            yield

    monkeypatch.setattr(worker_pool, "signal_blocked", meanwhile)
    first = one.submit(os.getpid).result()
    one.end()
    assert ends(first, 10)
    assert running(other.submit(os.getpid).result())
    other.shutdown()


def test_the_main_process_has_no_such_parent() -> None:
    with pytest.raises(RuntimeError, match="expected a worker"):
        exit_with_parent()


HUNG_UP = """
import time
from unirender.command_line.process_ends import hear_ends
from unirender.system.worker_pool import WorkerPool

if __name__ == "__main__":
    hear_ends()
    with WorkerPool(1) as pool:
        pool.submit(print, "begun", flush=True).result()
        time.sleep(60)
"""


def test_a_terminal_that_closes_leaves_no_error_of_the_tracker(tmp_path: Path) -> None:
    """SIGHUP comes to the whole group, to the process that `multiprocessing` tracks names in as well."""
    (tmp_path / "parent.py").write_text(HUNG_UP)
    command = [sys.executable, str(tmp_path / "parent.py")]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, start_new_session=True, preexec_fn=heed_hang_up
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "begun\n"
        os.killpg(parent.pid, signal.SIGHUP)
        errors = parent.communicate(timeout=30)[1]
    assert errors.rstrip().endswith("Ended: 1"), errors
    assert "KeyError" not in errors


def heed_hang_up() -> None:
    """Where the tests run under nohup a process inherits that it ignores the signal."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
