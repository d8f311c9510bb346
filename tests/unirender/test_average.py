"""The mean of checkpoints: its weights, what it says of itself, and what cannot be averaged."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tiny_models import MODEL, make_pipeline
from tiny_stable_diffusion import tiny_vae

from unirender.diffusion.schedule import make_scheduler
from unirender.errors import UnirenderError, UsageError
from unirender.models.build import build_model
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import checkpoint_sha256
from unirender.training.after.average import Average, averaged_facts
from unirender.training.loop.card import CARD_FILE
from unirender.training.loop.export import TRAINING_FILE, read_history

WEIGHTS = "dual_stream/diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two networks of one kind; the second one's run began with the first."""
    root = tmp_path_factory.mktemp("checkpoints")
    first: dict = {"preset": "one", "steps": 2, "samples": 8, "minutes": 1.0, "train": {"seed": 0}}
    second: dict = {**first, "preset": "two", "losses": {"step": 2}, "scores": {"albedo.psnr": 1.0}}
    second |= {"scored_on": "4 scenes", "calibration": {"lines": {}}}
    for seed, (name, facts) in enumerate({"one": first, "two": {**second, "continues": [first]}}.items()):
        make_pipeline(seed).save_pretrained(root / name)
        (root / name / TRAINING_FILE).write_text(json.dumps(facts))
    return root / "one", root / "two"


@pytest.mark.parametrize(("shares", "second"), [((), 0.5), ((1.0, 3.0), 0.75)])
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
    assert label == f"one {checkpoint_sha256(checkpoints[0])[:12]}"
    assert facts["averaged"] == {label: 0.5, "this run": 0.5}
    assert facts["preset"] == "two"
    assert facts["stored_as"] == "float16"
    assert not {"losses", "scores", "scored_on", "calibration"} & facts.keys()  # those of the run alone
    assert [run["preset"] for run in read_history(out)] == ["one", "two"]
    assert f"| weights averaged | 0.5 of {label}, 0.5 of this run |" in (out / CARD_FILE).read_text()
    assert [path.name for path in out.parent.iterdir()] == ["mean"]
    for path in out.rglob("*.json"):
        assert str(checkpoints[0].parent) not in path.read_text(), path  # folders of this machine


def test_an_average_of_averages_is_multiplied_out() -> None:
    old, run = {"preset": "old", "steps": 1}, {"preset": "run", "steps": 2, "losses": {"step": 2}}
    mean = averaged_facts([[old], [old, run]], ["a", "b"], [0.25, 0.75])
    assert mean == {"preset": "run", "steps": 2, "averaged": {"a": 0.25, "this run": 0.75}, "continues": [old]}
    runs = [*mean.pop("continues"), mean]
    again = averaged_facts([[old], runs], ["a", "c"], [0.5, 0.5])
    assert again["averaged"] == {"a": 0.5 + 0.5 * 0.25, "this run": 0.5 * 0.75}
    assert again["continues"] == [old]
    turned = averaged_facts([runs, [old]], ["c", "a"], [0.5, 0.5])
    assert turned["averaged"] == {"c": 0.5, "this run": 0.5}
    assert [fact["preset"] for fact in turned["continues"]] == ["run"]
    assert averaged_facts([[old], []], ["a", "b"], [0.5, 0.5]) == {"averaged": {"a": 0.5, "b": 0.5}, "continues": [old]}


def test_a_run_is_listed_once_whatever_became_of_its_weights() -> None:
    """A run goes on from the mean of another with what that began with; then all three are averaged."""
    old, first = {"preset": "old", "steps": 1}, {"preset": "first", "steps": 2, "losses": {"step": 2}}
    began = averaged_facts([[old], [old, first]], ["old", "first"], [0.5, 0.5])
    second = {"preset": "second", "steps": 3}
    runs = [*began.pop("continues"), began, second]
    histories = [[old], [old, first], runs]
    mean = averaged_facts(histories, ["old", "first", "second"], [0.25, 0.25, 0.5])
    assert mean["continues"] == [old, first]  # with its losses, which the mean of it has not
    turned = averaged_facts([runs, [old, first], [old]], ["second", "first", "old"], [0.25, 0.25, 0.5])
    assert turned["continues"] == [first, second]
    assert averaged_facts([[old, began], [old, first]], ["began", "first"], [0.5, 0.5])["continues"] == [old]
    lined = {**first, "calibration": {"lines": {}}, "stored_as": "float16"}
    assert len(averaged_facts([[old, lined], runs], ["lined", "second"], [0.5, 0.5])["continues"]) == 2
    assert len(averaged_facts([[first], [{**first, "steps": 9}]], ["a", "b"], [0.5, 0.5])["continues"]) == 1  # the twin


def test_a_checkpoint_that_is_given_twice_counts_twice(checkpoints: tuple[Path, Path], tmp_path: Path) -> None:
    Average((checkpoints[0], checkpoints[0], checkpoints[1]), tmp_path / "out").run()
    shares = json.loads((tmp_path / "out" / TRAINING_FILE).read_text())["averaged"]
    assert shares == pytest.approx({next(iter(shares)): 2 / 3, "this run": 1 / 3})


def test_a_run_gives_its_name(checkpoints: tuple[Path, Path], tmp_path: Path) -> None:
    """All of them leave a folder `pipeline`."""
    shutil.copytree(checkpoints[0], tmp_path / "sunday" / "pipeline")
    Average((tmp_path / "sunday" / "pipeline", checkpoints[1]), tmp_path / "out").run()
    label, _ = json.loads((tmp_path / "out" / TRAINING_FILE).read_text())["averaged"]
    assert label.startswith("sunday ")


def test_a_network_for_each_direction(tmp_path: Path) -> None:
    for seed in (0, 1):
        make_pipeline(seed, unified=False).save_pretrained(tmp_path / str(seed))
    Average((tmp_path / "0", tmp_path / "1"), tmp_path / "out", store="float32").run()
    one, two, mean = (load_file(tmp_path / name / WEIGHTS) for name in ("0", "1", "out"))
    for name in one:
        torch.testing.assert_close(mean[name], 0.5 * (one[name] + two[name]))
    make_pipeline().save_pretrained(tmp_path / "unified")
    with pytest.raises(UnirenderError, match="only checkpoints of one network can be averaged"):
        Average((tmp_path / "0", tmp_path / "unified"), tmp_path / "none").run()


def test_an_autoencoder_stays_as_it_is(tmp_path: Path) -> None:
    """In float32, so that an average can be averaged with what it is made of."""
    vae = tiny_vae()

    def write(seed: int, name: str) -> None:
        torch.manual_seed(seed)
        model, _ = build_model(dataclasses.replace(MODEL, codec="kl", physics_prior="none"), vae)
        UniRenderPipeline(model, make_scheduler(), vae).save_pretrained(tmp_path / name)

    write(0, "one")
    write(1, "two")
    Average((tmp_path / "one", tmp_path / "two"), tmp_path / "mean").run()
    Average((tmp_path / "one", tmp_path / "mean"), tmp_path / "again").run()
    stored = load_file(tmp_path / "again" / "vae" / "diffusion_pytorch_model.safetensors")
    assert all(value.equal(vae.state_dict()[name]) for name, value in stored.items())
    assert {value.dtype for value in load_file(tmp_path / "again" / WEIGHTS).values()} == {torch.float16}
    card = (tmp_path / "again" / CARD_FILE).read_text()
    assert "license:" not in card  # weights of other people
    assert "the licence of those weights applies" in card
    with torch.no_grad():
        next(vae.parameters()).add_(1e-3)
    write(0, "other")
    with pytest.raises(UnirenderError, match="other: its autoencoder is not that of"):
        Average((tmp_path / "one", tmp_path / "other"), tmp_path / "none").run()


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
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wide"]


def test_an_average_has_maps_of_materials_if_one_of_its_parts_has(
    checkpoints: tuple[Path, Path], tmp_path: Path
) -> None:
    UniRenderPipeline.from_pretrained(checkpoints[0], material="map").save_pretrained(tmp_path / "map")
    for out, parts in {"one": (tmp_path / "map", checkpoints[1]), "two": (checkpoints[1], tmp_path / "map")}.items():
        Average(parts, tmp_path / out).run()
        assert UniRenderPipeline.from_pretrained(tmp_path / out).config["material"] == "map"


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
        (1, (), "got 1 checkpoint, expected two or more"),
        (2, (1.0,), "--shares: got 1, expected 2"),
        (2, (1.0, 0.0), "expected finite numbers above 0"),
        (2, (1.0, -1.0), "expected finite numbers above 0"),
        (2, (1.0, float("nan")), "expected finite numbers above 0"),
        (2, (1e308, 1e308), "expected finite numbers above 0"),
    ],
)
def test_wrong_calls_are_refused(
    checkpoints: tuple[Path, Path], tmp_path: Path, count: int, shares: tuple[float, ...], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        Average(checkpoints[:count], tmp_path / "out", shares).run()
    assert not (tmp_path / "out").exists()


def test_folders_that_are_no_use_are_refused(checkpoints: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=r"exists and is not empty, .* choose another --out"):
        Average(checkpoints, checkpoints[0]).run()
    with pytest.raises(UnirenderError, match=r"none: no pipeline folder"):
        Average((checkpoints[0], tmp_path / "none"), tmp_path / "out").run()
    before = checkpoint_sha256(checkpoints[1])
    with pytest.raises(UnirenderError, match=r"lies in .*two, which would then be another checkpoint"):
        Average(checkpoints, checkpoints[1] / "mean").run()
    assert checkpoint_sha256(checkpoints[1]) == before
    shutil.copytree(checkpoints[1], tmp_path / "cut")
    weights = (tmp_path / "cut" / WEIGHTS).read_bytes()
    (tmp_path / "cut" / WEIGHTS).write_bytes(weights[: len(weights) // 2])
    with pytest.raises(UnirenderError, match=r"cut: cannot be read as a checkpoint"):
        Average((checkpoints[0], tmp_path / "cut"), tmp_path / "out").run()
    assert [path.name for path in tmp_path.iterdir()] == ["cut"]
