"""The data set: its plan, its shards, what a killed run leaves, and what WebDataset reads back."""

import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import webdataset
from inline_executor import Inline

from unirender.cli import main, read_light
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, intrinsics_from_channels, read_exr_bytes
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import GRID, DatasetConfig, basis_shape
from unirender_reference.lights import make_light
from unirender_reference.passes import derive_seed
from unirender_reference.plan import LightPlan, plan_groups
from unirender_reference.render import SceneSpec, scene_hash
from unirender_reference.shapes import make_object
from unirender_reference.shards import shard_name, write_shard

SIZE = 8
SPP = 16


def config(out: Path, objects: int = 2, pairs: int = 3, vary: Any = "basis", **changes: Any) -> DatasetConfig:
    return DatasetConfig(objects, pairs, SIZE, vary, out, **{"spp": SPP, "workers": 1, **changes})


def read_back(folder: Path) -> list[dict[str, bytes]]:
    """Every sample as the WebDataset library delivers it."""
    urls = [str(path) for path in sorted(folder.glob("*.tar"))]
    return list(webdataset.WebDataset(urls, shardshuffle=False))  # pyright: ignore[reportAttributeAccessIssue] - exported lazily


@pytest.mark.parametrize(
    ("pairs", "shape"),
    [(3, (1, 1)), (6, (2, 1)), (12, (2, 2)), (18, (3, 2)), (27, (3, 3)), (36, (4, 3)), (108, (6, 6))],
)
def test_basis_is_nearly_square(pairs: int, shape: tuple[int, int]) -> None:
    assert basis_shape(pairs) == shape


@pytest.mark.parametrize("pairs", [1, 4, 33, 3 * 81])
def test_basis_refuses_other_numbers_of_pairs(pairs: int) -> None:
    with pytest.raises(UnirenderError, match=f"got {pairs} with --vary basis, expected 3 x lights"):
        basis_shape(pairs)


@pytest.mark.parametrize(
    ("vary", "pairs"), [("basis", 27), ("independent", 20), ("one-at-a-time", 20), ("paper", 121), ("sweep", 121)]
)
def test_plan_has_the_pairs_asked_for(vary: str, pairs: int, tmp_path: Path) -> None:
    groups = plan_groups(config(tmp_path, 3, pairs, vary))
    counts = Counter(group.object_seed for group in groups)
    for seed in counts:
        own = [group for group in groups if group.object_seed == seed]
        assert sum(group.samples for group in own) == pairs
        assert [group.number for group in own] == list(range(len(own)))
        for group in own:
            assert 1 <= len(group.lights) <= 8
            assert all(len(set(light.pairs)) == len(light.pairs) for light in group.lights)
    assert [group.index for group in groups] == list(range(len(groups)))
    assert groups[:] == plan_groups(config(tmp_path, 3, pairs, vary))[:]
    fewer = plan_groups(config(tmp_path, 2, pairs, vary))[:]
    assert groups[: len(fewer)] == fewer


def test_roughness_values_of_a_group_are_distinct(tmp_path: Path) -> None:
    """Draws on both sides of a border of strata may round to the same percent: members would then be merged."""
    groups = plan_groups(config(tmp_path, 600, 48))
    levels = np.array([sorted({r for r, _ in group.lights[0].pairs}) for group in groups])
    assert levels.shape == (600, 4)
    assert all(group.samples == 48 for group in groups)
    assert levels[89].tolist() == [25, 26, 60, 94]  # the lower two draws round to 25
    rng = np.random.default_rng(derive_seed(0, "plan", "train", "basis", 88))  # where none collide, they stay
    drawn = np.round((np.arange(4) + rng.random(4)) / 4 * 101 - 0.5)
    assert levels[88].tolist() == drawn.tolist()


def test_a_pair_twice_is_no_plan() -> None:
    with pytest.raises(AssertionError, match="occur twice"):
        LightPlan(0, 0, ((25, 0), (25, 50), (25, 0)))


def test_basis_covers_low_and_high_roughness_evenly(tmp_path: Path) -> None:
    groups = plan_groups(config(tmp_path, 400, 27))
    roughness = np.array([sorted({r for r, _ in group.lights[0].pairs}) for group in groups])
    assert roughness.shape == (400, 3)
    assert all(light.pairs == group.lights[0].pairs for group in groups for light in group.lights)
    assert roughness.min() == 0
    assert roughness.max() == 100
    histogram = np.histogram(roughness, bins=10, range=(0, 100.5))[0] / roughness.size
    assert np.abs(histogram - 0.1).max() < 0.03
    assert ((roughness[:, 0] <= 33) & (roughness[:, 2] >= 67)).all()


def test_paper_sweeps_the_grid_under_a_light_each(tmp_path: Path) -> None:
    groups = plan_groups(config(tmp_path, 1, 121, "paper"))
    lights = [light for group in groups for light in group.lights]
    assert sorted(pair for light in lights for pair in light.pairs) == [(r, m) for r in GRID for m in GRID]
    assert len({light.seed for light in lights}) == 121


def test_one_at_a_time_shares_all_but_one(tmp_path: Path) -> None:
    by_kind: dict[str, list] = {}
    for group in plan_groups(config(tmp_path, 4, 12, "one-at-a-time")):
        by_kind.setdefault(group.shares, []).append(group)
    assert set(by_kind) == {"object material", "object light", "light material"}
    for group in by_kind["object material"]:
        assert len({light.seed for light in group.lights}) == 4
        assert len({light.pairs for light in group.lights}) == 1
    for group in by_kind["object light"]:
        assert len(group.lights) == 1
        assert len(group.lights[0].pairs) == 4
    others = by_kind["light material"]  # the same lights and materials on every object of the block
    assert len({group.lights for group in others}) == 1
    assert len({group.object_seed for group in others}) == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects": 0}, "objects: got 0"),
        ({"pairs": 4}, "pairs: got 4"),
        ({"vary": "paper"}, "expected 121"),
        ({"vary": "one-at-a-time", "pairs": 2}, "at least 3"),
        ({"vary": "one-at-a-time", "pairs": 40000}, "at most 30603"),
        ({"vary": "independent", "pairs": 10202}, "at most 10201"),
        ({"seed": -1}, "seed: got -1"),
        ({"workers": -1}, "workers: got -1"),
        ({"spp": 67}, "use 64 or 70"),
    ],
)
def test_bad_configurations_are_refused(changes: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=message):
        config(tmp_path, **changes)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted data set of two objects under two lights."""
    out = tmp_path_factory.mktemp("whole")
    seen: list[tuple[int, int]] = []
    report = generate(config(out, pairs=6), lambda done, total: seen.append((done, total)), Inline())
    assert seen == [(0, 2), (1, 2), (2, 2)]
    assert (report.groups, report.samples, report.skipped_shards) == (2, 12, 0)
    assert report.overhead >= 1.0
    assert 0 < report.render_seconds <= report.seconds
    return out


def test_every_sample_is_read_back_through_webdataset(whole: Path) -> None:
    samples = read_back(whole)
    manifest = json.loads((whole / "manifest.json").read_text())
    assert len(samples) == manifest["groups"] == 2
    assert len({sample["__key__"] for sample in samples}) == 2
    pictures = 0
    for sample in samples:
        assert str(sample["__key__"]).endswith("_g0")
        record = json.loads(sample["json"])
        assert record["vary"] == "basis"
        assert len(record["lights"]) == 2
        shared = intrinsics_from_channels(read_exr_bytes(sample["shared.exr"])[0])
        assert {"albedo", "normal", "mask"} <= set(shared.present)
        assert shared.height == SIZE
        for index, light in enumerate(record["lights"]):
            environment, attributes = read_exr_bytes(sample[f"l{index}.environment.exr"])
            assert float(attributes["exposure_factor"]) == light["exposure_factor"]
            assert channels_rgb(environment).shape[-1] == 3
            assert channels_rgb(read_exr_bytes(sample[f"l{index}.diffuse.exr"])[0], "diffuse").max() > 0
            for pair in light["pairs"]:
                r, m = round(100 * pair["roughness"]), round(100 * pair["metallic"])
                assert pair["member"] == f"l{index}.m{m:03d}_r{r:03d}.exr"
                assert pair["specular"] == f"l{index}.r{r:03d}.specular.exr"
                specular, about_specular = read_exr_bytes(sample[pair["specular"]])
                image, about_image = read_exr_bytes(sample[pair["member"]])
                assert set(image) == set("RGBA")
                assert (float(about_image["roughness"]), float(about_image["metallic"])) == (r / 100, m / 100)
                assert float(about_specular["roughness"]) == r / 100
                assert "metallic" not in about_specular
                assert np.isfinite(channels_rgb(specular, "specular")).all()
                pictures += 1
    assert pictures == manifest["samples"] == 12
    assert manifest["complete"]


def test_every_file_says_how_it_was_made(whole: Path) -> None:
    """The header attributes that the data contract promises; scene hashes are those of the scenes themselves."""
    plan, first = plan_groups(config(whole, pairs=6))[0], read_back(whole)[0]
    obj, scenes = make_object(plan.object_seed, "train"), set()
    for i, light in enumerate(plan.lights):
        for r, m in light.pairs:
            _, attributes = read_exr_bytes(first[f"l{i}.m{m:03d}_r{r:03d}.exr"])
            spec = SceneSpec(
                obj,
                make_light(light.seed, "train"),
                r / 100,
                m / 100,
                resolution=SIZE,
                exposure_seed=light.exposure_seed,
            )
            assert attributes["scene"] == scene_hash(spec)
            scenes.add(attributes["scene"])
    assert len(scenes) == plan.samples
    promised = {"mitsuba", "variant", "spp", "seed", "scene", "camera"}
    for sample in read_back(whole):
        for name, data in sample.items():
            if name.endswith(".exr"):
                attributes = read_exr_bytes(data)[1]
                assert promised <= set(attributes), name
                assert ("exposure_factor" in attributes) == name.startswith("l"), name


def test_an_environment_is_read_as_the_same_light(whole: Path, tmp_path: Path) -> None:
    data = read_back(whole)[0]["l0.environment.exr"]
    (tmp_path / "light.exr").write_bytes(data)
    np.testing.assert_array_equal(read_light(tmp_path / "light.exr"), channels_rgb(read_exr_bytes(data)[0]))


def test_exposure_maps_the_bright_end_of_d_into_the_stated_range(whole: Path) -> None:
    from unirender.color import luminance
    from unirender.light.exposure import TARGET_RANGE

    for sample in read_back(whole):
        mask = read_exr_bytes(sample["shared.exr"])[0]["mask.Y"]
        for index in range(2):
            diffuse = channels_rgb(read_exr_bytes(sample[f"l{index}.diffuse.exr"])[0], "diffuse")
            level = np.percentile(luminance(diffuse[mask > 0.5]), 90)
            assert TARGET_RANGE[0] * 0.85 < level < TARGET_RANGE[1] * 1.15


def test_same_command_again_renders_nothing(whole: Path) -> None:
    before = (whole / "manifest.json").read_bytes()
    report = generate(config(whole, pairs=6))
    assert (report.groups, report.skipped_shards) == (0, 1)
    assert (whole / "manifest.json").read_bytes() == before


def test_a_damaged_shard_is_made_again(whole: Path) -> None:
    shard = whole / shard_name(0)
    good = shard.read_bytes()
    shard.write_bytes(good[:-1000])
    assert generate(config(whole, pairs=6), executor=Inline()).groups == 2
    assert shard.read_bytes() == good


def test_another_configuration_is_refused(whole: Path) -> None:
    with pytest.raises(UnirenderError, match=r"holds a data set with seed \d instead of 3"):
        generate(config(whole, pairs=6, seed=3))
    with pytest.raises(UnirenderError, match="already holds more objects"):
        generate(config(whole, objects=1, pairs=6))


def test_killed_run_resumes_to_the_same_manifest(whole: Path, tmp_path: Path) -> None:
    """kill -9 while a shard is in flight; the same command then ends at the bytes of an uninterrupted run."""
    script = (
        "import sys\nfrom pathlib import Path\nfrom unirender_reference.dataset import generate\n"
        "from unirender_reference.plan import DatasetConfig\n"
        "if __name__ == '__main__':\n"
        f"    config = DatasetConfig(2, 6, {SIZE}, 'basis', Path(sys.argv[1]), spp={SPP}, workers=1)\n"
        "    generate(config, lambda done, total: print(done, flush=True))\n"
    )
    (tmp_path / "run.py").write_text(script)
    out = tmp_path / "data"
    process = subprocess.Popen([sys.executable, str(tmp_path / "run.py"), str(out)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "1":
            break
    children = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    deadline = time.time() + 30  # orphaned workers end by themselves
    for pid in children.stdout.split():
        while Path(f"/proc/{pid}/cmdline").exists() and time.time() < deadline:
            time.sleep(0.1)
        assert not Path(f"/proc/{pid}/cmdline").exists() or not Path(f"/proc/{pid}/cmdline").read_text()
    assert not list(out.glob("*.tar"))
    (out / ".shard-000000.tar.x.part").write_bytes(b"what a kill during the write leaves")
    assert generate(config(out, pairs=6), executor=Inline()).groups == 2
    assert (out / "manifest.json").read_bytes() == (whole / "manifest.json").read_bytes()
    assert sorted(path.name for path in out.iterdir()) == ["manifest.json", "shard-000000.tar"]


def test_a_lock_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / ".lock").mkdir()
    with pytest.raises(UnirenderError, match=r"\.lock: cannot be made \(Is a directory\); choose another --out"):
        generate(config(tmp_path))


def test_a_file_is_no_folder_for_shards(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    with pytest.raises(UnirenderError, match="file: is a file, expected a folder"):
        generate(config(tmp_path / "file"))
    with pytest.raises(UnirenderError, match="cannot be made"):
        generate(config(tmp_path / "file" / "below"))
    assert (tmp_path / "file").read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (("--workers", "-1"), 2, "workers: got -1"),
        (("--spp", "67"), 2, "use 64 or 70"),
        ((), 1, "is a file"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: tuple[str, ...], status: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("precious")
    with pytest.raises(SystemExit) as stop:
        main(["dataset", "--out", str(tmp_path / "file"), *arguments])
    assert stop.value.code == status
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line
    assert "internal" not in line


def test_keys_with_dots_or_twice_are_refused(tmp_path: Path) -> None:
    for groups in ([("a.b", {"json": b"{}"})], [("a", {"json": b"{}"}), ("a", {"json": b"{}"})]):
        with pytest.raises(UnirenderError, match="expected a new key without dots"):
            write_shard(tmp_path / "shard.tar", groups)
    assert not list(tmp_path.iterdir())


def test_shard_bytes_depend_on_content_only(tmp_path: Path) -> None:
    groups = [("a_g0", {"json": b"{}", "l0.m050_r030.exr": b"x" * 3000})]
    first = write_shard(tmp_path / "one.tar", groups)
    assert write_shard(tmp_path / "two.tar", groups) == first
    with tarfile.open(fileobj=io.BytesIO((tmp_path / "one.tar").read_bytes())) as tar:
        assert [(info.name, info.mtime, info.uid, info.uname) for info in tar] == [
            ("a_g0.json", 0, 0, ""),
            ("a_g0.l0.m050_r030.exr", 0, 0, ""),
        ]
