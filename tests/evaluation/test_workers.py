"""Worker processes end with their parent, even if that is killed: each holds torch and Mitsuba. Ctrl-C ends both. They
may write the same picture at the same time."""

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from PIL import Image
from tiny_suites import write_suite

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_evaluation.figures.grid import Grid, Line, Tile, save
from unirender_evaluation.methods.trivial import UneditedInput
from unirender_evaluation.records import Record
from unirender_evaluation.report.pictures import write_sheet
from unirender_evaluation.rows import make_row
from unirender_evaluation.runs import workers
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.versions import LPIPS, Versions

SECONDS = 120  # to start a worker, and to see it end: a busy machine takes its time

HOLD = """
import fcntl, os, sys, time

def hold(*_):
    "A worker's endless task: holds a lock, which ends with the process, and writes its id."
    lock = open(os.environ["HELD"], "a")
    fcntl.flock(lock, fcntl.LOCK_EX)
    print(os.getpid(), file=lock, flush=True)
    time.sleep(600)
"""
BENCH = """
from pathlib import Path
from hold import hold
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.versions import Versions
from unirender_evaluation.runs.workers import Run, run_in_workers

if __name__ == "__main__":
    suite = load_suite(sys.argv[1])
    run = Run(suite, (), list(suite.scenes), Versions("test"), (), Path(sys.argv[2]) / "pictures")
    next(run_in_workers(run, hold, [suite.scenes[0]], frozenset(), 1))
"""
TRUTH = """
from pathlib import Path
from hold import hold
from unirender_evaluation.truth import make as truth

if __name__ == "__main__":
    truth.render_object = hold
    next(truth.make_truth(sys.argv[1], Path(sys.argv[2]) / "work"))
"""

POOL = """
import os, signal
from hold import hold
from unirender.system.worker_pool import WorkerPool

def start(handled):
    "As Mitsuba does while it renders, and as libraries do that want to end in order."
    signal.signal(signal.SIGINT, lambda *_: open(handled, "w").close())
    signal.signal(signal.SIGTERM, signal.SIG_IGN)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs do not have
    signal.siginterrupt(signal.SIGINT, False)  # as it is once Mitsuba has rendered
    with WorkerPool(1, start, sys.argv[1]) as pool:
        waiting = [pool.submit(hold) for _ in range(3)]
        waiting[0].result()
"""


class Failing:
    """Fails on the second question that it is asked."""

    name = "failing"
    config: Mapping[str, int] = MappingProxyType({"at": 2})

    def __init__(self) -> None:
        self.asked = 0

    def edit(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera, **_: float) -> np.ndarray:
        self.asked += 1
        if self.asked == 2:
            raise RuntimeError("out of memory")
        return image_srgb * mask


def test_what_was_made_before_a_method_fails_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    suite = load_suite(write_suite(tmp_path / "suite"))
    scene = suite.scenes[0]
    rows = [make_row(UneditedInput(), "trivial"), make_row(Failing(), "external")]
    run = Run(suite, rows, [scene], Versions("test", {LPIPS: "1"}), (), tmp_path / "pictures")
    notes = tmp_path / "notes"
    notes.mkdir()
    monkeypatch.setattr(workers, "_here", (run, frozenset(), notes / "17"))
    error = workers._scene(scene.key)
    journals = workers.Journals(notes)
    assert [record.method for record in journals.new()] == ["unedited-input", "failing", "unedited-input"]
    assert "method 'failing', edit (rendering/from-image/" in str(error)
    assert "RuntimeError: out of memory" in str(error)
    assert journals.new() == []


def test_records_are_handed_over_one_by_one_and_whole(tmp_path: Path) -> None:
    """A scene may take minutes, of which a kill would leave nothing; and it may come in the middle of a record."""
    journals, lines = workers.Journals(tmp_path), [Record("t", "p", "m", str(n), "o", {}).to_json() for n in range(3)]
    (tmp_path / "1.jsonl").write_text(f"{lines[0]}\n{lines[1][:9]}")
    (tmp_path / "2.jsonl").write_text(f"{lines[2]}\n")
    (tmp_path / "1").write_text("Ours on a scene")
    assert [record.sample for record in journals.new()] == ["0", "2"]
    with (tmp_path / "1.jsonl").open("a") as file:
        file.write(lines[1][9:])
    assert journals.new() == []
    with (tmp_path / "1.jsonl").open("a") as file:
        file.write("\n")
    assert [record.sample for record in journals.new()] == ["1"]


def test_rows_are_the_same_in_every_process() -> None:
    """A config with a time or a random name in it has other content keys in each."""
    row = make_row(Failing(), "external")
    assert workers.same_rows([row], {"failing": {"at": 2}}) == [row]
    said = r"method 'failing': its config is {'at': 2} in a worker process, and {'at': 3} in the one that started it"
    with pytest.raises(UnirenderError, match=said):
        workers.same_rows([row], {"failing": {"at": 3}})


def locked(path: Path) -> bool:
    """Whether a process holds the lock; one that is dead but not yet reaped does not."""
    with path.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False


@pytest.mark.long
@pytest.mark.parametrize("script", [BENCH, TRUTH], ids=["bench", "truth"])
def test_a_worker_ends_with_a_killed_parent(script: str, tmp_path: Path) -> None:
    held = tmp_path / "held"
    held.touch()
    (tmp_path / "hold.py").write_text(HOLD)
    (tmp_path / "parent.py").write_text("import sys\n" + script)
    command = [sys.executable, str(tmp_path / "parent.py"), str(write_suite(tmp_path / "suite")), str(tmp_path)]
    parent = subprocess.Popen(command, env=os.environ | {"HELD": str(held)})
    try:
        wait_until(lambda: parent.poll() is not None or held.read_text().endswith("\n"))
        assert parent.poll() is None
        assert locked(held)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    try:
        wait_until(lambda: not locked(held))
    except TimeoutError:
        os.kill(int(held.read_text()), signal.SIGKILL)
        raise


def test_an_interrupt_ends_parent_and_worker_at_once(tmp_path: Path) -> None:
    """A terminal sends it to both: the worker notices nothing, and the parent ends it."""
    held, handled = tmp_path / "held", tmp_path / "handled"
    held.touch()
    (tmp_path / "hold.py").write_text(HOLD)
    (tmp_path / "parent.py").write_text("import sys\n" + POOL)
    command = [sys.executable, str(tmp_path / "parent.py"), str(handled)]
    settings = os.environ | {"HELD": str(held)}
    parent = subprocess.Popen(command, env=settings, start_new_session=True, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: parent.poll() is not None or held.read_text().endswith("\n"))
        assert locked(held)
        os.killpg(parent.pid, signal.SIGINT)
        said = parent.communicate(timeout=SECONDS)[1]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)
    assert not locked(held)
    assert not handled.exists()
    assert said.count("Traceback") == said.count("KeyboardInterrupt\n") == 1


def wait_until(condition: Callable[[], bool]) -> None:
    """Raises: TimeoutError."""
    end = time.monotonic() + SECONDS
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {SECONDS} s")
        time.sleep(0.1)


def sheet(path: Path) -> None:
    write_sheet(path, {"image": np.zeros((2, 2, 3), np.float32)}, "key")


def figure(path: Path) -> None:
    save(Grid(("A",), (Line("row", (Tile(np.zeros((2, 2, 3), np.float32)),)),)), path)


@pytest.mark.parametrize("write", [sheet, figure])
def test_two_may_write_one_picture(write: Callable[[Path], None], tmp_path: Path) -> None:
    """Neither takes the other's temporary file away; none stays."""
    path = tmp_path / "pictures" / "one.png"
    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(write, path) for _ in range(40)]:
            done.result()
    with Image.open(path) as image:
        image.load()
    assert [found.name for found in path.parent.iterdir()] == [path.name]
