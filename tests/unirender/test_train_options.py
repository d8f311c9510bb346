"""The options of `unirender train`, looked at before anything is read."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
from synthetic_shards import write_dataset

from unirender import cli
from unirender.errors import UsageError
from unirender.training.command import Train
from unirender.training.config import RunConfig
from unirender.training.presets import PRESETS
from unirender.training.run import run_config, train
from unirender_reference.folder_lock import locked, made_folder


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rate": math.inf}, "--learning-rate inf: expected a number above 0"),
        ({"minutes": math.nan}, "--minutes nan: expected a number above 0"),
        ({"minutes": math.inf}, "--minutes inf"),
        ({"steps": 0}, "--steps 0"),
        ({"seed": -1}, "--seed -1: expected an integer from 0"),
        ({"seed": 10**23}, "--seed 1000"),
    ],
)
def test_a_value_outside_its_range_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Train(Path("data"), **options).check()


def test_options_count_in_python_as_in_the_command(tmp_path: Path) -> None:
    """Beside a configuration of one's own they were passed over without a word."""
    own = dataclasses.replace(PRESETS["tiny"], batch_size=6, seed=5)
    assert Train(tmp_path).resolved(own) == own
    changed = Train(tmp_path, batch_size=8, learning_rate=1e-4, resolution=128, seed=3).resolved(own)
    found = changed.batch_size, changed.optimizer.learning_rate, changed.model.resolution, changed.seed
    assert found == (8, 1e-4, 128, 3)
    for options, message in (
        (Train(tmp_path, validate=4), "validate 4, .*: nothing scores, expected the argument `validate`"),
        (Train(tmp_path, keep_best="albedo.psnr"), "keep_best albedo.psnr: nothing scores"),
        (Train(tmp_path, resolution=65), "--resolution 65: expected a multiple of 32"),
    ):
        with pytest.raises(UsageError, match=message):
            train(options, own, tmp_path / "run")


def test_every_option_of_a_run_reaches_it(tmp_path: Path) -> None:
    """Each with another value than its default."""
    given: dict[str, Any] = {"steps": 7, "minutes": 2.0, "log_every": 3, "save_minutes": 4.0, "refresh_minutes": 5.0}
    given |= {"accumulate": 6, "keep_best": "albedo.psnr"}
    options = Train(tmp_path, **given, validate=2, validate_suite="a/other.toml")
    found = run_config(options, PRESETS["tiny"], tmp_path / "run", 8)
    scored = "2 scenes of the suite other"
    assert found == RunConfig(tmp_path / "run", **given, parallel=8, preset="tiny", scored_on=scored)
    unlimited = run_config(Train(tmp_path), PRESETS["tiny"], tmp_path, 1)
    assert unlimited == RunConfig(tmp_path, steps=PRESETS["tiny"].steps, preset="tiny")


@pytest.mark.parametrize(("command", "result"), [("train", "pipeline"), ("train-visibility", "visibility.safetensors")])
def test_a_result_without_its_state_is_not_replaced(
    command: str, result: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The state is the largest file of a run that is over, and the first to be deleted."""
    run = tmp_path / "run"
    (run / result).mkdir(parents=True)
    (run / "log.jsonl").write_text('{"step": 20000}\n')
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "--data", str(tmp_path), "--out", str(run), "--steps", "1"])
    assert stopped.value.code == 1
    assert "of a run and no state to go on from" in capsys.readouterr().err
    assert (run / "log.jsonl").read_text() == '{"step": 20000}\n'


@pytest.mark.parametrize("command", ["train", "train-visibility"])
def test_a_second_run_in_one_folder_is_refused(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset(tmp_path / "data", size=64, shards=1, groups=1)
    with made_folder(tmp_path / "run"), locked(tmp_path / "run"), pytest.raises(SystemExit) as stopped:
        cli.main([command, "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run"), "--steps", "1"])
    assert stopped.value.code == 1
    assert "run: another run is writing here; wait for it, or choose another --out" in capsys.readouterr().err
