"""A data set under the user's own lights: shares, sides, as they are, their size, and files that are none."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes
import trimesh
from inline_executor import Inline

from unirender.cli import main
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr_bytes, write_exr
from unirender.training.data.groups import read_groups
from unirender_reference.commands import Dataset
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.exposure import scene_exposure
from unirender_reference.faults import ObjectFault
from unirender_reference.group import reaching_light
from unirender_reference.lights import Placement, bundled_light, light_pool, load_light, make_light
from unirender_reference.passes import Estimate
from unirender_reference.plan import plan_groups
from unirender_reference.render import Renderer
from unirender_reference.shapes import make_object

SIZE, SPP = 8, 16


def config(out: Path, lights: Path | None, **changes: Any) -> DatasetConfig:
    options: dict[str, Any] = {"objects": 1, "pairs": 4, "vary": "independent", "spp": SPP, "workers": 1}
    return DatasetConfig(out=out, lights=lights, resolution=SIZE, **{**options, **changes})


def made(out: Path, lights: Path, **changes: Any) -> list[tuple[dict[str, Any], np.ndarray]]:
    """The lights of a data set generated in this process: record and stored map of each."""
    generate(config(out, lights, **changes), executor=Inline())
    return [
        (light, channels_rgb(read_exr_bytes(members[f"l{i}.environment.exr"])[0]))
        for path in sorted(out.glob("*.tar"))
        for _, members in read_groups(path)
        for i, light in enumerate(json.loads(members["json"])["lights"])
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three maps of 128 x 256 texels: noise in blocks, so that turning and size show."""
    path = tmp_path / "my lights"
    path.mkdir()
    rng = np.random.default_rng(0)
    for number in range(3):
        radiance = rng.random((16, 32, 3)).astype(np.float32).repeat(8, 0).repeat(8, 1)
        write_exr(path / f"mine{number}.exr", {name: radiance[..., i] for i, name in enumerate("RGB")}, half=False)
    return path


@pytest.mark.long
def test_half_of_the_lights_or_all_or_those_of_another_side(folder: Path, tmp_path: Path) -> None:
    half = [light["provenance"]["kind"] for light, _ in made(tmp_path / "half", folder, pairs=8)]
    assert 0 < half.count("pool") < len(half)
    everything = made(tmp_path / "all", folder, light_share=1.0, light_holdout=2)
    assert {light["provenance"]["kind"] for light, _ in everything} == {"pool"}
    assert {light["provenance"]["file"] for light, _ in everything} == {"mine0.exr", "mine2.exr"}
    test = made(tmp_path / "test", folder, light_share=1.0, light_holdout=2, split="test")
    assert {light["provenance"]["file"] for light, _ in test} == {"mine1.exr"}
    assert all(np.shape(environment) == (64, 128, 3) for _, environment in [*everything, *test])


def test_the_manifest_holds_what_lights_were_drawn_with(folder: Path, tmp_path: Path) -> None:
    out, own = tmp_path / "out", {"light_share": 1.0}
    made(out, folder, **own)
    found = json.loads((out / "manifest.json").read_text())["config"]
    named = {key: found[key] for key in ("light_share", "light_holdout", "turn_lights", "light_height")}
    assert named == {"light_share": 1.0, "light_holdout": 8, "turn_lights": True, "light_height": 64}
    assert generate(config(out, folder, **own), executor=Inline()).groups == 0
    for change in ({"light_height": 32}, {"turn_lights": False}):
        with pytest.raises(UnirenderError, match=rf"{next(iter(change))} .* instead of"):
            generate(config(out, folder, **own, **change), executor=Inline())
    (folder / "mine2.exr").unlink()
    with pytest.raises(UnirenderError, match=r"lights .* instead of"):
        generate(config(out, folder, **own), executor=Inline())


def test_the_original_file_gives_the_stored_map(folder: Path, tmp_path: Path) -> None:
    """Its provenance says how it was turned, mirrored and tilted."""
    height = 128
    stored = made(tmp_path / "out", folder, pairs=8, light_share=1.0, light_height=height)
    assert len({json.dumps(light["provenance"]) for light, _ in stored}) == 8
    assert {light["provenance"]["mirrored"] for light, _ in stored} == {"yes", "no"}
    for light, environment in stored:
        assert environment.shape == (height, 2 * height, 3)
        original = load_light(folder / light["provenance"]["file"], shape=(height, 2 * height)).environment
        placed = Placement.parse(light["provenance"]).apply(original)
        tolerance = 0.01 * environment.max()  # the mean of a tilted map is 1 again only after scaling
        np.testing.assert_allclose(placed * light["exposure_factor"], environment, rtol=0, atol=tolerance)
        assert np.abs(np.roll(placed, 8, axis=1) * light["exposure_factor"] - environment).max() > 5 * tolerance


def test_a_tilt_is_said_and_done_again() -> None:
    tilted = [light for seed in range(80) if "tilt_deg" in (light := make_light(seed, "train")).provenance]
    assert len(tilted) >= 2
    for light in tilted:
        source = bundled_light(light.name.split("-", 2)[2]).environment
        placement = Placement.parse(light.provenance)
        assert 0 < abs(placement.tilt_deg) <= 20
        ratio = light.environment.sum() / placement.apply(source).sum()
        np.testing.assert_allclose(placement.apply(source) * ratio, light.environment, rtol=1e-3, atol=1e-3)
        level = Placement(placement.yaw_columns, placement.columns, placement.mirrored).apply(source)
        assert np.abs(level - light.environment).max() > 0.1
        assert Placement.parse(placement.provenance()).provenance().keys() == placement.provenance().keys()
    with pytest.raises(UnirenderError, match="expected yaw_columns"):
        Placement.parse({"kind": "gradient"})


def test_lights_as_they_are(folder: Path, tmp_path: Path) -> None:
    for light, environment in made(tmp_path / "out", folder, light_share=1.0, turn_lights=False, light_height=128):
        own = load_light(folder / light["provenance"]["file"]).environment
        np.testing.assert_allclose(environment, own * light["exposure_factor"], rtol=1e-5)
        assert "yaw_columns" not in light["provenance"]


def test_files_that_are_no_lights_are_named_by_their_place_in_the_folder(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(6):
        (folder / f"bad{number}.hdr").write_bytes(b"hello")
    out = tmp_path / "out"
    lights = [light for light, _ in made(out, folder, light_share=1.0)]
    skipped = {line for light in lights for line in light["provenance"].get("skipped", "").splitlines()}
    assert skipped
    assert all(line.startswith("bad") and ".hdr: not a readable" in line for line in skipped)
    data = (out / "shard-000000.tar").read_bytes() + (out / "manifest.json").read_bytes()
    assert str(tmp_path).encode() not in data
    shard = json.loads((out / "manifest.json").read_text())["shards"][0]
    assert shard["unreadable_lights"] == sorted(skipped)
    options: dict[str, Any] = {"objects": 1, "pairs": 4, "vary": "independent", "resolution": SIZE, "spp": SPP}
    assert Dataset(out=out, lights=folder, light_share=1.0, **options).run() == 0  # complete already: said again
    assert f"{len(skipped)} files of --lights are no lights" in caplog.text
    assert "bad" in caplog.text
    moved = folder.rename(tmp_path / "elsewhere")
    made(tmp_path / "moved", moved, light_share=1.0)
    assert (tmp_path / "moved" / "shard-000000.tar").read_bytes() == (out / "shard-000000.tar").read_bytes()


def write_back_light(folder: Path) -> None:
    """Black but for what stands right behind the object."""
    radiance = np.zeros((64, 128), np.float32)
    radiance[32, [0, 127]] = 1
    write_exr(folder / "back.exr", dict.fromkeys("RGB", radiance), half=False)


def test_a_light_that_does_not_reach_the_object_gives_way_to_another(folder: Path, tmp_path: Path) -> None:
    """And a second run has the same bytes."""
    write_back_light(folder)
    own: dict[str, Any] = {"light_share": 1.0, "turn_lights": False, "pairs": 8}
    lights = [light["provenance"] for light, _ in made(tmp_path / "out", folder, **own)]
    assert {light["file"] for light in lights} <= {"mine0.exr", "mine1.exr", "mine2.exr"}
    passed = [light for light in lights if light.get("not_reaching") == "back.exr"]
    assert 0 < len(passed) < len(lights)
    made(tmp_path / "again", folder, **own)
    first, second = (tmp_path / name / "shard-000000.tar" for name in ("out", "again"))
    assert first.read_bytes() == second.read_bytes()


def test_a_light_that_reaches_is_the_drawn_one(folder: Path, tmp_path: Path) -> None:
    own = config(tmp_path / "out", folder, light_share=1.0)
    plan = plan_groups(own)[0]
    renderer = Renderer(make_object(plan.object_seed, "train"), resolution=SIZE)
    light = make_light(plan.lights[0].seed, "train", own.light_pool())
    found, factor = reaching_light(own, plan.lights[0], light, renderer)
    assert found is light
    assert factor == scene_exposure(renderer, light.environment, plan.lights[0].exposure_seed)


@pytest.mark.parametrize("from_meshes", [False, True])
def test_a_light_that_reaches_nothing_ends_the_run_and_blames_no_mesh(tmp_path: Path, from_meshes: bool) -> None:
    folder, meshes = tmp_path / "lights", tmp_path / "meshes"
    folder.mkdir()
    meshes.mkdir()
    write_back_light(folder)
    trimesh.creation.box().export(meshes / "box.obj")
    changes: dict[str, Any] = {"objects": None, "meshes": meshes} if from_meshes else {}
    name = "box-[0-9a-f]+" if from_meshes else "train-000000"
    own = config(tmp_path / "out", folder, light_share=1.0, turn_lights=False, **changes)
    with pytest.raises(UnirenderError, match=rf"^dataset: light back\.exr does not reach {name}, .*shards are kept$"):
        generate(own, executor=Inline())


class BlackBall(Renderer):
    """Of what no light reaches."""

    def diffuse(self, environment: np.ndarray, spp: int, seed: int = 0, batches: int = 1) -> Estimate:
        found = super().diffuse(environment, spp, seed, batches)
        return dataclasses.replace(found, mean=0 * found.mean)


def test_a_sun_too_bright_for_half_precision_is_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mirror under a sun of one texel shows that in pictures of 256 pixels; the message named no light."""

    def dazzled(*_: Any, **__: Any) -> Estimate:
        return Estimate(np.full((SIZE, SIZE, 3), 1e5, np.float32), None)

    monkeypatch.setattr(Renderer, "specular", dazzled)
    said = r"specular of train-\d+ under the light \S*mine\d\S* reaches 1e\+05, .*; give fewer rows as --light-height"
    with pytest.raises(UnirenderError, match=said):
        made(tmp_path / "out", folder, light_share=1.0)


def test_an_object_that_an_even_light_does_not_reach_is_to_blame() -> None:
    ball = scenes.sphere(subdivisions=2)
    assert scene_exposure(Renderer(ball, resolution=SIZE), scenes.environment(), 0) > 0
    with pytest.raises(ObjectFault, match="even under a light from everywhere"):
        scene_exposure(BlackBall(ball, resolution=SIZE), scenes.environment(), 0)


def test_only_bad_files_leave_no_folder(tmp_path: Path) -> None:
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.png").write_bytes(b"hello")
    with pytest.raises(UnirenderError, match=r"none of 1 train files drawn is a light.*a\.png"):
        generate(config(tmp_path / "new" / "out", tmp_path / "bad"), executor=Inline())
    assert [path.name for path in tmp_path.iterdir()] == ["bad"]
    (tmp_path / "kept").mkdir()
    with pytest.raises(UnirenderError, match="none of 1 train files"):
        generate(config(tmp_path / "kept", tmp_path / "bad"), executor=Inline())
    assert (tmp_path / "kept").is_dir()


def test_a_side_without_lights_leaves_no_folder(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out"
    with pytest.raises(SystemExit) as stop:
        main(["dataset", "--out", str(out), "--split", "test", "--lights", str(folder)])
    assert stop.value.code == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "for the test side, expected at least 8 places (one in 8 is for test), got 3" in said
    assert "lower --light-holdout" in said
    assert "to at most 3" in said
    assert not out.parent.exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"light_share": 0.0}, "--light-share: got 0"),
        ({"light_share": 1.5}, "--light-share: got 1.5"),
        ({"light_holdout": 1}, "--light-holdout: got 1, expected at least 2"),
        ({"light_height": 4}, "--light-height: got 4, expected 16 to 2048"),
        ({"light_height": 4096}, "--light-height: got 4096"),
    ],
)
def test_wrong_numbers_name_their_option(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=message):
        config(tmp_path, tmp_path, **changes)


def test_options_of_lights_need_lights(tmp_path: Path) -> None:
    for change, option in (({"light_share": 1.0}, "--light-share"), ({"turn_lights": False}, "--no-turn-lights")):
        with pytest.raises(UnirenderError, match=f"{option}: got it without --lights"):
            config(tmp_path, None, **change)


def test_a_pool_without_turning_leaves_the_built_in_lights_alone(folder: Path) -> None:
    plain, pool = (light_pool(folder, "train", share=0.5, turn=turn) for turn in (True, False))
    kinds = set()
    for seed in range(12):
        light, turned = make_light(seed, "train", pool), make_light(seed, "train", plain)
        kinds.add(light.provenance["kind"])
        same = np.array_equal(light.environment, turned.environment)
        assert same == (light.provenance["kind"] != "pool")
    assert len(kinds) > 1


@pytest.mark.long
@pytest.mark.slow
def test_the_gauge_keeps_pictures_between_black_and_white() -> None:
    """Random objects, lights and materials; under lights four times as bright more of them is clipped."""
    rng, shares = np.random.default_rng(1), []
    for seed in range(5):
        renderer = Renderer(make_object(seed, "train"), resolution=32)
        for light in (make_light(3 * seed + i, "train").environment for i in range(3)):
            lit = (light * scene_exposure(renderer, light, seed)).astype(np.float32)
            metallic, roughness = rng.uniform(0, 1, 2)
            image = renderer.image(lit, metallic, roughness, 32, batches=1).mean
            inside = image[image[..., 3] > 0.5]
            brightest = inside[:, :3].max(axis=1) / inside[:, 3]
            shares.append([(brightest > 1).mean(), (4 * brightest > 1).mean(), (brightest < 0.001).mean()])
    clipped, too_bright, black = np.median(shares, axis=0)
    assert clipped < 0.05 < too_bright
    assert black < 0.02
