"""The mean of checkpoints: its weights, what it says of itself, and what cannot be averaged."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tiny_models import make_pipeline

from unirender.errors import UnirenderError, UsageError
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.average import Average, averaged_facts
from unirender.training.card import CARD_FILE
from unirender.training.export import TRAINING_FILE, read_history

WEIGHTS = "dual_stream/diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two networks of one kind; the second one's run began with the first."""
    root = tmp_path_factory.mktemp("checkpoints")
    first: dict = {"preset": "one", "steps": 2, "samples": 8, "minutes": 1.0, "train": {"seed": 0}}
    second: dict = {**first, "preset": "two", "losses": {"step": 2}, "scores": {"albedo.psnr": 1.0}}
    for seed, (name, facts) in enumerate({"one": first, "two": {**second, "continues": [first]}}.items()):
        make_pipeline(seed).save_pretrained(root / name)
        (root / name / TRAINING_FILE).write_text(json.dumps(facts))
    return root / "one", root / "two"


@pytest.mark.parametrize(("shares", "second"), [((), 0.5), ((1.0, 3.0), 0.75), ((0.9, 0.1), 0.1)])
def test_every_weight_is_the_mean(
    checkpoints: tuple[Path, Path], tmp_path: Path, shares: tuple[float, ...], second: float
) -> None:
    assert Average(checkpoints, tmp_path / "out", shares, store="float32").run() == 0
    one, two, mean = (load_file(folder / WEIGHTS) for folder in (*checkpoints, tmp_path / "out"))
    assert one.keys() == two.keys() == mean.keys()
    for name in one:
        torch.testing.assert_close(mean[name], (1 - second) * one[name] + second * two[name], rtol=1e-6, atol=1e-7)
    assert any(not one[name].equal(two[name]) for name in one)
    loaded = UniRenderPipeline.from_pretrained(tmp_path / "out").dual_stream.state_dict()
    assert all(loaded[name].equal(mean[name]) for name in mean)


def test_what_is_stored(checkpoints: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "new" / "mean"
    Average(checkpoints, out).run()
    assert f"{out}: 0.5 of {checkpoints[0]}, 0.5 of {checkpoints[1]}" in capsys.readouterr().out
    assert {value.dtype for value in load_file(out / WEIGHTS).values()} == {torch.float16}
    facts = json.loads((out / TRAINING_FILE).read_text())
    (label,) = set(facts["averaged"]) - {"this run"}
    assert label.startswith("one (")
    assert facts["averaged"] == {label: 0.5, "this run": 0.5}
    assert facts["preset"] == "two"
    assert facts["stored_as"] == "float16"
    assert not {"losses", "scores"} & facts.keys()  # those of the run alone
    assert [run["preset"] for run in read_history(out)] == ["one", "two"]
    assert f"| weights averaged | 0.5 of {label}, 0.5 of this run |" in (out / CARD_FILE).read_text()
    assert [path.name for path in out.parent.iterdir()] == ["mean"]
    for path in out.rglob("*.json"):
        assert str(checkpoints[0].parent) not in path.read_text(), path  # folders of this machine


def test_an_average_of_averages_is_multiplied_out() -> None:
    old, run = {"preset": "old", "steps": 1}, {"preset": "run", "steps": 2}
    mean = averaged_facts([[old], [old, run]], ["a", "b"], [0.25, 0.75])
    assert mean == {**run, "averaged": {"a": 0.25, "this run": 0.75}, "continues": [old]}
    runs = [*mean.pop("continues"), mean]
    again = averaged_facts([[old], runs], ["a", "c"], [0.5, 0.5])
    assert again["averaged"] == {"a": 0.5 + 0.5 * 0.25, "this run": 0.5 * 0.75}
    assert again["continues"] == [old]
    turned = averaged_facts([runs, [old]], ["c", "a"], [0.5, 0.5])
    assert turned["averaged"] == {"c": 0.5, "this run": 0.5}
    assert [fact["preset"] for fact in turned["continues"]] == ["run"]
    assert averaged_facts([[old], []], ["a", "b"], [0.5, 0.5]) == {"averaged": {"a": 0.5, "b": 0.5}, "continues": [old]}


def test_lines_of_a_calibration_are_left_behind(
    checkpoints: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    pipeline = UniRenderPipeline.from_pretrained(checkpoints[0], calibration={"roughness": [0.5, 0.2]})
    pipeline.save_pretrained(tmp_path / "lined")
    Average((checkpoints[1], tmp_path / "lined"), tmp_path / "out").run()
    assert f"{tmp_path / 'lined'}: its calibration is that of its own weights" in capsys.readouterr().err
    assert UniRenderPipeline.from_pretrained(tmp_path / "out").config["calibration"] is None


def test_other_networks_are_refused(checkpoints: tuple[Path, Path], tmp_path: Path) -> None:
    make_pipeline(2, block_out_channels=(16, 48)).save_pretrained(tmp_path / "wide")
    with pytest.raises(UnirenderError, match=r"wide: dual_stream.block_out_channels is \[16, 48\], expected"):
        Average((checkpoints[0], tmp_path / "wide"), tmp_path / "out").run()
    UniRenderPipeline.from_pretrained(checkpoints[0], material="map").save_pretrained(tmp_path / "map")
    with pytest.raises(UnirenderError, match=r"map: material is 'map', expected 'scalar', that of"):
        Average((checkpoints[0], tmp_path / "map"), tmp_path / "out").run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map", "wide"]


def test_schedules_may_differ_by_rounding_only(checkpoints: tuple[Path, Path], tmp_path: Path) -> None:
    """That of a checkpoint trained by another version of PyTorch does."""
    for factor, name in ((1 + 1e-8, "rounded"), (1.01, "other")):
        shutil.copytree(checkpoints[1], tmp_path / name)
        file = tmp_path / name / "scheduler" / "scheduler_config.json"
        config = json.loads(file.read_text())
        config["trained_betas"][1] *= factor
        file.write_text(json.dumps(config))
    Average((checkpoints[0], tmp_path / "rounded"), tmp_path / "out").run()
    with pytest.raises(UnirenderError, match=r"other: scheduler.trained_betas is .{,200}, expected") as refusal:
        Average((checkpoints[0], tmp_path / "other"), tmp_path / "none").run()
    assert len(str(refusal.value)) < 600  # not all thousand of them


@pytest.mark.parametrize(
    ("count", "shares", "said"),
    [
        (1, (), "got 1 checkpoints, expected two or more"),
        (2, (1.0,), "--shares: got 1, expected 2"),
        (2, (1.0, 0.0), "expected numbers above 0"),
        (2, (1.0, -1.0), "expected numbers above 0"),
        (2, (1.0, float("nan")), "expected numbers above 0"),
    ],
)
def test_wrong_calls_are_refused(
    checkpoints: tuple[Path, Path], tmp_path: Path, count: int, shares: tuple[float, ...], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        Average(checkpoints[:count], tmp_path / "out", shares).run()
    with pytest.raises(UnirenderError, match=r"exists and is not empty, .* choose another --out"):
        Average(checkpoints, checkpoints[0]).run()
    with pytest.raises(UnirenderError, match=r"none: no pipeline folder"):
        Average((checkpoints[0], tmp_path / "none"), tmp_path / "out").run()
    assert not (tmp_path / "out").exists()
