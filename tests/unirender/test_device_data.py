"""Batches made on the device against those of the reader, value by value."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from synthetic_shards import group_members, maps_members, write_dataset, write_shard
from tiny_models import TRAIN

from unirender.training.augment import NO_AUGMENTATION
from unirender.training.data import ALL_ROWS, Batch, GroupDataset, make_batch
from unirender.training.device_data import DeviceGroups, DeviceSource, fits, packed_bytes
from unirender.training.presets import Augmentation
from unirender.training.run import Train, train
from unirender.training.source import ShardSource

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
CONFIG = dataclasses.replace(TRAIN, augmentation=dataclasses.replace(EVERYTHING, derived=0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three shards: basis groups with one, two and three lights; pairs; and pairs with maps of their own."""
    folder = tmp_path_factory.mktemp("data")
    kinds = (1, (20, 80)), (2, (50,)), (3, (10, 40))
    basis = {f"b{n}": group_members("basis", 16, n, levels, (0, 50, 100), seed=n) for n, levels in kinds}
    write_shard(folder / "shard-000000.tar", basis)
    write_shard(folder / "shard-000001.tar", {"p": group_members("independent", 16, 2, (30,), (70,), seed=9)})
    write_shard(folder / "shard-000002.tar", {"m": maps_members(16, 2, 5)})
    return folder


def both(folder: Path, augmentation: Augmentation, rows: slice = ALL_ROWS) -> tuple[Batch, Batch]:
    """The second batch of a stream, made on the device and by the reader."""
    source = on_device(folder, 24, 3, augmentation, rows)
    source.next()
    assert source.dataset is not None
    return source.next(), make_batch(source.dataset, 24, 24, 3, augmentation, rows)


def on_device(folder: Path, batch: int, seed: int, augmentation: Augmentation, rows: slice = ALL_ROWS) -> DeviceSource:
    return DeviceSource(ShardSource(folder, batch, seed, augmentation=augmentation, size=16, rows=rows), CPU)


@pytest.mark.parametrize("name", ONE_BY_ONE)
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


def test_what_it_holds_is_counted(folder: Path) -> None:
    dataset = GroupDataset(folder)
    groups = DeviceGroups(dataset, CPU)
    held = sum(bank.nbytes for bank in (groups.pixels, groups.environment))
    assert held < packed_bytes(dataset) <= held + groups.shared.nbytes
    assert not fits(dataset, CPU)  # a CPU reads from the shards


def test_a_run_with_it_is_the_run_without(tmp_path: Path) -> None:
    """Same samples, hence the same losses to rounding; and the same facts of the data."""
    data = write_dataset(tmp_path / "data", shards=1, groups=2, size=32)
    lines, facts = {}, {}
    for batches in ("cpu", "device"):
        out = tmp_path / batches
        train(Train(data, out=out, steps=2, log_every=1, dtype="float32", parallel=1, batches=batches), CONFIG, out)
        lines[batches] = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
        facts[batches] = json.loads((out / "pipeline/training.json").read_text())["data"]
    assert facts["device"] == facts["cpu"]
    for read, made in zip(lines["cpu"], lines["device"], strict=True):
        assert made["albedo"] == pytest.approx(read["albedo"], rel=1e-3)
        assert made["image"] == pytest.approx(read["image"], rel=1e-3)
