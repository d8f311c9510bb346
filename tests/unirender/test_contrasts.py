"""Runs of pictures that differ in one thing: what they share, their order, exact resume, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_shards import group_members, write_dataset, write_shard

from unirender.errors import UnirenderError
from unirender.training.augmentations.augment import DEFAULT_AUGMENTATION, NO_AUGMENTATION
from unirender.training.command import Train
from unirender.training.config import Augmentation
from unirender.training.data.contrasts import ContrastDataset, sets_of
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.packing import Group, Pair
from unirender.training.data.source import ShardSource
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.plan import OBJECT_BLOCK, plan_groups

SIZE, OBJECTS, EACH = 16, 4, 4
MATERIALS = ((40, 0), (70, 0), (40, 30), (70, 30))  # roughness and metallic in percent
LIGHT, MATERIAL, OBJECT = range(3)


def one_material_per_light(seed: int, lights_of: dict[str, bytes]) -> dict[str, bytes]:
    """An object under the lights of another group, each with its material: what a block of objects shares."""
    members = group_members("one-at-a-time", SIZE, EACH, (40, 70), (0, 30), seed)
    kept = {f"l{k}.m{m:03d}_r{r:03d}.exr" for k, (r, m) in enumerate(MATERIALS)}
    kept |= {f"l{k}.r{r:03d}.specular.exr" for k, (r, _) in enumerate(MATERIALS)}
    kept |= {"json", "shared.exr", *(f"l{k}.diffuse.exr" for k in range(EACH))}
    members = {name: data for name, data in members.items() if name in kept}
    return members | {f"l{k}.environment.exr": lights_of[f"l{k}.environment.exr"] for k in range(EACH)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each object with a group of each kind; over two shards."""
    folder = tmp_path_factory.mktemp("contrasts")
    block = group_members("one-at-a-time", SIZE, EACH, (40,), (0,), 99)
    groups: dict[str, dict[str, bytes]] = {}
    for i in range(OBJECTS):
        groups[f"o{i}_g0"] = group_members("one-at-a-time", SIZE, EACH, (50 + i,), (10,), i)
        groups[f"o{i}_g1"] = group_members("one-at-a-time", SIZE, 1, (20 + i, 80), (0, 60), i)
        groups[f"o{i}_g2"] = one_material_per_light(i, block)
    keys = list(groups)
    for shard, some in enumerate((keys[:6], keys[6:])):
        write_shard(folder / f"shard-{shard:06d}.tar", {key: groups[key] for key in some})
    return folder


def things(dataset: GroupDataset, index: int, augmentation: Augmentation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What tells light, material and object of a sample apart; the light but for its exposure."""
    maps = dataset.sample(index, 0, augmentation)
    light = maps["environment"] / maps["environment"].mean()
    return light, np.array([maps["metallic"].max(), maps["roughness"].max()]), maps["albedo"]


def varying(
    dataset: GroupDataset, first: int, length: int, augmentation: Augmentation = NO_AUGMENTATION
) -> tuple[int, ...]:
    """How many lights, materials and objects some neighbours have."""
    found: tuple[list[np.ndarray], ...] = ([], [], [])
    for index in range(first, first + length):
        for seen, thing in zip(found, things(dataset, index, augmentation), strict=True):
            if not any(np.allclose(thing, other, rtol=0, atol=1e-4) for other in seen):
                seen.append(thing)
    return tuple(len(seen) for seen in found)


@pytest.mark.parametrize("augmentation", [NO_AUGMENTATION, DEFAULT_AUGMENTATION], ids=["stored", "augmented"])
@pytest.mark.parametrize("length", [2, 4])
def test_a_run_differs_in_one_thing(folder: Path, length: int, augmentation: Augmentation) -> None:
    dataset = ContrastDataset(folder, run_length=length)
    assert len(dataset) == dataset.num_pairs == OBJECTS * 3 * EACH
    kinds = [varying(dataset, first, length, augmentation) for first in range(0, len(dataset), length)]
    assert all(sorted(counts) == [1, 1, length] for counts in kinds), kinds
    each = [sum(counts[thing] == length for counts in kinds) for thing in (LIGHT, MATERIAL, OBJECT)]
    assert each == [len(kinds) // 3] * 3
    mixed = GroupDataset(folder)  # the twin that must fail: the same pictures in any order
    others = [varying(mixed, first, length, augmentation) for first in range(0, len(mixed), length)]
    assert not all(sorted(counts) == [1, 1, length] for counts in others)


def test_an_epoch_has_each_picture_once_and_another_order(folder: Path) -> None:
    dataset = ContrastDataset(folder, run_length=4)
    orders = [dataset._order(0, epoch) for epoch in range(3)]
    assert all(sorted(order) == list(range(len(dataset))) for order in orders)
    assert len({tuple(order) for order in orders}) == 3
    assert np.array_equal(orders[1], ContrastDataset(folder, run_length=4)._order(0, 1))
    assert not np.array_equal(orders[1], dataset._order(1, 1))


def test_what_is_left_over_comes_in_another_epoch(folder: Path) -> None:
    """Sets of 4 in runs of 3."""
    dataset = ContrastDataset(folder, run_length=3)
    assert len(dataset) == OBJECTS * 3 * 3
    orders = [set(dataset._order(0, epoch)) for epoch in range(20)]
    assert all(len(order) == len(dataset) for order in orders)
    assert len(set.union(*orders)) == dataset.num_pairs
    assert all(sorted(varying(dataset, first, 3)) == [1, 1, 3] for first in range(0, len(dataset), 3))


def batches(folder: Path, count: int, skip: int = 0, rows: slice = slice(None)) -> list[torch.Tensor]:
    """The images of the first batches; the first `skip` of them are only counted, as a resumed run does."""
    source = ShardSource(folder, 8, seed=3, rows=rows, group_size=4)
    source.open()
    source.load_state_dict(source.state_dict() | {"consumed": 8 * skip})
    found = [source.next()["image"] for _ in range(count - skip)]
    source.close()
    return found


def test_resume_is_exact_and_processes_share_batches(folder: Path) -> None:
    whole = batches(folder, 14)  # into a third epoch
    assert all(torch.equal(a, b) for a, b in zip(whole[5:], batches(folder, 14, skip=5), strict=True))
    assert not torch.equal(whole[5], whole[6])
    halves = [batches(folder, 3, rows=slice(rank, None, 2)) for rank in range(2)]
    for k in range(3):
        assert torch.equal(whole[k][0::2], halves[0][k])
        assert torch.equal(whole[k][1::2], halves[1][k])


def test_unfit_data_and_batches_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="groups of --vary basis, expected one-at-a-time"):
        ContrastDataset(write_dataset(tmp_path), run_length=2)
    with pytest.raises(UnirenderError, match="the largest set has 4 pictures that differ in one thing, expected 5"):
        ContrastDataset(folder, run_length=5)
    with pytest.raises(UnirenderError, match="batches of 6, expected a multiple of 4"):
        ShardSource(folder, 6, seed=0, group_size=4)


def test_the_command_trains_on_runs_where_the_preset_says_so(tmp_path: Path) -> None:
    """It refuses data that every other preset takes."""
    data = write_dataset(tmp_path / "data")
    options = Train(data, preset="tiny_one_at_a_time", out=tmp_path / "run", steps=1, device="cpu", parallel=1)
    with pytest.raises(UnirenderError, match="expected one-at-a-time"):
        options.run(lambda suite, count: pytest.fail(f"nothing is scored: {suite}, {count}"), tuple)


def test_objects_of_another_block_are_no_set_with_these() -> None:
    """Two objects each, under two lights, of one metallic value each and of other roughnesses."""
    groups = [
        Group(str(i), "one-at-a-time", i, tuple(Pair(10 * i + k, k / 2, (i // 2 + k) / 4, 0, 0, 0) for k in range(2)))
        for i in range(4)
    ]
    assert sets_of(groups) == [[(i, k), (i + 1, k)] for i in (0, 2) for k in range(2)]


@pytest.mark.parametrize("pairs", [24, 121])
def test_sets_are_those_that_the_generator_plans(pairs: int, tmp_path: Path) -> None:
    """By the seeds of objects and lights, which the reader does not see: two of three are one, the third is never."""
    plan = plan_groups(
        DatasetConfig(objects=2 * OBJECT_BLOCK, pairs=pairs, resolution=16, vary="one-at-a-time", out=tmp_path)
    )
    groups: list[Group] = []
    truth: dict[tuple[int, int], tuple[int, tuple[int, int], int]] = {}
    for i, planned in enumerate(plan):
        stored: list[Pair] = []
        for k, light in enumerate(planned.lights):
            for roughness, metallic in sorted(light.pairs, key=lambda pair: pair[::-1]):
                truth[i, len(stored)] = light.seed, (roughness, metallic), planned.object_seed
                stored.append(Pair(100 * i + k, metallic / 100, roughness / 100, 0, 0, 0))
        groups.append(Group(str(i), "one-at-a-time", i, tuple(stored)))
    sets = sets_of(groups)
    assert sorted(member for members in sets for member in members) == sorted(truth)
    kinds: set[tuple[bool, ...]] = set()
    for members in (members for members in sets if len(members) > 1):
        counts = [len(set(column)) for column in zip(*(truth[member] for member in members), strict=True)]
        assert sorted(counts) == [1, 1, len(members)]
        kinds.add(tuple(count > 1 for count in counts))
    assert len(kinds) == 3
    assert pairs != 24 or {len(members) for members in sets} == {OBJECT_BLOCK}  # the preset's runs: nothing is left
