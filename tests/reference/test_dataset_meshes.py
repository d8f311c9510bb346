"""Data sets of mesh files: what fails is listed and skipped, resume, holdout, own maps; folders of any size."""

import json
import re
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from inline_executor import Inline
from PIL import Image
from stored_groups import Stored
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from unirender.errors import UnirenderError
from unirender.exr import read_exr_bytes
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.groups import read_groups
from unirender_reference.commands import Dataset
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import MAX_TILT_DEG, DatasetConfig
from unirender_reference.dataset_sides import check_sides
from unirender_reference.group import turn_matrix
from unirender_reference.mesh_folder import MeshFile, mesh_folder, pattern_base
from unirender_reference.plan import plan_groups
from unirender_reference.shapes import make_object, signed_volume
from unirender_reference.workers import WorkerDied

SIZE, SPP = 8, 16


def write_solid(path: Path, seed: int = 0) -> None:
    """A box of its own proportions."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sides = np.random.default_rng(seed).uniform(0.4, 1, 3)
    trimesh.creation.box(sides).export(path)


BROKEN = {
    "broken_magic.glb": b"not a mesh at all",
    "broken_nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "broken_index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "sub/broken_cloud.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n0 0 0\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three good files, two of one name in two folders, and four broken ones."""
    base = tmp_path_factory.mktemp("meshes")
    for seed, name in enumerate(("a chair.v2.obj", "model.obj", "sub/model.obj")):
        write_solid(base / name, seed)
    for name, data in BROKEN.items():
        (base / name).write_bytes(data)
    (base / "readme.txt").write_text("no mesh")
    return base


def config(out: Path, meshes: str | Path | None, **changes: Any) -> DatasetConfig:
    options: dict[str, Any] = {
        "objects": None,
        "pairs": 3,
        "resolution": SIZE,
        "vary": "basis",
        "spp": SPP,
        "workers": 1,
    }
    return DatasetConfig(out=out, meshes=meshes, **{**options, **changes})


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set of the folder."""
    out = tmp_path_factory.mktemp("whole")
    report = generate(config(out, folder), executor=Inline())
    assert (report.groups, report.samples) == (3, 9)
    assert sorted(failure.file for failure in report.failures) == sorted(BROKEN)
    return out


def test_good_files_are_rendered_and_broken_ones_listed_with_reasons(whole: Path, folder: Path) -> None:
    lines = [json.loads(line) for line in (whole / "failures.jsonl").read_text().splitlines()]
    assert [line["file"] for line in lines] == [name for name in mesh_folder(folder).names if name in BROKEN]
    assert len({line["reason"] for line in lines}) == 4
    for line in lines:
        assert str(folder) not in line["reason"]
        assert len(line["reason"]) > 20
    groups = dict(read_groups(whole / "shard-000000.tar"))
    records = {json.loads(members["json"])["file"]: key for key, members in groups.items()}
    assert set(records) == {"a chair.v2.obj", "model.obj", "sub/model.obj"}
    for file, key in records.items():
        assert key == MeshFile(folder / file, file).key + "_g0"
        assert "." not in key
    assert len(GroupDataset(whole)) == 3
    manifest = json.loads((whole / "manifest.json").read_text())
    assert manifest["config"]["meshes"] is True  # not where they were
    assert [failure["file"] for failure in manifest["shards"][0]["failures"]] == [line["file"] for line in lines]


def test_an_interrupted_run_ends_at_the_same_bytes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Failed files of a finished shard are not tried again."""
    monkeypatch.setattr("unirender_reference.dataset.SHARD_GROUPS", 2)
    once = generate(config(tmp_path / "once", folder), executor=Stored())
    begun: list[str] = []

    def stop_at_the_sixth(_: DatasetConfig, plan: Any) -> None:
        begun.append(plan.mesh.name)
        if len(begun) == 6:
            raise RuntimeError("pulled the plug")

    with pytest.raises(RuntimeError, match="pulled the plug"):
        generate(config(tmp_path / "twice", folder), executor=Stored(stop_at_the_sixth))
    stored = json.loads((tmp_path / "twice" / "manifest.json").read_text())["shards"]
    assert len(stored) == 2
    executor = Stored()
    again = generate(config(tmp_path / "twice", folder), executor=executor)
    assert executor.begun == 7 - 2 * len(stored)
    assert again.failures == once.failures
    for name in ("manifest.json", "failures.jsonl"):
        assert (tmp_path / "twice" / name).read_bytes() == (tmp_path / "once" / name).read_bytes()


def test_a_turned_object_is_the_mesh_turned(tmp_path: Path) -> None:
    """Against a file with the vertices where they came to lie, seen from the front."""
    before, after = tmp_path / "before", tmp_path / "after"
    write_solid(before / "box.obj")

    def group(meshes: Path, out: str, **changes: Any) -> tuple[str, dict[str, Any], np.ndarray]:
        generate(config(tmp_path / out, meshes, resolution=16, spp=64, **changes), executor=Inline())
        ((key, members),) = read_groups(tmp_path / out / "shard-000000.tar")
        shared, _ = read_exr_bytes(members["shared.exr"])
        normal = np.stack([shared[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
        return key, json.loads(members["json"]), normal

    key, record, normal = group(before, "turned", turn_objects=True, seed=5)
    said = re.fullmatch(r"(\S+) degrees about \+y, then (\S+) about \+x", record["object_provenance"]["turned"])
    assert said is not None
    yaw, tilt = float(said[1]), float(said[2])
    assert 0 <= yaw < 360
    assert abs(tilt) <= MAX_TILT_DEG
    mesh = trimesh.load(before / "box.obj", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.vertices = mesh.vertices @ turn_matrix(yaw, tilt).T
    after.mkdir()
    mesh.export(after / "box.obj")
    plain_key, plain, expected = group(after, "by-hand", seed=5)
    assert np.abs(normal - expected).mean() < 0.01
    _, _, frontal = group(before, "frontal", seed=5)
    assert np.abs(normal - frontal).mean() > 0.05
    assert "turned" not in plain["object_provenance"]
    assert key == plain_key.replace("_g0", "-turned5000000_g0")
    _, other, _ = group(before, "another-seed", turn_objects=True, seed=6)
    assert other["object_provenance"]["turned"] != record["object_provenance"]["turned"]


def test_turning_is_yaw_and_then_tilt() -> None:
    assert np.allclose(turn_matrix(90, 0) @ [0, 0, 1], [1, 0, 0])
    assert np.allclose(turn_matrix(0, 90) @ [0, 1, 0], [0, 0, 1])
    assert np.allclose(turn_matrix(90, 90) @ [0, 1, 0], [0, 0, 1])
    obj = make_object(0, "train")
    assert np.allclose(obj.turned(turn_matrix(360, 0)).vertices, obj.vertices, atol=1e-6)
    turned, volume = obj.turned(turn_matrix(30, 10)), signed_volume(obj.vertices, obj.faces)
    assert signed_volume(turned.vertices, turned.faces) == pytest.approx(volume, rel=1e-4)
    with pytest.raises(UnirenderError, match="expected the matrix of a rotation"):
        obj.turned(np.diag([1.0, 1.0, -1.0]))


def test_data_sets_that_are_older_than_the_option_go_on(tmp_path: Path) -> None:
    assert "turn_objects" not in config(tmp_path, None).content()
    assert config(tmp_path, None, turn_objects=True).content()["turn_objects"] is True


def test_the_same_command_again_says_the_failures_again(
    whole: Path, folder: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (whole / "manifest.json").read_bytes()
    (whole / "failures.jsonl").unlink()
    assert Dataset(out=whole, meshes=str(folder), pairs=3, resolution=SIZE, spp=SPP).run() == 1
    assert "complete already" in capsys.readouterr().out
    for name in BROKEN:
        assert f"{name}: " in caplog.text
    assert "4 files failed" in caplog.text
    assert (whole / "manifest.json").read_bytes() == before
    assert (whole / "failures.jsonl").is_file()


def test_a_changed_folder_is_noticed(tmp_path: Path) -> None:
    meshes = tmp_path / "meshes"
    for seed in range(2):
        write_solid(meshes / f"b{seed}.obj", seed)
    generate(config(tmp_path / "out", meshes), executor=Stored())
    with (meshes / "b1.obj").open("a") as stream:
        stream.write("# repaired\n")
    with pytest.raises(
        UnirenderError, match=r"shard-000000\.tar was made from other files .* delete shard-000000\.tar"
    ):
        generate(config(tmp_path / "out", meshes), executor=Stored())
    (tmp_path / "out" / "shard-000000.tar").unlink()
    assert generate(config(tmp_path / "out", meshes), executor=Stored()).groups == 2
    write_solid(meshes / "b2.obj", 2)  # at the end: the last shard grows
    assert generate(config(tmp_path / "out", meshes), executor=Stored()).groups == 3
    assert generate(config(tmp_path / "out", meshes), executor=Stored()).groups == 0
    write_solid(meshes / "a.obj", 3)
    with pytest.raises(UnirenderError, match=r"made from other files"):
        generate(config(tmp_path / "out", meshes, objects=3), executor=Stored())


def test_a_file_that_kills_its_worker_is_listed(folder: Path, tmp_path: Path) -> None:
    def die(_: DatasetConfig, plan: Any) -> None:
        if plan.mesh is None or plan.mesh.name == "model.obj":
            raise WorkerDied("the worker died")

    report = generate(config(tmp_path / "out", str(folder / "*model.obj")), executor=Stored(die))
    assert [(failure.file, failure.reason) for failure in report.failures] == [("model.obj", "the worker died")]
    assert len(json.loads((tmp_path / "out" / "manifest.json").read_text())["shards"]) == 1
    with pytest.raises(UnirenderError, match="the worker died; complete shards are kept"):  # no file to blame
        generate(config(tmp_path / "none", None, objects=1), executor=Stored(die))


def test_groups_are_stored_as_they_come(tmp_path: Path) -> None:
    """The parent holds the groups under way, not a shard: the tar grows with each."""
    for seed in range(6):
        write_solid(tmp_path / "meshes" / f"{seed}.obj", seed)
    sizes: list[int] = []

    def look(*_: object) -> None:
        sizes.append(sum(path.stat().st_size for path in (tmp_path / "out").glob(".shard*.part")))

    generate(config(tmp_path / "out", tmp_path / "meshes"), executor=Stored(look))
    assert sizes[0] == 0
    assert sizes[-1] > 0
    assert not list((tmp_path / "out").glob(".*"))


def test_a_render_that_fails_otherwise_does_not_blame_the_disk(folder: Path, tmp_path: Path) -> None:
    def lose(*_: object) -> None:
        raise ConnectionError("the scheduler is gone")

    with pytest.raises(UnirenderError, match=r"a render failed \(the scheduler is gone"):
        generate(config(tmp_path / "out", folder), executor=Inline(lose))
    assert not (tmp_path / "out").exists()


def test_a_shard_in_which_every_file_failed(tmp_path: Path) -> None:
    (tmp_path / "bad.obj").write_bytes(b"")
    report = generate(config(tmp_path / "out", tmp_path), executor=Inline())
    assert (report.groups, len(report.failures)) == (0, 1)
    executor = Inline()
    assert generate(config(tmp_path / "out", tmp_path), executor=executor).failures == report.failures
    assert executor.begun == 0
    with pytest.raises(UnirenderError, match="only shards without groups"):
        GroupDataset(tmp_path / "out")


@pytest.mark.parametrize("holdout", [2, 3, 5])
def test_holdout_divides_the_files(holdout: int, tmp_path: Path) -> None:
    for number in range(17):
        path = tmp_path / f"{number % 3}" / f"model{number:02d}.obj"
        path.parent.mkdir(exist_ok=True)
        path.touch()
    everything = list(mesh_folder(tmp_path).names)
    train, test = (list(mesh_folder(tmp_path, split, holdout).names) for split in ("train", "test"))
    assert not set(train) & set(test)
    assert sorted(train + test) == sorted(everything)
    assert test == everything[holdout - 1 :: holdout]
    assert list(mesh_folder(tmp_path, "test", 0).names) == everything
    assert list(mesh_folder(tmp_path, "train", holdout, limit=2).names) == train[:2]
    with pytest.raises(UnirenderError, match="no mesh files for --split test with --holdout 40"):
        mesh_folder(tmp_path, "test", 40)


def test_one_model_in_two_formats_is_not_divided(tmp_path: Path) -> None:
    """Files stand in order of name, so its formats are neighbours, which may belong to different sides."""
    for name in ("bed/bed.glb", "bed/bed.obj", "chair/chair.glb", "chair/chair.obj", "chair/chair2.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(UnirenderError, match=r"bed: bed\.glb and bed\.obj look like one model in two formats"):
        check_sides(tmp_path, 2)
    with pytest.raises(UnirenderError, match="look like one model in two formats"):
        plan_groups(DatasetConfig(None, 3, 16, "basis", tmp_path / "out", meshes=tmp_path, holdout=2))
    check_sides(f"{tmp_path}/**/*.obj", 2)
    check_sides(tmp_path, 5)  # both formats of each are on one side
    check_sides(tmp_path, 0)


def test_mixes_of_the_same_meshes_are_not_divided(tmp_path: Path) -> None:
    """Every mesh is a part of several mixes, so that holding mixes out holds out no mesh."""
    for number in range(4):
        path = tmp_path / "all" / "mixed" / f"mix-0-{number:05d}" / "mix.obj"
        path.parent.mkdir(parents=True)
        path.touch()
    (tmp_path / "all" / "own.obj").touch()
    check_sides(tmp_path / "all", 2)
    (tmp_path / "all" / "mixed" / "mix.json").touch()
    for pattern in (tmp_path / "all", tmp_path / "all" / "mixed", f"{tmp_path}/all/mixed/*/*.obj"):
        with pytest.raises(UnirenderError, match="mixed: --holdout would divide mixes"):
            check_sides(pattern, 2)
        check_sides(pattern, 0)


def test_keys_are_unique_and_fit_into_a_tar() -> None:
    names = ["a/model.obj", "b/model.obj", "c.d/x.y.glb", "Ω/ø.ply", "-.obj", f"{'long' * 40}.obj", "a/model.ply"]
    keys = [MeshFile(Path(name), name).key for name in names]
    assert len(set(keys)) == len(keys)
    for key in keys:
        assert key.isascii()
        assert not set(key) & set("./ ")
        assert len(f"{key}_g99.l7.m100_r100.specular.exr") <= 100


def test_names_count_from_the_folder_of_a_pattern(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_solid(tmp_path / "in" / "deep" / "a.obj")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    absolute = tmp_path / "in"
    for pattern, name in (
        ("in", "deep/a.obj"),
        (absolute, "deep/a.obj"),
        ("in/**/*.obj", "deep/a.obj"),
        ("in/d*/a.obj", "deep/a.obj"),
        ("in/deep/a.obj", "a.obj"),
    ):
        found = mesh_folder(pattern)
        assert list(found.names) == [name]
        assert found[0].path.is_file()
        assert found[0].path.is_absolute()
    assert pattern_base("in/**/*.obj") == absolute
    with pytest.raises(UnirenderError):
        mesh_folder(tmp_path / "missing")


def test_nothing_is_opened_before_its_turn(tmp_path: Path) -> None:
    """A large folder costs its names: no file is read ahead, and groups are planned when they are rendered."""
    for number in range(2000):
        (tmp_path / f"{number:06d}.obj").touch()
    seen: list[tuple[int, int]] = []

    class Stop(Exception):
        pass

    def progress(done: int, total: int) -> None:
        seen.append((done, total))
        if done == 5:
            raise Stop

    executor = Inline()
    with pytest.raises(Stop):
        generate(config(tmp_path / "out", tmp_path), progress, executor)
    assert seen[0] == (0, 2000)
    assert executor.begun < 10


def test_memory_of_a_plan_is_that_of_its_names(tmp_path: Path) -> None:
    sizes = {}
    for count in (100, 4000):
        base = tmp_path / str(count)
        base.mkdir()
        for number in range(count):
            (base / f"{number:06d}.obj").touch()
        tracemalloc.start()
        plan = plan_groups(config(tmp_path / "out", base))
        for index in range(0, len(plan), max(len(plan) // 50, 1)):
            assert plan[index].mesh is not None
        sizes[count] = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        assert len(plan) == count
    assert (sizes[4000] - sizes[100]) / 3900 < 150, "bytes a file; its name takes about 60"


def write_textured(path: Path) -> None:
    """A glTF box whose metallic-roughness texture has four quarters (G roughness, B metallic)."""
    box = trimesh.creation.box()
    corners = np.arange(3 * len(box.faces)).reshape(-1, 3)
    box = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), corners, process=False)
    texture = np.zeros((4, 4, 3), np.uint8)
    texture[:2, :, 1], texture[2:, :, 1] = 60, 220
    texture[:, :2, 2], texture[:, 2:, 2] = 0, 255
    uv = np.tile(np.array([[0.05, 0.05], [0.95, 0.05], [0.5, 0.95]]), (len(box.faces), 1))
    material = PBRMaterial(metallicRoughnessTexture=Image.fromarray(texture), metallicFactor=1.0, roughnessFactor=1.0)
    box.visual = TextureVisuals(uv=uv, material=material)
    box.export(path)


def test_objects_with_maps_of_their_own(tmp_path: Path) -> None:
    write_textured(tmp_path / "box.glb")
    write_solid(tmp_path / "plain.obj")
    own = config(tmp_path / "out", tmp_path, vary="independent", materials="maps", pairs=2, resolution=16)
    report = generate(own, executor=Inline())
    assert (report.groups, report.samples) == (1, 2)
    (failure,) = report.failures
    assert failure.file == "plain.obj"
    assert "no roughness and metallic of its own" in failure.reason
    ((_, members),) = read_groups(tmp_path / "out" / "shard-000000.tar")
    assert {name for name in members if name.startswith("l0")} == {
        "l0.environment.exr",
        "l0.diffuse.exr",
        "l0.maps.specular.exr",
        "l0.maps.exr",
    }
    shared = read_exr_bytes(members["shared.exr"])[0]
    inside = shared["mask.Y"] > 0.99
    assert np.ptp(shared["roughness.Y"][inside]) > 0.4
    assert np.ptp(shared["metallic.Y"][inside]) > 0.7
    assert json.loads(members["json"])["materials"] == "maps"
    data = GroupDataset(tmp_path / "out")
    assert len(data) == 2
    _, intrinsics = data.stored(0, data.pairs(0)[0])
    assert intrinsics.roughness is not None
    np.testing.assert_allclose(intrinsics.roughness[..., 0], shared["roughness.Y"], atol=1e-3)


def test_scalar_materials_take_the_place_of_the_objects_own(tmp_path: Path) -> None:
    write_textured(tmp_path / "box.glb")
    report = generate(config(tmp_path / "out", tmp_path), executor=Inline())
    assert (report.groups, len(report.failures)) == (1, 0)
    ((_, members),) = read_groups(tmp_path / "out" / "shard-000000.tar")
    assert "roughness.Y" not in read_exr_bytes(members["shared.exr"])[0]
    assert sum(name.startswith("l0.m") for name in members) == 3


@pytest.mark.slow
def test_the_command_with_its_own_workers(folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """End to end; equal bytes whoever renders."""
    out = tmp_path / "out"
    assert Dataset(out=out, meshes=str(folder), pairs=3, resolution=SIZE, spp=SPP, workers=2).run() == 1
    assert "4 files failed" in caplog.text
    generate(config(tmp_path / "inline", folder), executor=Inline())
    for name in ("manifest.json", "failures.jsonl", "shard-000000.tar"):
        assert (out / name).read_bytes() == (tmp_path / "inline" / name).read_bytes()
