"""`kill -9`: the same command again, and the losses are those of a run that nobody killed."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from signal import SIGKILL

import pytest
import torch
from synthetic_shards import write_dataset
from tiny_models import TRAIN

from unirender.training.command import Train
from unirender.training.loop.checkpoint import STATE_FILE, load_state, save_state
from unirender.training.run import train

SCRIPT = Path(__file__).resolve().parents[1] / "helpers" / "train_tiny.py"
STEPS, LOG_EVERY = 30, 3
TIMES = ("minutes", "samples_per_s")


def start(data: Path, out: Path) -> subprocess.Popen[str]:
    """Saves several times a second: rarely enough that steps after the last save are lost."""
    command = [sys.executable, str(SCRIPT), "train", "--preset", "test", "--data", str(data), "--out", str(out)]
    length = ["--steps", str(STEPS), "--log-every", str(LOG_EVERY), "--save-minutes", "0.004"]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    return subprocess.Popen([*command, *length], env=env, stdout=pipe, stderr=pipe, text=True)


def finish(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors


def logged(out: Path) -> list[dict[str, float]]:
    """The lines of losses, without what the clock says; one that is cut short does not count."""
    path = out / "log.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    whole = [json.loads(line) for line in lines if line.endswith("\n")]
    return [{name: value for name, value in line.items() if name not in TIMES} for line in whole]


def kill_after(process: subprocess.Popen[str], out: Path, lines: int) -> None:
    """Kills the run when it has saved a state and logged so many lines."""
    end = time.monotonic() + 500
    while not (len(logged(out)) >= lines and (out / STATE_FILE).exists()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "the run logs nothing"
        time.sleep(0.01)
    process.send_signal(SIGKILL)
    process.communicate()
    assert process.returncode == -SIGKILL


@pytest.mark.long
def test_losses_after_a_kill_are_those_without(tmp_path: Path) -> None:
    data, killed, whole = write_dataset(tmp_path / "data", size=32), tmp_path / "killed", tmp_path / "whole"
    first = start(data, killed)
    kill_after(first, killed, 2)
    before = logged(killed)
    state = load_state(killed)
    assert state is not None
    assert 0 < state["step"] < STEPS
    assert len(before) < STEPS / LOG_EVERY
    altered = shutil.copytree(killed, tmp_path / "altered")
    torn = (killed / STATE_FILE).read_bytes()[:1000]
    (killed / f".{STATE_FILE}.part").write_bytes(torn)  # as if killed while it wrote the state
    for process in [start(data, killed), start(data, whole)]:
        finish(process)
    assert logged(killed) == logged(whole)  # bit for bit
    assert [line["step"] for line in logged(whole)] == list(range(LOG_EVERY, STEPS + 1, LOG_EVERY))
    save_state(altered, state | {"generator": torch.Generator().manual_seed(1).get_state()})
    options = Train(data=data, out=altered, steps=STEPS, log_every=LOG_EVERY, parallel=1)
    train(options, TRAIN, altered)
    assert [line["step"] for line in logged(altered)] == [line["step"] for line in logged(whole)]
    assert logged(altered) != logged(whole)  # the twin: resumed with other random numbers
    assert not (killed / f".{STATE_FILE}.part").exists()
