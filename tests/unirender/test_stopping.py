"""Asked to stop, a training ends its step and saves; asked twice, it leaves at once."""

import errno
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_models import TRAIN, make_batch
from torch import Tensor

from unirender import cli
from unirender.system.ends import SIGNALS, Ended
from unirender.training.config import RunConfig
from unirender.training.loop import stopping
from unirender.training.loop.checkpoint import load_state
from unirender.training.loop.stopping import stopping_gently
from unirender.training.loop.trainer import Trainer

STEPS = 4
pytestmark = pytest.mark.usefixtures("a_hangup_counts")


class Source:
    """Batch k is a function of k; while `stop_at` is made, this process is sent `signals`."""

    def __init__(self, stop_at: int = 0, signals: tuple[int, ...] = ()) -> None:
        self.place, self.stop_at, self.signals = 0, stop_at, signals

    def next(self) -> dict[str, Tensor]:
        self.place += 1
        for number in self.signals if self.place == self.stop_at else ():
            os.kill(os.getpid(), number)
        return make_batch(TRAIN.batch_size, seed=self.place)

    def read_ahead(self) -> None:
        """Nothing: each batch is made when it is asked for."""

    def state_dict(self) -> dict[str, Any]:
        return {"place": self.place}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.place = state["place"]

    def refresh(self) -> str | None:
        return None


def fit(folder: Path, source: Source) -> list[dict[str, Any]]:
    """The lines of losses of a run in this folder, or of what is left of it."""
    lines: list[dict[str, Any]] = []
    trainer = Trainer(TRAIN, RunConfig(folder, steps=STEPS, log_every=1), torch.device("cpu"), torch.float32)
    trainer.fit(source, lines.append)
    return [{k: v for k, v in line.items() if k not in ("minutes", "samples_per_s")} for line in lines if "lr" in line]


def test_the_step_is_ended_and_saved_and_nothing_is_lost(tmp_path: Path) -> None:
    before = [signal.getsignal(n) for n in SIGNALS]
    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path / "stopped", Source(2, SIGNALS[:1]))
    assert [signal.getsignal(n) for n in SIGNALS] == before
    state = load_state(tmp_path / "stopped")
    assert state is not None
    assert (state["step"], state["source"]["place"]) == (2, 2)
    rest, whole = fit(tmp_path / "stopped", Source()), fit(tmp_path / "whole", Source())
    assert rest == whole[2:]  # bit for bit
    assert len(whole) == STEPS


def test_the_last_save_is_ended_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped in it, a run that was over lost what came after the save before."""

    def state_dict(source: Source) -> dict[str, Any]:
        if source.place == STEPS:
            os.kill(os.getpid(), signal.SIGINT)
        return {"place": source.place}

    monkeypatch.setattr(Source, "state_dict", state_dict)
    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path, Source())
    state = load_state(tmp_path)
    assert state is not None
    assert state["step"] == STEPS


@pytest.mark.parametrize("number", SIGNALS)
def test_the_status_tells_the_signal(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a shell reports it, and a batch system that starts the run again looks for."""
    monkeypatch.setattr(cli, "run", lambda command: fit(tmp_path, Source(2, (number,))))
    with pytest.raises(SystemExit) as stopped:
        cli.main(["train", "--data", "data"])
    assert stopped.value.code == 128 + number


def test_a_terminal_that_has_closed_takes_nothing_of_the_run(tmp_path: Path) -> None:
    def closed(line: dict[str, Any]) -> None:
        if line["step"] == 2:
            raise OSError(errno.EIO, "Input/output error")

    for number, step in ((signal.SIGTERM, None), (signal.SIGHUP, 2)):  # of the first it is no consequence
        trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=STEPS, log_every=1), torch.device("cpu"), torch.float32)
        with pytest.raises(Ended if step else OSError):
            trainer.fit(Source(2, (number,)), closed)
        state = load_state(tmp_path)
        assert (None if state is None else state["step"]) == step


def test_nohup_is_respected(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert len(fit(tmp_path, Source(2, (signal.SIGHUP,)))) == STEPS
    finally:
        signal.signal(signal.SIGHUP, before)


def test_who_asks_twice_is_not_made_to_wait(tmp_path: Path) -> None:
    source = Source(2, (signal.SIGINT, signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path, source)
    assert source.place == 2
    assert load_state(tmp_path) is None  # not even the first step was saved: that takes minutes


def test_a_sigterm_that_a_launcher_passes_on_is_no_second_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """torchrun tells its processes what a batch system has told them, too."""

    def told_twice() -> None:
        with stopping_gently() as request:
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGTERM)
        assert request.signal == signal.SIGTERM

    told_twice()
    monkeypatch.setattr(stopping, "PASSED_ON_S", 0.0)
    with pytest.raises(Ended):
        told_twice()  # the twin: later it is one


def test_in_another_thread_nothing_changes() -> None:
    before, seen = [signal.getsignal(n) for n in SIGNALS], []

    def look() -> None:
        with stopping_gently() as request:
            seen.extend([request.asked, [signal.getsignal(n) for n in SIGNALS] == before])

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert seen == [False, True]


def test_a_terminal_that_closes_while_something_is_printed_is_no_error() -> None:
    with stopping_gently() as request, request.unheard():
        os.kill(os.getpid(), signal.SIGHUP)
        raise OSError(errno.EIO, "nobody reads")
    assert request.signal == signal.SIGHUP
    with pytest.raises(OSError, match="nobody"), stopping_gently() as request, request.unheard():
        raise OSError(errno.EIO, "nobody reads")  # the twin: nobody hung up
