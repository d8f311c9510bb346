"""How sure a checkpoint is of materials: the line, what reads by it, and the command that fits it."""

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import diffusers
import numpy as np
import pytest
import torch
from synthetic_shards import group_members, write_dataset, write_shard
from tiny_models import MODEL, SIZE, TRAIN, make_pipeline

from unirender.color import image_srgb
from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender.pipelines.calibration import calibrated, check_lines
from unirender.pipelines.masked_maps import masked_mean
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import checkpoint_folder
from unirender.training.after.calibrate import Calibrate, readings, write_calibrated
from unirender.training.after.calibration_line import Line, fit
from unirender.training.augmentations.augment import Draw
from unirender.training.config import RunConfig
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.packing import Pair
from unirender.training.data.same_objects import object_of, objects_of
from unirender.training.loop.facts import dataset_facts
from unirender.training.loop.trainer import Trainer
from unirender.training.start.weights import read_start


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoint")
    make_pipeline().save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rough objects: an untrained network says about 0.5 of all."""
    return write_dataset(
        tmp_path_factory.mktemp("groups") / "data",
        size=SIZE,
        shards=2,
        groups=5,
        roughness=(80, 95),
        metallic=(0, 50, 100),
    )


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
    assert line.better
    right = fit(objects, truth, truth)
    assert (right.slope, right.offset) == pytest.approx((1, 0), abs=1e-9)
    assert not right.better


def test_a_line_is_scored_on_objects_that_it_does_not_know() -> None:
    """Where there is nothing to learn it is no better than what was predicted; at its own objects it would be."""
    rng = np.random.default_rng(1)
    objects = np.arange(20)
    found, truth = rng.uniform(0.4, 0.6, 20), rng.uniform(0.4, 0.6, 20)
    truth += found.mean() - truth.mean()
    line = fit(objects, found, truth)
    own = np.square(np.clip(line.slope * found + line.offset, 0, 1) - truth).mean()
    assert own < line.after
    assert fit(objects, 0.5 + 1e-6 * found, truth).slope == 0  # one number, in effect
    assert fit(objects, found, 1 - found).slope == 0  # more is never read as less


def test_a_line_is_kept_where_it_gains_more_than_chance() -> None:
    """By the paired 95 % interval: of a line without errors that of the squared errors before, over objects."""
    found = np.linspace(0.1, 0.9, 30)
    line = fit(np.arange(30), found, 0.25 + 0.5 * found)
    squares = np.square(0.25 - 0.5 * found)
    assert line.after == pytest.approx(0, abs=1e-12)
    assert line.before == pytest.approx(squares.mean())
    assert line.chance == pytest.approx(1.96 * np.std(squares) / math.sqrt(30), rel=1e-6)
    for before, better in ((0.052, True), (0.050, False), (0.048, False)):
        assert Line(0.5, 0.2, before, 0.049, chance=0.002).better == better, before


def test_a_line_is_scored_by_values_in_their_range() -> None:
    """As a pipeline reads by it: a line that is steep, for 0.4 and 0.6 are 0 and 1, says no more than 1 of 0.8."""
    found, truth = np.tile([0.4, 0.6], 15), np.tile([0.0, 1.0], 15)
    line = fit(np.arange(31), np.append(found, 0.8), np.append(truth, 1.0))
    assert line.slope > 4
    assert 31 * line.after < 0.5  # of 0.8 alone, it would be (5 x 0.8 - 2 - 1)^2 = 1


def test_few_but_different_answers_have_a_slope() -> None:
    found = 0.5 + 0.02 * np.tile([-1.0, 1.0], 15)  # twice the spread below which they are one number
    assert fit(np.arange(30), found, 0.5 + 3 * (found - 0.5)).slope == pytest.approx(3)


def test_every_object_counts_the_same() -> None:
    """However many pictures there are of it, and whatever its number is."""
    rng = np.random.default_rng(2)
    objects = np.arange(30)
    found, truth = rng.uniform(0, 1, 30), rng.uniform(0, 1, 30)
    once = fit(objects, found, truth)
    times = rng.integers(1, 6, 30)
    often = fit(np.repeat(objects, times), np.repeat(found, times), np.repeat(truth, times))
    for name in ("slope", "offset", "before", "after", "chance"):
        assert getattr(often, name) == pytest.approx(getattr(once, name), rel=1e-9), name
    assert fit(5 * objects, found, truth).after == pytest.approx(once.after, rel=1e-9)
    assert [object_of(key) for key in ("train-5_g0", "a_g1_g12", "_g3")] == ["train-5", "a_g1", "_g3"]
    assert [object_of(key) for key in ("plain", "mug_green")] == ["plain", "mug_green"]  # no number of a group


def test_a_prediction_is_moved_as_a_whole() -> None:
    """To where the line has its mean; pixels and samples keep their distances, and metallic its value."""
    mask = np.ones((2, 2, 1), np.float32)
    mask[0, 0] = 0
    value = np.array([[0.0, 0.5], [0.6, 0.7]], np.float32)[..., None]
    one = Intrinsics(roughness=value, metallic=value, mask=mask)
    two = one.replace(roughness=value * 0.5)
    (alone,) = calibrated([one], {"roughness": [0.5, 0.1]})
    assert masked_mean(alone.require("roughness")["roughness"], mask) == pytest.approx(0.5 * 0.6 + 0.1, abs=1e-6)
    first, second = (own.require("roughness")["roughness"] for own in calibrated([one, two], {"roughness": [0.5, 0.1]}))
    step = 0.5 * 0.45 + 0.1 - 0.45
    inside = mask > 0
    np.testing.assert_allclose(first[inside], value[inside] + step, atol=1e-6)
    np.testing.assert_allclose(second[inside], 0.5 * value[inside] + step, atol=1e-6)
    assert first[0, 0] == second[0, 0] == 0
    np.testing.assert_array_equal(alone.require("metallic")["metallic"], value)
    (steep,) = calibrated([one], {"roughness": [9, -1]})
    full = steep.require("roughness")["roughness"]
    np.testing.assert_allclose(full[inside], np.minimum(value[inside] + (1 - 0.6), 1), atol=1e-6)
    assert calibrated([one, two], None) == [one, two]


def test_a_pipeline_decomposes_by_its_calibration(checkpoint: Path, tmp_path: Path) -> None:
    image, mask = picture()
    many = {"mode": "sample", "num_inference_steps": 2, "num_samples": 3}
    plain = UniRenderPipeline.from_pretrained(checkpoint)
    before, spread = plain.decompose(image, mask), plain.decompose(image, mask, **_seeded(many))
    (tmp_path / "lined").mkdir()
    write_calibrated(checkpoint, tmp_path / "lined", "lined", {"roughness": Line(0.5, 0.2, 0.1, 0.05, 0.01)}, {})
    pipeline = UniRenderPipeline.from_pretrained(tmp_path / "lined")
    after = pipeline.decompose(image, mask)
    assert after.roughness == pytest.approx(0.5 * before.roughness + 0.2, abs=1e-5)
    assert after.metallic == pytest.approx(before.metallic, abs=1e-6)
    maps = [own.decompose(image, mask, material="map", closed=False) for own in (plain, pipeline)]
    assert maps[1].roughness == pytest.approx(0.5 * maps[0].roughness + 0.2, abs=1e-3)  # but for what is clipped
    moved = pipeline.decompose(image, mask, **_seeded(many))
    assert moved.std is not None
    assert spread.std is not None
    np.testing.assert_allclose(moved.std["roughness"], spread.std["roughness"], atol=1e-6)
    assert moved.roughness == pytest.approx(0.5 * spread.roughness + 0.2, abs=1e-5)
    pipeline.save_pretrained(tmp_path / "again")
    again = UniRenderPipeline.from_pretrained(tmp_path / "again")
    assert again.decompose(image, mask).roughness == pytest.approx(after.roughness, abs=1e-6)
    without = UniRenderPipeline.from_pretrained(tmp_path / "lined", calibration=None)
    assert without.decompose(image, mask).roughness == pytest.approx(before.roughness, abs=1e-6)


def _seeded(options: dict) -> dict:
    import torch

    return options | {"generator": torch.Generator().manual_seed(0)}


@pytest.mark.parametrize(
    "lines",
    [
        {"albedo": [1, 0]},
        {"roughness": [1]},
        {"metallic": [-1, 0]},
        {"roughness": [1, np.nan]},
        {"roughness": 0.8},
        {"roughness": ["a", 1]},
        [0.8, 0.1],
        {},
    ],
)
def test_other_lines_are_refused(lines: object) -> None:
    with pytest.raises(UnirenderError, match=r"calibration: got .* mend it in model_index.json"):
        check_lines(lines)


def test_the_command_writes_a_copy(data: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """An untrained network says the same of all, and these are rough: their mean is better."""
    for name in ("calibrated.old", "calibrated.partial"):  # somebody's own
        (tmp_path / "new" / name).mkdir(parents=True)
        (tmp_path / "new" / name / "precious").touch()
    out = tmp_path / "new" / "calibrated"
    assert Calibrate(data, out, checkpoint, pictures=2).run() == 0
    said, noticed = capsys.readouterr()
    assert f"{checkpoint}: does not say what it was trained on; make sure that {data} has other objects" in noticed
    assert "decomposed pictures of 10 of 10 groups" in said
    assert sorted(path.name for path in out.parent.iterdir()) == ["calibrated", "calibrated.old", "calibrated.partial"]
    assert all((out.parent / name / "precious").exists() for name in ("calibrated.old", "calibrated.partial"))
    lines = json.loads((out / "model_index.json").read_text())["calibration"]
    weights = "dual_stream/diffusion_pytorch_model.safetensors"
    assert (out / weights).read_bytes() == (checkpoint / weights).read_bytes()
    pipeline = UniRenderPipeline.from_pretrained(checkpoint)
    groups, found, truth = readings(pipeline, GroupDataset(data), 2, 0)
    assert [int(np.sum(groups == i)) for i in range(10)] == [2] * 10
    assert set(np.round(truth[:, 0], 2)) == {0.8, 0.95}
    line = fit(groups, found[:, 0], truth[:, 0])
    assert f"roughness: {line}" in said
    np.testing.assert_allclose(lines["roughness"], [line.slope, line.offset], atol=1e-4)


def test_as_many_pictures_of_groups_of_any_kind(tmp_path: Path, checkpoint: Path) -> None:
    """A group that is no basis has as many items as pictures; of one object there may be several groups."""
    keys = ["a_g0", "a_g1", "b_g0"]
    groups = {key: group_members("independent", SIZE, 2, (40, 70), (20,), i) for i, key in enumerate(keys)}
    write_shard(tmp_path / "shard-000000.tar", groups)
    data = GroupDataset(tmp_path)
    assert len(data) > len(keys)
    groups, found, truth = readings(UniRenderPipeline.from_pretrained(checkpoint), data, 2, 0)
    assert groups.tolist() == [0, 0, 1, 1, 2, 2]
    assert objects_of(data)[0].tolist() == [0, 0, 1]
    assert found.shape == truth.shape == (6, 2)
    np.testing.assert_allclose(truth[:, 1], 0.2, atol=1e-3)


def test_what_is_read_are_upright_pictures_of_natural_colours_as_they_are_shown(
    data: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither turned nor with exchanged channels, and divided by coverage: an edge is no darker than the object."""
    dataset, pipeline = GroupDataset(data), UniRenderPipeline.from_pretrained(checkpoint)
    drawn, seen = [], []
    augmented, decompose = GroupDataset.augmented, UniRenderPipeline.decompose_batch

    def half_covered(self: GroupDataset, group: int, pair: Pair | None, draw: Draw) -> dict[str, np.ndarray]:
        drawn.append(draw)
        maps = augmented(self, group, pair, draw)
        half = np.where(np.arange(SIZE) < SIZE / 2, np.float32(0.5), np.float32(1))[:, None, None]
        return maps | {"image": maps["image"] * half, "mask": maps["mask"] * half}

    def watched(self: UniRenderPipeline, images: list, masks: list, **options: Any) -> list:
        seen.extend(images)
        return decompose(self, images, masks, **options)

    monkeypatch.setattr(GroupDataset, "augmented", half_covered)
    monkeypatch.setattr(UniRenderPipeline, "decompose_batch", watched)
    readings(pipeline, dataset, 2, 0)
    assert len(drawn) == len(seen) == 20
    assert all(draw.turns == 0 and tuple(draw.order) == (0, 1, 2) for draw in drawn)
    whole = [image_srgb(augmented(dataset, group, None, draw)["image"]) for group, draw in enumerate(drawn[::2])]
    np.testing.assert_allclose(seen[::2], whole, atol=1e-3)


def test_one_object_under_several_names_counts_once(
    tmp_path: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line would else be scored on objects that it was fitted to."""
    seeds = {"a_g0": 0, "b-turned7_g0": 1, "b-turned1000007_g0": 2, "c_g0": 3, "elsewhere_g0": 0, "a_g1": 0}
    groups = {key: group_members("basis", SIZE, 1, (40,), (0, 50, 100), seed) for key, seed in seeds.items()}
    write_shard(tmp_path / "shard-000000.tar", groups)
    numbers, alike = objects_of(GroupDataset(tmp_path))
    assert numbers.tolist() == [0, 1, 1, 2, 0, 0]
    assert set(alike) == {("a_g0", "elsewhere_g0"), ("elsewhere_g0", "a_g1")}
    with pytest.raises(UnirenderError, match="got 3 objects, expected 10 or more"):
        Calibrate(tmp_path, tmp_path / "out", checkpoint).run()
    assert "2 pairs of groups look alike, such as a_g0 and elsewhere_g0" in capsys.readouterr().out


def test_nothing_is_written_where_no_line_is_worth_having(
    data: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Line, "better", property(lambda line: False))
    assert Calibrate(data, tmp_path / "out", checkpoint, pictures=1).run() == 0
    said = capsys.readouterr().out
    assert "nothing is written" in said
    assert said.count(": not kept") == 2
    assert not list(tmp_path.iterdir())


def test_wrong_calls_are_refused(data: Path, checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for change, named in (({"pictures": 0}, "--pictures 0"), ({"seed": -1}, "--seed -1")):
        with pytest.raises(UsageError, match=named):
            Calibrate(data, out, checkpoint, **change).run()
    with pytest.raises(UnirenderError, match="no such data folder"):
        Calibrate(tmp_path / "none", out, checkpoint).run()
    few = write_dataset(tmp_path / "few", size=SIZE, shards=1, groups=2)
    with pytest.raises(UnirenderError, match="got 2 objects, expected 10 or more"):
        Calibrate(few, out, checkpoint).run()
    with pytest.raises(UnirenderError, match=r"exists and is not empty, .* choose another --out"):
        Calibrate(data, tmp_path, checkpoint).run()
    small = write_dataset(tmp_path / "small", size=SIZE // 2, shards=1, groups=10)
    with pytest.raises(UnirenderError, match="16 x 16 pixels, expected at least 32"):
        Calibrate(small, out, checkpoint).run()
    shutil.copytree(checkpoint, tmp_path / "trained")
    known = {"data": {"fingerprint": GroupDataset(data).fingerprint}}
    (tmp_path / "trained" / "training.json").write_text(json.dumps({"continues": [known]}))
    with pytest.raises(UnirenderError, match="was trained on this folder"):
        Calibrate(data, out, tmp_path / "trained").run()
    assert not out.exists()


def test_data_that_share_a_shard_with_the_training_are_refused(
    data: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A part of them, or a folder that has grown since; and no bar of loading is shown."""
    diffusers.utils.logging.enable_progress_bar()
    part, other = tmp_path / "part", tmp_path / "other"
    for folder, source in ((part, data), (other, write_dataset(tmp_path / "new", size=SIZE, shards=1, groups=2))):
        folder.mkdir()
        shutil.copy(source / "shard-000000.tar", folder)
    shutil.copytree(checkpoint, tmp_path / "trained")
    (tmp_path / "trained" / "training.json").write_text(json.dumps({"data": dataset_facts(part, GroupDataset(part))}))
    with pytest.raises(UnirenderError, match=r"was trained on 1 of its 2 shards, such as shard-000000\.tar"):
        Calibrate(data, tmp_path / "out", tmp_path / "trained").run()
    with pytest.raises(UnirenderError, match="got 2 objects"):  # another shard of that name
        Calibrate(other, tmp_path / "out", tmp_path / "trained").run()
    assert "Loading" not in capsys.readouterr().err


def test_the_account_of_a_training_tells_of_it(checkpoint: Path, tmp_path: Path) -> None:
    shutil.copytree(checkpoint, tmp_path / "trained")
    (tmp_path / "trained" / "training.json").write_text(json.dumps({"preset": "tiny", "steps": 5}))
    data = {"folder": "new", "fingerprint": "ab" * 32, "shards": 2, "groups": 10, "pairs": 60}
    about = {"data": data, "pictures": 3, "seed": 0}
    line = Line(0.75, 0.125, 0.0526, 0.05, 0.0012)
    (tmp_path / "mine").mkdir()
    write_calibrated(tmp_path / "trained", tmp_path / "mine", "mine", {"roughness": line}, about)
    facts = json.loads((tmp_path / "mine" / "training.json").read_text())
    assert (facts["preset"], facts["calibration"]["lines"]["roughness"]["slope"]) == ("tiny", 0.75)
    card = (tmp_path / "mine" / "README.md").read_text()
    assert "# unirender: mine" in card
    assert "roughness: 0.750 x predicted + 0.125, mean squared error 0.0526, lower by 0.0026 ± 0.0012" in card
    assert "3 pictures of each group of `new`: 2 shards, 10 groups" in card


def test_training_on_says_that_the_line_is_not_inherited(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    config = dataclasses.replace(TRAIN, model=MODEL)
    trainer = Trainer(config, RunConfig(tmp_path / "run", steps=1), torch.device("cpu"), torch.float32)
    read_start(MODEL, checkpoint).apply(trainer)
    assert "calibration" not in capsys.readouterr().err
    (tmp_path / "lined").mkdir()
    write_calibrated(checkpoint, tmp_path / "lined", "lined", {"roughness": Line(0.5, 0.2, 0.1, 0.05, 0.01)}, {})
    read_start(MODEL, tmp_path / "lined").apply(trainer)
    assert "run `unirender calibrate` on the new ones" in capsys.readouterr().err
    told: list[str] = []  # of several processes the first one alone says it
    start = read_start(MODEL, tmp_path / "lined")
    start.apply(trainer, told.append)
    assert len(told) == 1
    assert capsys.readouterr().err.count("calibrate") == 0
    wider = dataclasses.replace(MODEL, cross_attention_dim=2 * MODEL.cross_attention_dim)
    other = dataclasses.replace(TRAIN, model=wider)
    with pytest.raises(UnirenderError, match="expected the same network"):
        start.apply(
            Trainer(other, RunConfig(tmp_path / "run", steps=1), torch.device("cpu"), torch.float32), told.append
        )
    assert len(told) == 1  # nothing of weights that are refused


def test_what_ships_has_lines_that_a_pipeline_takes() -> None:
    lines = UniRenderPipeline.from_pretrained(checkpoint_folder("small")).config["calibration"]
    assert lines
    assert check_lines(lines) == lines
    card = (checkpoint_folder("small") / "README.md").read_text()
    slope, offset = lines["roughness"]
    assert f"roughness: {slope:.3f} x predicted + {offset:.3f}" in card
