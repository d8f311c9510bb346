"""How sure a checkpoint is of materials: the line, what reads by it, and the command that fits it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic_shards import write_dataset
from tiny_models import SIZE, make_pipeline

from unirender.errors import UnirenderError, UsageError
from unirender.pipelines.results import MaterialRule, check_calibration
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import checkpoint_folder
from unirender.training.calibrate import Calibrate, Line, fit, readings, write_calibrated
from unirender.training.data import GroupDataset


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoint")
    make_pipeline().save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("groups") / "data", size=SIZE, shards=2, groups=5, roughness=(80, 95))


def picture() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    mask = ((x - SIZE / 2) ** 2 + (y - SIZE / 2) ** 2 < (0.45 * SIZE) ** 2)[..., None].astype(np.float32)
    return (mask * np.array([0.7, 0.5, 0.3], np.float32) * (0.5 + 0.5 * x[..., None] / SIZE)).astype(np.float32), mask


def test_who_is_too_sure_gets_a_slope_below_one() -> None:
    rng = np.random.default_rng(0)
    objects, truth = np.arange(400) // 4, rng.uniform(0.3, 0.7, 400)
    found = np.clip(0.5 + 2 * (truth - 0.5) + rng.normal(0, 0.02, 400), 0, 1)
    line = fit(objects, found, truth)
    assert line.slope == pytest.approx(0.5, abs=0.02)
    assert line.offset == pytest.approx(0.25, abs=0.02)
    assert line.before == pytest.approx(np.square(found - truth).mean())
    assert line.after < 0.05 * line.before
    right = fit(objects, truth, truth)
    assert (right.slope, right.offset) == pytest.approx((1, 0), abs=1e-9)


def test_a_line_is_scored_on_objects_that_it_does_not_know() -> None:
    """Where nothing can be learned, it is no better than what was predicted; with its own objects it would be."""
    rng = np.random.default_rng(1)
    objects = np.arange(20)
    found, truth = rng.uniform(0.4, 0.6, 20), rng.uniform(0.4, 0.6, 20)
    truth += found.mean() - truth.mean()
    line = fit(objects, found, truth)
    own = np.square(np.clip(line.slope * found + line.offset, 0, 1) - truth).mean()
    assert own < line.after
    assert fit(objects, np.full(20, 0.5), truth).slope == 0
    assert fit(objects, found, 1 - found).slope == 0  # more is never read as less


@pytest.mark.parametrize("kind", ["scalar", "map"])
def test_predictions_are_read_by_the_lines(kind: str) -> None:
    mask = np.ones((2, 2, 1), np.float32)
    mask[0, 0] = 0
    value = np.array([[0.9, 0.2], [0.4, 1.6]], np.float32)[..., None]
    plain, lined = MaterialRule(kind), MaterialRule(kind, {"roughness": [0.5, 0.3]})
    np.testing.assert_array_equal(lined.read("metallic", value, mask), plain.read("metallic", value, mask))
    expected = 0.5 * plain.read("roughness", value, mask) + 0.3
    expected[0, 0] = 0
    np.testing.assert_allclose(lined.read("roughness", value, mask), expected, rtol=1e-6)
    steep = MaterialRule(kind, {"roughness": [9, -1]})
    assert 0 <= steep.read("roughness", value, mask).min() <= steep.read("roughness", value, mask).max() <= 1


def test_a_pipeline_decomposes_by_its_calibration(checkpoint: Path, tmp_path: Path) -> None:
    image, mask = picture()
    before = UniRenderPipeline.from_pretrained(checkpoint).decompose(image, mask)
    write_calibrated(checkpoint, tmp_path / "lined", {"roughness": Line(0.5, 0.2, 0.1, 0.05, 0.01)}, {})
    pipeline = UniRenderPipeline.from_pretrained(tmp_path / "lined")
    after = pipeline.decompose(image, mask)
    assert after.roughness == pytest.approx(0.5 * before.roughness + 0.2, abs=1e-5)
    assert after.metallic == pytest.approx(before.metallic, abs=1e-6)
    pipeline.save_pretrained(tmp_path / "again")
    again = UniRenderPipeline.from_pretrained(tmp_path / "again")
    assert again.decompose(image, mask).roughness == pytest.approx(after.roughness, abs=1e-6)
    plain = UniRenderPipeline.from_pretrained(tmp_path / "lined", calibration=None)
    assert plain.decompose(image, mask).roughness == pytest.approx(before.roughness, abs=1e-6)


@pytest.mark.parametrize(
    "lines", [{"albedo": [1, 0]}, {"roughness": [1]}, {"metallic": [-1, 0]}, {"roughness": [1, np.nan]}]
)
def test_other_lines_are_refused(lines: dict) -> None:
    with pytest.raises(UnirenderError, match="calibration: got"):
        check_calibration(lines)


def test_the_command_writes_a_copy(data: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """An untrained network says the same of all, and these are rough: their mean is better."""
    out = tmp_path / "calibrated"
    assert Calibrate(data, out, checkpoint, pictures=2).run() == 0
    said = capsys.readouterr().out
    assert "decomposed 20 of 20 pictures" in said
    lines = json.loads((out / "model_index.json").read_text())["calibration"]
    assert "roughness" in lines
    weights = "dual_stream/diffusion_pytorch_model.safetensors"
    assert (out / weights).read_bytes() == (checkpoint / weights).read_bytes()
    pipeline = UniRenderPipeline.from_pretrained(checkpoint)
    objects, found, truth = readings(pipeline, GroupDataset(data), 2, 0)
    assert sorted(set(objects)) == list(range(10))
    assert set(np.round(truth[:, 0], 2)) == {0.8, 0.95}
    line = fit(objects, found[:, 0], truth[:, 0])
    assert isinstance(line, Line)
    assert f"roughness: {line.slope:.3f} x predicted + {line.offset:.3f}" in said
    np.testing.assert_allclose(lines["roughness"], [line.slope, line.offset], atol=1e-4)


def test_wrong_calls_are_refused(data: Path, checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--pictures 0"):
        Calibrate(data, tmp_path / "out", checkpoint, pictures=0).run()
    with pytest.raises(UnirenderError, match="exists, expected a new folder"):
        Calibrate(data, tmp_path, checkpoint).run()
    few = write_dataset(tmp_path / "few", size=SIZE, shards=1, groups=2)
    with pytest.raises(UnirenderError, match="got 2 objects, expected 10 or more"):
        Calibrate(few, tmp_path / "out", checkpoint).run()
    assert not (tmp_path / "out").exists()


def test_what_ships_has_lines_that_a_pipeline_takes() -> None:
    pipeline = UniRenderPipeline.from_pretrained(checkpoint_folder("small"))
    assert check_calibration(pipeline.config["calibration"]) == pipeline.config["calibration"]


def test_the_account_of_a_training_tells_of_it(checkpoint: Path, tmp_path: Path) -> None:
    shutil.copytree(checkpoint, tmp_path / "trained")
    (tmp_path / "trained" / "training.json").write_text(json.dumps({"preset": "tiny", "steps": 5}))
    data = {"folder": "new", "fingerprint": "ab" * 32, "shards": 2, "groups": 10, "pairs": 60}
    about = {"data": data, "pictures": 3, "seed": 0}
    line = Line(0.75, 0.125, 0.0526, 0.05, 0.0012)
    write_calibrated(tmp_path / "trained", tmp_path / "mine", {"roughness": line}, about)
    facts = json.loads((tmp_path / "mine" / "training.json").read_text())
    assert (facts["preset"], facts["calibration"]["lines"]["roughness"]["slope"]) == ("tiny", 0.75)
    card = (tmp_path / "mine" / "README.md").read_text()
    assert "# unirender: mine" in card
    assert "roughness: 0.750 x predicted + 0.125, mean squared error 0.0526 → 0.0500 ± 0.0012" in card
    assert "3 pictures of each object of `new`: 2 shards, 10 groups" in card
    write_calibrated(tmp_path / "mine", tmp_path / "none", {}, about)
    assert json.loads((tmp_path / "none" / "model_index.json").read_text())["calibration"] is None
    assert "calibration" not in json.loads((tmp_path / "none" / "training.json").read_text())
    assert "are read by" not in (tmp_path / "none" / "README.md").read_text()
