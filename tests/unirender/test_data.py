"""The reader: order and resume, nothing merged or lost, shapes and ranges, packing and its errors."""

import dataclasses
import itertools
import json
import pickle
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_shards import group_members, maps_members, write_dataset, write_shard
from webdataset.compat import WebDataset

from unirender.composite import composite_image
from unirender.errors import UnirenderError
from unirender.light.environment import mean_radiance, rotate_environment
from unirender.light.exposure import PERCENTILE, TARGET_RANGE, exposure_factor
from unirender.light.resampling import resample_environment
from unirender.light.surface_light import diffuse_light, specular_light
from unirender.light.symmetries import turn_rotation
from unirender.system.paths import cache_dir
from unirender.training.augmentations.augment import (
    DEFAULT_AUGMENTATION,
    NO_AUGMENTATION,
    Draw,
    draw,
)
from unirender.training.augmentations.environments import turned_environments
from unirender.training.config import Augmentation
from unirender.training.data.dataset import BATCH_MAPS, GroupDataset
from unirender.training.data.groups import list_shards, read_groups, split_of, unread_shards
from unirender.training.data.packing import Pair
from unirender.training.data.reader import BatchReader
from unirender.training.data.source import ShardSource


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("basis"))


@pytest.fixture(scope="module")
def dataset(folder: Path) -> GroupDataset:
    return GroupDataset(folder)


def samples(dataset: GroupDataset, count: int, start: int = 0, size: int = 3, **options) -> list[torch.Tensor]:
    """`count` images and albedos of a stream."""
    batches = BatchReader(dataset, size, seed=5, start_sample=start, **options)
    flat = itertools.chain.from_iterable(torch.cat([b["image"], b["albedo"], b["metallic"]], dim=1) for b in batches)
    return list(itertools.islice(flat, count))


def test_sample_depends_on_seed_and_index_only(dataset: GroupDataset) -> None:
    whole = samples(dataset, 12, workers=0)
    for resumed in (
        samples(dataset, 5, start=7, workers=0),
        samples(dataset, 5, start=7, size=2, workers=2),
        samples(GroupDataset(dataset.folder), 5, start=7, workers=1),
    ):
        assert all(torch.equal(a, b) for a, b in zip(whole[7:], resumed, strict=True))
    assert not torch.equal(whole[0], samples(dataset, 1, start=1, workers=0)[0])


class Counting(GroupDataset):
    """Counts the samples that are made."""

    made = 0

    def augmented(self, group: int, pair: Pair | None, drawn: Draw) -> dict[str, np.ndarray]:
        self.made += 1
        return super().augmented(group, pair, drawn)


def test_batches_are_read_ahead_when_that_is_asked_for(folder: Path) -> None:
    """And not before: the cores are busy then."""
    dataset = Counting(folder)
    reader = BatchReader(dataset, 2, seed=5, workers=1)
    first = next(reader)
    reader.read_ahead()
    reader.read_ahead()  # of which there is enough already
    second, third = next(reader), next(reader)
    made = dataset.made
    time.sleep(0.1)
    assert made == dataset.made == 6
    reader.read_ahead()
    end = time.monotonic() + 60
    while dataset.made < 10:
        assert time.monotonic() < end, "nothing is read ahead"
        time.sleep(0.01)
    reader.close()
    asked = BatchReader(dataset, 2, seed=5, workers=0)
    assert all(torch.equal(a["image"], next(asked)["image"]) for a in (first, second, third))


def test_another_process_maps_the_same_files(folder: Path, dataset: GroupDataset) -> None:
    """Spawned workers of a `DataLoader` are handed the dataset as bytes: all its pictures were among them."""
    handed = pickle.dumps(dataset)
    assert len(handed) < dataset.shards[0].pixels.nbytes / 2
    torch.testing.assert_close(samples(pickle.loads(handed), 3), samples(dataset, 3), rtol=0, atol=0)


def test_another_seed_gives_another_stream(dataset: GroupDataset) -> None:
    one, other = (next(BatchReader(dataset, 4, seed=seed, workers=0)) for seed in (0, 1))
    assert not torch.equal(one["image"], other["image"])


def test_each_epoch_is_a_permutation_of_the_items(dataset: GroupDataset) -> None:
    orders = [dataset._order(0, epoch) for epoch in range(8)]
    assert all(sorted(order) == list(range(len(dataset))) for order in orders)
    assert len({tuple(order) for order in orders}) > 1
    albedo = next(BatchReader(dataset, len(dataset), 0, workers=0, augmentation=NO_AUGMENTATION))["albedo"]
    assert len({a.numpy().tobytes() for a in albedo}) == len(dataset)  # every group once


def test_every_group_and_member_is_read_as_webdataset_reads_it(folder: Path, dataset: GroupDataset) -> None:
    urls = [str(path) for path in list_shards(folder)]
    theirs = {s["__key__"]: set(s) for s in WebDataset(urls, shardshuffle=False)}  # pyright: ignore[reportArgumentType] - its stub says str
    ours = {key: set(members) for path in list_shards(folder) for key, members in read_groups(path)}
    assert list(ours) == list(dataset.keys)
    assert {key: names | {"__key__", "__url__", "__local_path__"} for key, names in ours.items()} == {
        key: names | {"__local_path__"} for key, names in theirs.items()
    }
    assert dataset.num_pairs == 4 * 2 * 2 * 3


def test_a_stored_pair_is_what_was_written(dataset: GroupDataset) -> None:
    for group in range(len(dataset)):
        for pair in dataset.pairs(group):
            image, intrinsics = dataset.stored(group, pair)
            assert set(intrinsics.present) == set(BATCH_MAPS) - {"image"}
            np.testing.assert_allclose(image, composite_image(intrinsics), atol=4e-3)  # half precision
            roughness, mask = intrinsics.require("roughness", "mask").values()
            assert np.unique(roughness[mask > 0]) == np.float32(pair.roughness)


def test_the_whole_light_is_that_of_the_tar_in_its_order(tmp_path: Path) -> None:
    members = group_members("independent", 16, lights=12, roughness=(30,), metallic=(50,), seed=0)
    write_shard(tmp_path / "shard-000000.tar", {"a": members})
    dataset = GroupDataset(tmp_path)
    assert len(dataset.pairs(0)) == 12
    for pair in dataset.pairs(0):
        _, intrinsics = dataset.stored(0, pair)
        normal, mask, diffuse, environment = intrinsics.require("normal", "mask", "diffuse", "environment").values()
        whole = dataset.whole_light(0, pair)
        assert whole.shape == (8, 16, 3)
        np.testing.assert_allclose(turned_environments(whole, (16, 32))[0], environment, atol=1e-6)
        np.testing.assert_allclose(diffuse_light(normal, whole) * mask, diffuse * mask, atol=4e-3)  # half precision


def test_batch_shapes_and_ranges(dataset: GroupDataset) -> None:
    batch = next(BatchReader(dataset, 8, seed=0))
    assert tuple(batch) == BATCH_MAPS
    for name, tensor in batch.items():
        channels = 1 if name in ("roughness", "metallic", "mask") else 3
        size = (16, 32) if name == "environment" else (16, 16)
        assert tensor.shape == (8, channels, *size)
        assert tensor.dtype == torch.float32
        assert tensor.isfinite().all()
    for name in ("albedo", "roughness", "metallic", "mask"):
        assert batch[name].min() >= 0
        assert batch[name].max() <= 1
    for name in ("specular", "diffuse", "environment"):
        assert batch[name].min() >= 0
    outside = batch["mask"] == 0
    for name in ("image", "albedo", "normal", "roughness", "metallic", "diffuse"):
        assert (batch[name] * outside).abs().max() == 0
    length = batch["normal"].norm(dim=1, keepdim=True)[~outside]
    assert (length - 1).abs().max() < 2e-3


def test_gauge_is_applied_to_every_mixture(dataset: GroupDataset) -> None:
    for index in range(12):
        maps = dataset.sample(index, 0, DEFAULT_AUGMENTATION)
        level = exposure_factor(maps["diffuse"], maps["mask"], 1.0)
        assert 1 / TARGET_RANGE[1] * 0.999 <= level <= 1 / TARGET_RANGE[0] * 1.001, PERCENTILE
    unexposed = Augmentation(expose=False, tint=1.0)
    levels = [
        exposure_factor(maps["diffuse"], maps["mask"], 1.0)
        for maps in (dataset.sample(index, 0, unexposed) for index in range(12))
    ]
    assert max(levels) > 1 / TARGET_RANGE[0] or min(levels) < 1 / TARGET_RANGE[1]  # the check above can fail


def test_mixtures_stay_consistent_with_their_maps(dataset: GroupDataset) -> None:
    """The synthetic pictures are composites, which every augmentation must keep."""
    for index in range(40):
        maps = dataset.sample(index, 3, DEFAULT_AUGMENTATION)
        metallic, albedo = maps["metallic"], maps["albedo"]
        expected = (1 - metallic) * albedo * maps["diffuse"]
        expected = expected + (0.04 * (1 - metallic) + albedo * metallic) * maps["specular"]
        np.testing.assert_allclose(maps["image"], expected * maps["mask"], atol=6e-3)


def test_environment_rides_along_with_the_maps(dataset: GroupDataset) -> None:
    """d derived from the sample's normals and environment is the sample's d, whatever its augmentation."""
    wrong = []
    for index in range(24):
        maps = dataset.sample(index, 4, DEFAULT_AUGMENTATION)
        inside = maps["mask"] > 0
        np.testing.assert_allclose(
            diffuse_light(maps["normal"], maps["environment"]) * inside, maps["diffuse"], atol=0.03
        )
        wrong.append(diffuse_light(maps["normal"], maps["environment"][::-1]) * inside - maps["diffuse"])
    assert np.abs(wrong).max(axis=(1, 2, 3)).mean() > 3 * 0.03


def test_specular_light_is_that_of_the_roughness_beside_it(dataset: GroupDataset) -> None:
    """s derived from the sample's normals, roughness and environment, whatever its augmentation."""
    for index in range(8):
        maps = dataset.sample(index, 4, DEFAULT_AUGMENTATION)
        inside = maps["normal"][..., 2] > 0.5
        other = {0.4: 0.7, 0.7: 0.4}[round(float(maps["roughness"].max()), 2)]
        error, twin = (
            np.abs(specular_light(maps["normal"], roughness, maps["environment"]) - maps["specular"])[inside].mean()
            for roughness in (maps["roughness"], other)
        )
        assert error < 0.02
        assert twin > 0.05


def test_metallic_of_a_mixture_needs_its_own_nodes(dataset: GroupDataset) -> None:
    """The twin of the test above: a picture of another metallic is rejected by the same tolerance."""
    drawn = Draw(lights=(0,), weights=np.ones((1, 3), np.float32), roughness_index=0, metallic=0.3)
    right = dataset.augmented(0, None, drawn)["image"]
    wrong = dataset.augmented(0, None, Draw(**{**vars(drawn), "metallic": 0.5}))["image"]
    assert np.abs(right - wrong).max() > 5 * 6e-3


@pytest.mark.parametrize("vary", ["independent", "one-at-a-time", "paper", "sweep"])
def test_other_groups_are_flattened_to_pairs(tmp_path: Path, vary: str) -> None:
    folder = write_dataset(tmp_path, vary=vary, shards=1, lights=2, roughness=(40, 70), metallic=(0, 30))
    dataset = GroupDataset(folder)
    assert len(dataset) == dataset.num_pairs == 2 * 2 * 2 * 2
    batch = next(BatchReader(dataset, len(dataset), 0, workers=0, augmentation=NO_AUGMENTATION))
    assert {round(float(m.max()), 2) for m in batch["metallic"]} == {0.0, 0.3}
    assert len({image.numpy().tobytes() for image in batch["image"]}) == len(dataset)


def test_no_augmentation_gives_stored_pictures(tmp_path: Path) -> None:
    dataset = GroupDataset(write_dataset(tmp_path, vary="paper", shards=1))
    stored = {dataset.stored(g, pair)[0].tobytes() for g in range(len(dataset.keys)) for pair in dataset.pairs(g)}
    batch = next(BatchReader(dataset, len(dataset), 0, workers=0, augmentation=NO_AUGMENTATION))
    assert {image.permute(1, 2, 0).contiguous().numpy().tobytes() for image in batch["image"]} == stored


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> GroupDataset:
    folder = tmp_path_factory.mktemp("maps")
    write_shard(folder / "shard-000000.tar", {f"a{i}_g0": maps_members(16, 3, i) for i in range(2)})
    return GroupDataset(folder)


def test_a_group_with_maps_of_its_own_has_a_picture_for_each_light(mapped: GroupDataset) -> None:
    assert len(mapped) == mapped.num_pairs == 2 * 3
    for pair in mapped.pairs(0):
        assert pair.roughness is None
        assert pair.metallic is None
        image, intrinsics = mapped.stored(0, pair)
        np.testing.assert_allclose(image, composite_image(intrinsics), atol=4e-3)  # half precision
        roughness, metallic, mask = intrinsics.require("roughness", "metallic", "mask").values()
        assert np.ptp(roughness[mask > 0]) > 0.5
        assert np.ptp(metallic[mask > 0]) > 0.5
        assert not roughness[mask == 0].any()


def test_augmentations_carry_the_maps_along(mapped: GroupDataset) -> None:
    """Composites again, which a map left behind by a turn or a mirror would break."""
    wrong = 0.0
    for index in range(24):
        maps = mapped.sample(index, 3, DEFAULT_AUGMENTATION)
        for metallic in (maps["metallic"], maps["metallic"][:, ::-1]):
            dielectric = (1 - metallic) * (maps["albedo"] * maps["diffuse"] + 0.04 * maps["specular"])
            expected = (dielectric + metallic * maps["albedo"] * maps["specular"]) * maps["mask"]
            if metallic is maps["metallic"]:
                np.testing.assert_allclose(maps["image"], expected, atol=6e-3)
            else:
                wrong = max(wrong, float(np.abs(maps["image"] - expected).max()))
    assert wrong > 5 * 6e-3
    batch = next(BatchReader(mapped, 6, seed=0, workers=0))
    assert tuple(batch) == BATCH_MAPS
    assert batch["roughness"].shape == (6, 1, 16, 16)


def test_a_shard_whose_meshes_all_failed_is_left_out(folder: Path, tmp_path: Path) -> None:
    grown = shutil.copytree(folder, tmp_path / "grown")
    write_shard(grown / "shard-000007.tar", {})
    manifest = json.loads((grown / "manifest.json").read_text())
    manifest["shards"].append({"name": "shard-000007.tar", "sha256": "0", "groups": 0})
    (grown / "manifest.json").write_text(json.dumps(manifest))
    assert [path.name for path in list_shards(grown)] == [path.name for path in list_shards(folder)]
    for path in list_shards(folder):
        (grown / path.name).unlink()
    (grown / "manifest.json").write_text(json.dumps({"shards": manifest["shards"][-1:]}))
    with pytest.raises(UnirenderError, match="only shards without groups"):
        GroupDataset(grown)


def test_a_growing_folder(folder: Path, dataset: GroupDataset, tmp_path: Path) -> None:
    grown = shutil.copytree(folder, tmp_path / "grown")
    (grown / "manifest.json").unlink()
    extra = {"train-000099_g0": group_members("basis", 16, 2, (40, 70), (0, 50, 100), 99)}
    write_shard(grown / "shard-000009.tar", extra)
    (grown / ".shard-000010.tar.tmp").write_bytes(b"in flight")
    larger = GroupDataset(grown)
    assert len(larger) == len(dataset) + 1
    assert larger.fingerprint != dataset.fingerprint
    same = GroupDataset(grown, shards=dataset.shard_names)
    assert same.fingerprint == dataset.fingerprint
    assert torch.equal(samples(same, 1, start=3)[0], samples(dataset, 1, start=3)[0])


def test_a_training_set_in_parts(folder: Path, dataset: GroupDataset, tmp_path: Path) -> None:
    """Its shards are named by part and file; a part that was just begun does not count yet."""
    whole = tmp_path / "whole"
    shutil.copytree(folder, whole / "chairs")
    extra = {"train-000099_g0": group_members("basis", 16, 2, (40, 70), (0, 50, 100), 99)}
    (whole / "balls").mkdir()
    write_shard(whole / "balls" / "shard-000000.tar", extra)
    (whole / "begun").mkdir()
    (whole / "begun" / "manifest.json").write_text(json.dumps({"shards": []}))
    parts = GroupDataset(whole)
    assert parts.shard_names == ("balls/shard-000000.tar", *(f"chairs/{name}" for name in dataset.shard_names))
    assert len(parts) == len(dataset) + 1
    chairs = GroupDataset(whole, shards=parts.shard_names[1:])
    assert chairs.fingerprint == dataset.fingerprint
    assert torch.equal(samples(chairs, 1, start=3)[0], samples(dataset, 1, start=3)[0])
    assert unread_shards(whole) is None
    (whole / "mine").mkdir()
    (whole / "chairs").rename(whole / "mine" / "chairs")  # too deep
    assert GroupDataset(whole).shard_names == ("balls/shard-000000.tar",)
    assert str(unread_shards(whole)).startswith(f"{whole}: shards in mine/chairs are not read: those of the folder it")
    write_shard(whole / "shard-000000.tar", extra)  # beside those of the folder itself
    assert "shards in balls, mine/chairs are not read" in str(unread_shards(whole))
    (whole / "shard-000000.tar").unlink()
    (whole / "mine" / "chairs").rename(whole / "chairs")
    (whole / "chairs" / dataset.shard_names[0]).unlink()
    with pytest.raises(UnirenderError, match=r"chairs: shards .* of the manifest are missing"):
        GroupDataset(whole)


def test_a_folder_above_both_sides_is_no_training_set(folder: Path, tmp_path: Path) -> None:
    """`unirender dataset` makes one folder for each side: the one above them has both."""
    whole = tmp_path / "whole"
    for part, split in {"mine": "train", "mine-test": "test"}.items():
        own = shutil.copytree(folder, whole / part) / "manifest.json"
        own.write_text(json.dumps(json.loads(own.read_text()) | {"config": {"split": split}}))
    with pytest.raises(UnirenderError, match="holds mine-test of --split test and mine of --split train, expected one"):
        ShardSource(whole, 2, seed=0).open()
    assert [split_of(whole / part) for part in ("mine", "mine-test")] == ["train", "test"]
    assert split_of(folder) is None  # shards of one's own
    shutil.copytree(folder, whole / "other")
    (whole / "mine-test" / "manifest.json").unlink()
    assert split_of(whole) == "train"


def test_packing_happens_once(folder: Path, dataset: GroupDataset) -> None:
    packed = sorted((cache_dir() / "packed").iterdir())
    stamps = [path.stat().st_mtime_ns for path in packed]
    GroupDataset(folder)
    assert sorted((cache_dir() / "packed").iterdir()) == packed
    assert [path.stat().st_mtime_ns for path in packed] == stamps


def test_unusable_folders_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=r"no \.tar shard"):
        GroupDataset(tmp_path)
    altered = shutil.copytree(folder, tmp_path / "altered")
    first = next(iter(list_shards(altered)))
    first.write_bytes(first.read_bytes() + bytes(512))
    entry = {"name": first.name, "sha256": "0" * 64}
    (altered / "manifest.json").write_text(json.dumps({"shards": [entry]}))
    with pytest.raises(UnirenderError, match="sha256"):
        GroupDataset(altered)
    first.unlink()
    with pytest.raises(UnirenderError, match="missing"):
        GroupDataset(altered)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[" * 100_000, "not a readable manifest"),
        ('{"shards": ["x"]}', "not a readable manifest"),
        (f'{{"shards": [{{"name": "a", "sha256": "b", "bytes": {"9" * 5000}}}]}}', "not a readable manifest"),
        ('{"shards": [{"name": 5, "sha256": "b"}]}', "shards 5 of the manifest are missing"),
    ],
)
def test_a_manifest_of_another_kind_is_refused(text: str, match: str, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", size=16)
    (folder / "manifest.json").write_text(text)
    with pytest.raises(UnirenderError, match=match):
        GroupDataset(folder)
    assert split_of(folder) is None


def test_a_shard_of_another_size_is_noticed_although_it_was_packed(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", size=16)
    manifest = folder / "manifest.json"
    entries = json.loads(manifest.read_text())["shards"]
    entries = [entry | {"bytes": (folder / entry["name"]).stat().st_size} for entry in entries]
    manifest.write_text(json.dumps({"shards": entries}))
    GroupDataset(folder)
    first = folder / entries[0]["name"]
    first.write_bytes(first.read_bytes()[:-512])
    said = (
        rf"{first.name}: has {entries[0]['bytes'] - 512:,} bytes, expected the {entries[0]['bytes']:,} of the manifest"
    )
    with pytest.raises(UnirenderError, match=said):
        GroupDataset(folder)


def _broken(tmp_path: Path, change) -> Path:
    members = group_members("basis", 16, 1, (40,), (0, 50, 100), 7)
    change(members)
    write_shard(tmp_path / "shard-000000.tar", {"a_g0": members})
    return tmp_path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("shared.exr"), "shared.exr"),
        (lambda m: m.pop("l0.diffuse.exr"), "diffuse"),
        (lambda m: m.pop("l0.m050_r040.exr"), "full basis grid"),
        (lambda m: m.update({"l0.m050_r040.exr": b"no exr"}), "not a readable OpenEXR"),
        (lambda m: m.update({"l0.mystery.exr": b""}), "unknown member"),
        (
            lambda m: m.update({"visible.npy": b""}),
            "has no pictures but visible.npy.* `unirender train-visibility` learns",
        ),
        (lambda m: m.update({"l0.maps.exr": m["l0.m050_r040.exr"]}), "write vary independent"),
    ],
)
def test_broken_groups_are_refused(tmp_path: Path, change, message: str) -> None:
    with pytest.raises(UnirenderError, match=message):
        GroupDataset(_broken(tmp_path, change))


def test_merged_keys_are_refused(tmp_path: Path) -> None:
    """A dot in a key is where WebDataset cuts it: a_0.1 and a_0.2 would become one group."""
    members = group_members("basis", 16, 1, (40,), (0, 50, 100), 7)
    write_shard(tmp_path / "shard-000000.tar", {"a_0.1": members, "b_g0": members, "a_0.2": members})
    with pytest.raises(UnirenderError, match=r"occurs twice|unknown member"):
        GroupDataset(tmp_path)


def test_draws_cover_what_the_config_allows() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw(rng, DEFAULT_AUGMENTATION, lights=4, roughnesses=3) for _ in range(600)]
    assert {len(d.lights) for d in drawn} == {1, 2, 3}
    assert {light for d in drawn for light in d.lights} == {0, 1, 2, 3}
    assert {d.roughness_index for d in drawn} == {0, 1, 2}
    assert {d.turns for d in drawn} == {0, 1, 2, 3}
    assert len({d.order for d in drawn}) == 6
    assert {d.mirror for d in drawn} == {False, True}
    metallic = np.array([d.metallic for d in drawn])
    assert 0 < np.mean(metallic == 0) < 0.1
    assert abs(metallic.mean() - 0.5) < 4 * 0.3 / np.sqrt(len(metallic))
    plain = draw(rng, NO_AUGMENTATION, lights=4, roughnesses=3)
    assert len(plain.lights) == 1
    assert (plain.weights == 1).all()
    assert (plain.order, plain.turns, plain.mirror, plain.exposure_target) == ((0, 1, 2), 0, False, None)
    assert plain.paint is None
    painting = dataclasses.replace(NO_AUGMENTATION, repaint=0.5)
    paints = [draw(rng, painting, lights=4, roughnesses=3, groups=3).paint for _ in range(100)]
    assert set(paints) == {None, 0, 1, 2}


def test_repainted_samples_differ_in_picture_and_albedo_only(dataset: GroupDataset) -> None:
    painting = dataclasses.replace(DEFAULT_AUGMENTATION, repaint=1.0)
    changed = []
    for index in range(12):
        plain, painted = (dataset.sample(index, 5, config) for config in (DEFAULT_AUGMENTATION, painting))
        same = {name: np.array_equal(value, painted[name]) for name, value in plain.items()}
        assert all(equal for name, equal in same.items() if name not in ("image", "albedo")), same
        assert np.isfinite(painted["image"]).all()
        assert painted["image"].min() >= 0
        assert ((painted["albedo"] >= 0) & (painted["albedo"] <= 1)).all()
        changed.append(not same["image"] and not same["albedo"])
    assert sum(changed) >= 6  # the others took their own colour on


def test_turned_environments_agree_with_the_rotation() -> None:
    smooth = np.random.default_rng(0).random((6, 12, 3)).astype(np.float32)
    smooth[0], smooth[-1] = smooth[0].mean(axis=0), smooth[-1].mean(axis=0)  # one radiance at a pole
    environment = resample_environment(smooth, (64, 128))
    turned = turned_environments(environment, (16, 32))
    errors = [
        np.abs(turned[k] - resample_environment(rotate_environment(environment, turn_rotation(k)), (16, 32))).max()
        for k in range(4)
    ]
    assert max(errors) < 0.02, errors
    wrong = resample_environment(rotate_environment(environment, turn_rotation(-1)), (16, 32))
    assert np.abs(turned[1] - wrong).max() > 5 * 0.02


def test_turned_environments_keep_the_energy_of_a_small_sun() -> None:
    rng = np.random.default_rng(1)
    for row, column in zip(rng.integers(3, 61, 6), rng.integers(0, 128, 6), strict=True):
        sun = np.zeros((64, 128, 3), dtype=np.float32)
        sun[row, column] = 1000
        for environment in turned_environments(sun, (16, 32)):
            np.testing.assert_allclose(mean_radiance(environment), mean_radiance(sun), rtol=5e-3)
