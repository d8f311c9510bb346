"""Batches made on the device against those of the reader, value by value."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from synthetic_shards import group_members, maps_members, write_dataset, write_shard
from tiny_models import TRAIN

from unirender.errors import UnirenderError, UsageError
from unirender.training.augmentations.augment import NO_AUGMENTATION
from unirender.training.command import Train
from unirender.training.config import Augmentation, RunConfig
from unirender.training.data.dataset import ALL_ROWS, Batch, GroupDataset, make_batch
from unirender.training.data.derived import _derive
from unirender.training.data.device_data import DeviceSource, fits, packed_bytes, room
from unirender.training.data.device_groups import DeviceGroups
from unirender.training.data.groups import list_shards
from unirender.training.data.source import ShardSource
from unirender.training.loop.facts import training_facts
from unirender.training.loop.trainer import Trainer
from unirender.training.optim.memory import TrainingBytes
from unirender.training.run import train

EVERYTHING = Augmentation(mix=0.7, permute=0.5, turn=0.5, repaint=0.5, derived=0.6, shadowed=0.5, move=0.5)
ONE_BY_ONE = {
    "nothing": NO_AUGMENTATION,
    "lights": dataclasses.replace(NO_AUGMENTATION, mix=1.0, tint=0.5),
    "metallic": dataclasses.replace(NO_AUGMENTATION, metallic=True),
    "channels": dataclasses.replace(NO_AUGMENTATION, permute=1.0),
    "turns": dataclasses.replace(NO_AUGMENTATION, turn=1.0),
    "mirror": dataclasses.replace(NO_AUGMENTATION, mirror=1.0),
    "exposure": dataclasses.replace(NO_AUGMENTATION, expose=True),
    "repaint": dataclasses.replace(NO_AUGMENTATION, repaint=1.0),
    "derived": dataclasses.replace(NO_AUGMENTATION, derived=0.7, shadowed=0.5),
    "moves": dataclasses.replace(NO_AUGMENTATION, move=1.0),
    "everything": EVERYTHING,
}
CPU = torch.device("cpu")
EXACT = dataclasses.replace(EVERYTHING, derived=0.0)
CONFIG = dataclasses.replace(TRAIN, augmentation=EXACT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three shards: basis groups with one, two and three lights; pairs; and pairs with maps of their own."""
    folder = tmp_path_factory.mktemp("data")
    kinds = (1, (20, 80)), (2, (50,)), (3, (10, 40))
    basis = {f"b{n}": group_members("basis", 16, n, levels, (0, 50, 100), seed=n) for n, levels in kinds}
    write_shard(folder / "shard-000000.tar", basis)
    write_shard(folder / "shard-000001.tar", {"p": group_members("independent", 16, 2, (30,), (70,), seed=9)})
    write_shard(folder / "shard-000002.tar", {"m": maps_members(16, 2, 5)})
    for path, shard in zip(list_shards(folder), GroupDataset(folder).shards, strict=True):
        _derive(path, shard)  # in this process: none to start
    return folder


def both(folder: Path, augmentation: Augmentation, rows: slice = ALL_ROWS) -> tuple[Batch, Batch]:
    """The second batch of a stream, made on the device and by the reader."""
    source = on_device(folder, 24, 3, augmentation, rows)
    source.next()
    assert source.dataset is not None
    return source.next(), make_batch(source.dataset, 24, 24, 3, augmentation, rows)


def on_device(folder: Path, batch: int, seed: int, augmentation: Augmentation, rows: slice = ALL_ROWS) -> DeviceSource:
    return DeviceSource(ShardSource(folder, batch, seed, augmentation=augmentation, size=16, rows=rows), CPU)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in ("nothing", "everything") else [pytest.mark.long]) for name in ONE_BY_ONE],
)
def test_batches_are_those_of_the_reader(name: str, folder: Path) -> None:
    made, read = both(folder, ONE_BY_ONE[name])
    assert made.keys() == read.keys()
    for key, value in read.items():
        torch.testing.assert_close(made[key], value, rtol=2e-4, atol=2e-4, msg=lambda text, key=key: f"{key}: {text}")
        assert made[key].dtype == value.dtype


def test_each_augmentation_is_seen(folder: Path) -> None:
    """The twin of the test above: what is compared there differs with each of them."""
    plain = both(folder, NO_AUGMENTATION)[0]
    for name in ONE_BY_ONE.keys() - {"nothing", "derived"}:
        assert not torch.allclose(both(folder, ONE_BY_ONE[name])[0]["image"], plain["image"], atol=1e-2), name


def test_a_process_makes_its_own_rows(folder: Path) -> None:
    made, read = both(folder, EVERYTHING, slice(1, None, 3))
    assert len(made["image"]) == len(read["image"]) == 8
    torch.testing.assert_close(made["image"], read["image"], rtol=2e-4, atol=2e-4)


def test_it_goes_on_where_it_was(folder: Path) -> None:
    source = on_device(folder, 8, 3, EVERYTHING)
    source.next()
    state, expected = source.state_dict(), source.next()["image"]
    again = on_device(folder, 8, 99, EVERYTHING)
    again.load_state_dict(state)
    assert torch.equal(again.next()["image"], expected)
    reader = ShardSource(folder, 8, 3, augmentation=EVERYTHING, size=16)  # a run may go on with either
    reader.load_state_dict(state)
    torch.testing.assert_close(reader.next()["image"], expected, rtol=2e-4, atol=2e-4)
    reader.close()


def test_a_growing_folder_is_taken_in(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "data")
    source = on_device(tmp_path / "data", 4, 0, NO_AUGMENTATION)
    source.next()
    assert source.refresh() is None
    write_shard(tmp_path / "data/shard-000003.tar", {"new": group_members("independent", 16, 1, (10,), (0,), seed=77)})
    news = source.refresh()
    assert news is not None
    assert "3 -> 4 shards" in news
    source.next()
    assert source.dataset is not None
    assert "new" in source.dataset.keys


@pytest.mark.parametrize("derived", [False, True])
def test_what_it_holds_is_counted(folder: Path, derived: bool) -> None:
    dataset = GroupDataset(folder, derived=derived)
    groups = DeviceGroups(dataset, CPU)
    banks = (groups.pixels, groups.shared, groups.environment, *(groups.derived or ()))
    assert packed_bytes(dataset) == sum(bank.nbytes for bank in banks)
    assert len(banks) == (5 if derived else 3)


def test_a_gpu_takes_what_a_training_leaves() -> None:
    training = TrainingBytes(weights=7, gradients=100, moments=200, average=7)  # the weights are there already
    assert room(600, training) == 100
    assert room(200, training) == 0


def test_a_cpu_reads_from_the_shards(folder: Path, tmp_path: Path) -> None:
    assert not fits(GroupDataset(folder), CPU, TrainingBytes(0, 0, 0, 0))
    options = Train(tmp_path / "no-data", steps=1, batches="device", device="cpu")  # said before anything is read
    with pytest.raises(UsageError, match="--batches device: the training is on cpu, expected a CUDA device"):
        train(options, CONFIG, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_light_that_was_not_derived_is_refused(folder: Path) -> None:
    dataset = GroupDataset(folder)
    drawn = [dataset.drawn(0, 0, Augmentation(derived=1.0))]
    with pytest.raises(UnirenderError, match="opened without it"):
        DeviceGroups(dataset, CPU).batch(drawn)


def test_an_object_without_light_is_named(tmp_path: Path) -> None:
    write_dataset(tmp_path, shards=1, groups=1)
    dataset = GroupDataset(tmp_path)
    groups, drawn = DeviceGroups(dataset, CPU), [dataset.drawn(0, 0, Augmentation())]
    groups.batch(drawn)
    groups.pixels.zero_()
    with pytest.raises(UnirenderError, match="group train-000000_g0 is 0"):
        groups.batch(drawn)
    groups.shared.zero_()
    with pytest.raises(UnirenderError, match="group train-000000_g0 is nan"):
        groups.batch(drawn)


def test_batches_of_one_at_a_time_groups(tmp_path: Path) -> None:
    write_dataset(tmp_path, "one-at-a-time", shards=1, groups=2, lights=4, roughness=(40,), metallic=(50,))
    source = ShardSource(tmp_path, 8, 3, augmentation=EXACT, size=16, group_size=4)
    made, read = DeviceSource(source, CPU).next(), make_batch(source.open(), 0, 8, 3, EXACT)
    for name, value in read.items():
        torch.testing.assert_close(made[name], value, rtol=2e-4, atol=2e-4)


def test_a_run_with_it_is_the_run_without(tmp_path: Path) -> None:
    """Same samples, hence the same losses to rounding; and the same facts of the data."""
    data = write_dataset(tmp_path / "data", shards=1, groups=2, size=32)
    losses, facts = [], []
    for kind in ("reader", "device"):
        run = Trainer(CONFIG, RunConfig(tmp_path / kind, steps=2, log_every=1), CPU, torch.float32)
        source = ShardSource(data, CONFIG.batch_size, 0, augmentation=CONFIG.augmentation, size=32)
        run.fit(source if kind == "reader" else DeviceSource(source, CPU))
        lines = (tmp_path / kind / "log.jsonl").read_text().splitlines()
        losses.append([json.loads(line) for line in lines])
        facts.append(training_facts(run)["data"])
    assert facts[0] == facts[1]
    for read, made in zip(*losses, strict=True):
        assert made["albedo"] == pytest.approx(read["albedo"], rel=1e-3)
        assert made["image"] == pytest.approx(read["image"], rel=1e-3)
