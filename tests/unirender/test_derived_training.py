"""s and d as derived from a light, in training and in use: what is stored, what a network is told, what it sees."""

import dataclasses
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import threadpoolctl
import torch
from synthetic_shards import group_members, maps_members, sphere, write_dataset, write_shard
from tiny_models import SIZE, make_batch, make_model, make_pipeline
from torch import Tensor

from unirender.diffusion.schedule import make_scheduler
from unirender.diffusion.timesteps import Timesteps
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, exr_bytes, intrinsics_channels, read_exr_bytes
from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light, specular_light
from unirender.models.conditioning import DERIVED_FLAG
from unirender.models.packing import TRIPLETS
from unirender.pipelines.editing import under_light
from unirender.pipelines.rendered_maps import ready_to_render, told_derived
from unirender.pipelines.results import EditResult
from unirender.pipelines.shadowed_light import visible_shares
from unirender.training.augmentations.augment import NO_AUGMENTATION
from unirender.training.config import Augmentation, LossConfig
from unirender.training.data import derived
from unirender.training.data.dataset import BATCH_MAPS, DERIVED_FLAGS, DERIVED_MAPS, GroupDataset
from unirender.training.data.derived import DerivedLight
from unirender.training.data.groups import list_shards, read_groups
from unirender.training.data.reader import BatchReader
from unirender.training.losses.loss_function import LossFunction

ALWAYS = Augmentation(mix=0.7, tint=0.3, permute=0.6, turn=0.6, derived=1.0)
LIGHT = ("specular", "diffuse")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("derived"))


@pytest.fixture(scope="module")
def dataset(folder: Path) -> GroupDataset:
    return GroupDataset(folder, derived=True)


def derived_light(dataset: GroupDataset) -> list[DerivedLight]:
    assert dataset._derived is not None
    return dataset._derived


# --- what is stored


def bowls(folder: Path) -> Path:
    """A data folder of bowls: their walls hide light, which no ball does."""
    members = group_members("basis", 16, 2, (40, 70), (0, 50, 100), seed=0)
    ball = sphere(16, np.random.default_rng(0))
    bowl = ball.replace(normal=ball.require("normal")["normal"] * np.array([-1, -1, 1], np.float32))
    write_shard(folder / "shard-000000.tar", {"a": members | {"shared.exr": exr_bytes(intrinsics_channels(bowl))}})
    return folder


@pytest.mark.long
@pytest.mark.parametrize("hollow", [False, True])
def test_the_light_of_each_group_is_stored_with_and_without_shadows(folder: Path, tmp_path: Path, hollow: bool) -> None:
    folder = bowls(tmp_path) if hollow else folder
    dataset = GroupDataset(folder, derived=True)
    members = dict(pair for path in list_shards(folder) for pair in read_groups(path))
    for group, key in enumerate(dataset.keys):
        shard, entry = dataset._groups[group]
        normal = np.moveaxis(shard.shared[entry.shared][3:6].astype(np.float32), 0, -1)
        inside = np.moveaxis(shard.shared[entry.shared][6:7], 0, -1) > 0
        stored = derived_light(dataset)[dataset._shard_of[group]]
        lights = sorted({pair.light for pair in entry.pairs})
        hidden = 0
        for pair in entry.pairs[::5]:
            name = f"l{lights.index(pair.light)}.environment.exr"
            light = channels_rgb(read_exr_bytes(members[key][name], name=name)[0])
            roughness = pair.roughness * inside.astype(np.float32)
            mask = np.moveaxis(shard.shared[entry.shared][6:7].astype(np.float32), 0, -1)
            surface = Intrinsics().replace(normal=normal, roughness=roughness, mask=mask)
            shares = visible_shares(surface, light)
            d, s = diffuse_light(normal, light), specular_light(normal, roughness, light)
            for row, expected, name in ((pair.diffuse, d, "diffuse"), (pair.specular, s, "specular")):
                for shadows, share in ((False, 1), (True, shares[name])):
                    found = np.moveaxis(stored.of([row], shadows)[0], 0, -1)
                    np.testing.assert_allclose(found, expected * share, rtol=2e-3, atol=1e-4)
                assert expected.max() > 0.01
                hidden += int((shares[name] < 0.9).sum())
        assert (hidden > 0) == hollow
        assert (stored.rows[[pair.image for pair in entry.pairs]] == -1).all()


def test_it_is_derived_once(folder: Path, dataset: GroupDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(derived, "WorkerPool", None)  # nothing could be derived
    again = GroupDataset(folder, derived=True)
    np.testing.assert_array_equal(derived_light(again)[0].shadowed, derived_light(dataset)[0].shadowed)


def test_roughness_maps_have_their_own_lobes(tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-000000.tar", {"a": maps_members(16, lights=2, seed=0)})
    derived._derive(tmp_path / "shard-000000.tar", GroupDataset(tmp_path).shards[0])  # in this process: none to start
    data = GroupDataset(tmp_path, derived=True)
    sample = data.sample(0, 0, Augmentation(**{**vars(NO_AUGMENTATION), "derived": 1.0}))
    _, entry = data._groups[0]
    members = dict(read_groups(tmp_path / "shard-000000.tar"))["a"]
    pair = data._items[data._order(0, 0)[0]][1]
    assert pair is not None
    name = f"l{pair.light - entry.pairs[0].light}.environment.exr"
    environment = channels_rgb(read_exr_bytes(members[name], name=name)[0])
    expected = specular_light(sample["normal"], sample["roughness"], environment)
    np.testing.assert_allclose(sample["derived_specular"], expected, rtol=1e-3, atol=1e-3)
    assert np.ptp(sample["roughness"][sample["mask"] > 0]) > 0.1


# --- what a batch has


def test_augmentations_do_to_it_what_they_do_to_rendered_light(folder: Path) -> None:
    dataset = GroupDataset(folder, derived=True)
    every = [(shard.pixels, np.arange(len(shard.pixels), dtype=np.int32)) for shard in dataset.shards]
    # as if nothing cast a shadow; what is not asked for is nowhere
    kinds = {False: [DerivedLight(Path(), x, 0 * x, rows) for x, rows in every]}
    kinds[True] = [DerivedLight(Path(), 0 * x, x, rows) for x, rows in every]
    for shadows, stored in kinds.items():
        dataset._derived = stored
        for index in range(24):
            sample = dataset.sample(index, 3, dataclasses.replace(ALWAYS, shadowed=float(shadows)))
            for name in LIGHT:
                np.testing.assert_array_equal(sample[f"derived_{name}"], sample[name])
            assert sample["derived"] == 1
            assert sample["shadowed"] == shadows


def test_the_rest_of_a_sample_does_not_depend_on_it(folder: Path, dataset: GroupDataset) -> None:
    plain = GroupDataset(folder)
    never = Augmentation(**{**vars(ALWAYS), "derived": 0.0})
    for index in range(6):
        one, other = plain.sample(index, 3, never), dataset.sample(index, 3, ALWAYS)
        assert set(other) - set(one) == {*DERIVED_MAPS, *DERIVED_FLAGS}
        for name in BATCH_MAPS:
            np.testing.assert_array_equal(one[name], other[name])


def test_a_share_of_a_batch_has_it(dataset: GroupDataset) -> None:
    half = Augmentation(derived=0.5, shadowed=0.5)
    batch = next(BatchReader(dataset, 16, seed=0, workers=0, augmentation=half))
    assert tuple(batch) == (*BATCH_MAPS, *DERIVED_MAPS, *DERIVED_FLAGS)
    there = batch["derived"].flatten() > 0
    shadowed = batch["shadowed"].flatten() > 0
    assert 0 < int(shadowed.sum()) < int(there.sum()) < 16
    assert not shadowed[~there].any()
    for name in DERIVED_MAPS:
        assert batch[name].shape == batch["specular"].shape
        assert batch[name][there].flatten(1).any(dim=1).all()
        assert not batch[name][~there].any()


def test_data_that_was_opened_without_it_says_so(folder: Path) -> None:
    with pytest.raises(UnirenderError, match="derived=True"):
        GroupDataset(folder).sample(0, 0, ALWAYS)


# --- what a renderer in training sees


ZERO, NOISE = torch.zeros(4, dtype=torch.long), torch.full((4,), 999)
RENDERING, INVERSE = Timesteps(ZERO, NOISE), Timesteps(NOISE, ZERO)


def loss_function() -> LossFunction:
    model, conditioning = make_model(derived_light=True)
    return LossFunction(model, conditioning, make_scheduler(), LossConfig())


def total(loss: LossFunction, batch: dict[str, Tensor], timesteps: Timesteps) -> float:
    return float(loss.total(loss.terms(batch, timesteps, torch.Generator().manual_seed(0))).detach())


def derived_batch(seed: int = 5) -> dict[str, Tensor]:
    other = make_batch(seed=seed)
    return (
        make_batch()
        | {f"derived_{n}": other[n] for n in LIGHT}
        | {
            "derived": torch.ones(4, 1, 1, 1),
            "shadowed": torch.zeros(4, 1, 1, 1),
        }
    )


def test_a_renderer_sees_it_instead_and_a_decomposer_does_not() -> None:
    loss = loss_function()
    batch = derived_batch()
    names = [f"derived_{name}" for name in LIGHT]
    changed = {
        "derived": batch | {name: 0.5 * batch[name] for name in names},
        "rendered": batch | {name: 0.5 * batch[name] for name in LIGHT},
    }
    for direction, seen in ((RENDERING, "derived"), (INVERSE, "rendered")):
        errors = {kind: total(loss, b, direction) for kind, b in ({"": batch} | changed).items()}
        unseen = ({"derived", "rendered"} - {seen}).pop()
        assert errors[unseen] == errors[""]
        assert errors[seen] != errors[""]


def test_rows_without_it_are_what_they_were() -> None:
    loss, plain = loss_function(), make_batch()
    without = derived_batch() | {"derived": torch.zeros(4, 1, 1, 1)}
    assert total(loss, without, RENDERING) == total(loss, plain, RENDERING)
    has, shadowed = [False, True, False, True], [False, False, False, True]
    some = derived_batch() | {
        name: torch.tensor(flags, dtype=torch.float32).reshape(4, 1, 1, 1)
        for name, flags in (("derived", has), ("shadowed", shadowed))
    }
    seen, derived = loss._seen(some, torch.ones(4, dtype=torch.bool))
    assert derived is not None
    for row in range(4):
        for name in LIGHT:
            assert torch.equal(seen[name][row], some[f"derived_{name}" if has[row] else name][row])
        told = {t for t, flag in zip(TRIPLETS, derived[row], strict=True) if flag}
        assert told == (told_derived(LIGHT, shadowed[row]) if has[row] else set())  # as the pipeline tells it


# --- what the network is told


@pytest.mark.parametrize("told", [True, False])
def test_its_flag_is_between_given_and_not_given(told: bool) -> None:
    conditioning = make_pipeline(derived_light=told).conditioning
    batch = make_batch()
    given = torch.ones(4, 6, dtype=torch.bool)
    given[0, TRIPLETS.index("diffuse")] = False
    derived = torch.tensor([name in LIGHT for name in TRIPLETS]).expand(4, 6)
    flags = conditioning.extras(batch["mask"], given, batch, derived=derived).attributes[:, : len(TRIPLETS), 0, 0]
    expected = given.float()
    expected[:, [TRIPLETS.index(name) for name in LIGHT]] *= DERIVED_FLAG if told else 1.0
    assert torch.equal(flags, expected)
    plain = conditioning.extras(batch["mask"], given, batch)
    assert torch.equal(plain.attributes[:, : len(TRIPLETS), 0, 0], given.float())
    derived_too = conditioning.extras(batch["mask"], given, batch, derived=derived)
    assert plain.prior is not None
    assert derived_too.prior is not None
    assert torch.equal(plain.prior, derived_too.prior)  # made of what is there


def scene() -> Intrinsics:
    maps = {name: value[0].permute(1, 2, 0).numpy() for name, value in make_batch(1).items() if name != "image"}
    return Intrinsics().replace(**maps)


@pytest.mark.parametrize("told", [True, False])
def test_a_pipeline_tells_what_it_derived(told: bool) -> None:
    pipeline = make_pipeline(derived_light=told)
    bare = scene().replace(specular=None, diffuse=None)
    lit = under_light(bare, bare.require("environment")["environment"], "keep")
    by_itself = pipeline.render(bare, shadows=False)
    np.testing.assert_allclose(by_itself, pipeline.render(lit, derived=LIGHT), atol=1e-6)
    assert np.allclose(by_itself, pipeline.render(lit), atol=1e-6) != told
    half = pipeline.render(lit.replace(specular=None), shadows=False)
    np.testing.assert_allclose(half, pipeline.render(lit, derived=["specular"]), atol=1e-6)


@pytest.mark.parametrize("told", [True, False])
def test_of_what_has_the_shadows_that_are_seen_d_alone_is_told_to_lack_others(told: bool) -> None:
    pipeline = make_pipeline(derived_light=told)
    bare = scene().replace(specular=None, diffuse=None)
    light = bare.require("environment")["environment"]
    lit = ready_to_render(bare)
    without = under_light(bare, light, "keep").require("diffuse")["diffuse"]
    assert not np.allclose(lit.require("diffuse")["diffuse"], without)
    by_itself = pipeline.render(bare)
    np.testing.assert_allclose(by_itself, pipeline.render(lit, derived=["diffuse"]), atol=1e-6)
    assert np.allclose(by_itself, pipeline.render(lit, derived=LIGHT), atol=1e-6) != told


def test_a_relit_picture_is_rendered_with_light_that_was_derived() -> None:
    pipeline = make_pipeline(derived_light=True)
    mask = np.zeros((SIZE, SIZE, 1), np.float32)
    mask[4:-4, 4:-4] = 1
    picture = np.random.default_rng(0).uniform(0.2, 0.8, (SIZE, SIZE, 3)).astype(np.float32)
    found = pipeline.decompose(picture, mask)
    light = np.random.default_rng(1).uniform(0, 2, (16, 32, 3)).astype(np.float32)

    def relit(**given: Any) -> EditResult:
        return pipeline.relight(picture, light, mask, exposure="keep", anchored=False, decomposition=found, **given)

    derived = relit()
    given = relit(**derived.intrinsics.require(*LIGHT))
    assert not np.allclose(derived.image_linear, given.image_linear, atol=1e-6)  # the same numbers, as if with shadows


def test_a_worker_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with ProcessPoolExecutor(1, get_context("spawn"), derived.one_thread) as pool:
        found = pool.submit(threadpoolctl.threadpool_info).result()
    assert {"blas", "openmp"} <= {library["user_api"] for library in found}
    assert {library["num_threads"] for library in found} == {1}
