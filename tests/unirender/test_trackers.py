"""Experiment trackers: a real one of accelerate's interface that writes a file, driven by a run."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate.tracking import LOGGER_TYPE_TO_CLASS, GeneralTracker, on_main_process, register_tracker_class
from synthetic_shards import write_dataset
from tiny_models import TRAIN

from unirender.cli import main
from unirender.errors import UnirenderError, UsageError
from unirender.training.command import Train
from unirender.training.config import RunConfig
from unirender.training.data.source import ShardSource
from unirender.training.logs.trackers import check_trackers, known_trackers, make_trackers, numbers, tracking
from unirender.training.loop.trainer import Trainer

NAME = "test_lines"


class LineTracker(GeneralTracker):
    """Appends what it is told to a file of JSON lines, as a TensorBoard writer does to its own."""

    name = NAME
    requires_logging_directory = True

    def __init__(self, run_name: str, logging_dir: Path) -> None:
        super().__init__()
        self.path = Path(logging_dir) / run_name / "lines.jsonl"

    @property
    def tracker(self) -> Path:
        return self.path

    def _write(self, **line: Any) -> None:
        with self.path.open("a") as file:
            file.write(json.dumps(line) + "\n")

    @on_main_process
    def start(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._write(event="start")

    @on_main_process
    def store_init_configuration(self, values: dict[str, Any]) -> None:
        self._write(event="parameters", values=values)

    @on_main_process
    def log(self, values: dict[str, Any], step: int | None = None, **options: Any) -> None:
        self._write(event="log", step=step, values=values)

    @on_main_process
    def finish(self) -> None:
        self._write(event="finish")


@pytest.fixture
def registered() -> Iterator[str]:
    """The tracker, known to accelerate by its name."""
    register_tracker_class(LineTracker)
    yield NAME
    del LOGGER_TYPE_TO_CLASS[NAME]


def fit(folder: Path, data: Path, steps: int) -> None:
    """Runs, or resumes, as `unirender train --track` does."""
    config = dataclasses.replace(TRAIN, batch_size=2)
    trainer = Trainer(config, RunConfig(folder, steps=steps, log_every=1), torch.device("cpu"), torch.float32)
    source = ShardSource(data, config.batch_size, config.seed)
    with tracking(make_trackers((NAME,), folder), config, resumed=(folder / "state.pt").is_file()) as report:
        trainer.fit(source, report)
    source.close()


def test_every_line_of_the_log_reaches_the_tracker_and_a_resume_goes_on_in_its_run(
    registered: str, tmp_path: Path
) -> None:
    data = write_dataset(tmp_path / "data", size=32)
    for steps in (1, 3):
        fit(tmp_path / "run", data, steps)
    (path,) = (tmp_path / "run" / "trackers").rglob("lines.jsonl")
    told = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["event"] for line in told] == ["start", "parameters", "log", "finish", "start", "log", "log", "finish"]
    assert told[1]["values"]["optimizer.learning_rate"] == TRAIN.optimizer.learning_rate
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    sent = [{"step": line["step"], **line["values"]} for line in told if line["event"] == "log"]
    assert sent == logged
    assert [line["step"] for line in sent] == [1, 2, 3]
    assert all("samples_per_s" in line and "image" in line for line in sent)


def test_only_numbers_are_sent() -> None:
    scored = {"step": 4, "validation": {"albedo.psnr": 20.5}, "validation_s": 1, "best": True, "data": "1 -> 2 shards"}
    assert numbers(scored) == {"step": 4, "validation/albedo.psnr": 20.5, "validation_s": 1}


def test_a_failed_run_finishes_its_trackers(registered: str, tmp_path: Path) -> None:
    trackers = make_trackers((NAME,), tmp_path)

    def fail() -> None:
        with tracking(trackers, TRAIN) as report:
            report({"step": 1, "image": 0.5})
            report({"step": 1, "data": "no number"})
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    (path,) = tmp_path.rglob("lines.jsonl")
    told = [json.loads(line)["event"] for line in path.read_text().splitlines()]
    assert told == ["start", "parameters", "log", "finish"]


class UnreachableTracker(LineTracker):
    """Its service cannot be reached."""

    def start(self) -> None:
        raise ConnectionError("no such host")


def test_trackers_that_were_started_are_finished_where_another_cannot_start(tmp_path: Path) -> None:
    trackers = (LineTracker("one", tmp_path), UnreachableTracker("two", tmp_path), LineTracker("three", tmp_path))
    expected = f"--track {NAME}: cannot be started \\(no such host\\); mend that, or leave it out"
    with pytest.raises(UnirenderError, match=expected), tracking(trackers, TRAIN):
        pytest.fail("the run went on without its tracker")
    told = [json.loads(line)["event"] for line in trackers[0].path.read_text().splitlines()]
    assert told == ["start", "parameters", "finish"]
    assert [path.parent.name for path in tmp_path.rglob("lines.jsonl")] == ["one"]  # the third never began


class LosingTracker(LineTracker):
    """Its service goes away."""

    def log(self, values: dict[str, Any], step: int | None = None, **options: Any) -> None:
        raise ConnectionError("server gone")

    def finish(self) -> None:
        raise ConnectionError


class EndingTracker(LineTracker):
    """Its service goes away at the end."""

    def finish(self) -> None:
        raise ConnectionError


def test_a_tracker_that_fails_on_the_way_ends_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each is told of once, also where one that has failed cannot be finished either."""
    trackers = (LosingTracker("one", tmp_path), LineTracker("two", tmp_path), EndingTracker("three", tmp_path))
    with tracking(trackers, TRAIN) as report:
        for step in (1, 2):
            report({"step": step, "image": 0.5})
    told = [json.loads(line)["event"] for line in trackers[1].path.read_text().splitlines()]
    assert told == ["start", "parameters", "log", "log", "finish"]
    said = capsys.readouterr().err.splitlines()
    assert [line.partition("failed (")[2].partition(")")[0] for line in said] == ["server gone", "ConnectionError"]


def test_unknown_trackers_are_refused_with_those_that_accelerate_knows(registered: str) -> None:
    check_trackers([NAME])
    assert NAME in known_trackers()
    with pytest.raises(UsageError, match=rf"--track tensorbored: no tracker .* expected one of .* tensorboard, {NAME}"):
        check_trackers([NAME, "tensorbored"])
    missing = sorted(set(LOGGER_TYPE_TO_CLASS) - set(known_trackers()))
    assert missing  # nobody has all nine
    with pytest.raises(UsageError, match=f"--track {missing[0]}: not installed here; pip install {missing[0]}$"):
        check_trackers([missing[0]])


def test_a_run_of_wandb_is_found_again_by_its_folder(tmp_path: Path) -> None:
    from unirender.training.logs.trackers import _run_options

    one, same, other = (_run_options("wandb", tmp_path / name) for name in ("a", "a/../a", "b"))
    assert one == same
    assert (one["name"], one["resume"]) == ("a", "allow")
    assert one["id"] != other["id"]


def test_the_command_line_refuses_a_tracker_before_anything_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "run"), "--track", "nonesuch"])
    assert stop.value.code == 2
    assert "--track nonesuch" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert Train(data=tmp_path).check().batch_size  # the twin: none asked for
