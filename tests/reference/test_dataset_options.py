"""What changes the pictures of a data set: the sweep, own maps, the noise floor, denoising, a user's lights."""

import importlib.util
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inline_executor import Inline

from unirender.color import image_srgb
from unirender.errors import UnirenderError, UsageError
from unirender.exr import channels_rgb, read_exr_bytes
from unirender.training.augmentations.augment import METALLIC_NODES, interpolate_metallic
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.groups import read_groups
from unirender_reference.commands import Dataset
from unirender_reference.dataset import generate, render_group
from unirender_reference.dataset_config import GRID, DatasetConfig
from unirender_reference.plan import plan_groups

SIZE, SPP = 8, 16
DEFAULTS = {entry.name: entry.default for entry in fields(DatasetConfig)}
DENOISER = importlib.util.find_spec("mitsuba_oidn") is not None


def config(out: Path, **changes: Any) -> DatasetConfig:
    options: dict[str, Any] = {"objects": 1, "pairs": 3, "resolution": SIZE, "vary": "basis", "spp": SPP, "workers": 1}
    return DatasetConfig(out=out, **{**options, **changes})


def made(out: Path, **changes: Any) -> list[dict[str, bytes]]:
    """The groups of a data set, generated in this process."""
    generate(config(out, **changes), executor=Inline())
    return [members for path in sorted(out.glob("*.tar")) for _, members in read_groups(path)]


def picture(members: dict[str, bytes], name: str) -> tuple[np.ndarray, dict[str, str]]:
    channels, attributes = read_exr_bytes(members[name])
    return channels_rgb(channels), attributes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vary": "sweep", "pairs": 120}, "expected 121 with --vary sweep"),
        ({"materials": "maps"}, "vary: got basis, but --materials maps needs --vary independent"),
        ({"holdout": 3}, "holdout: got 3"),
        ({"holdout": 1, "meshes": "x"}, "holdout: got 1"),
        ({"holdout": -2, "meshes": "x"}, "holdout: got -2"),
        ({"noise_floor": 0.0}, "noise floor: got 0.0 dB"),
        ({"noise_floor": 90.0}, "noise floor: got 90.0 dB"),
        ({"noise_floor": 40.0, "vary": "sweep", "pairs": 121}, "noise floor: got one with --vary sweep"),
        ({"denoise": True, "split": "test"}, "denoise: got --split test, expected train"),
        ({"denoise": True, "noise_floor": 40.0}, "denoise: got a noise floor too"),
    ],
)
def test_contradictions_are_refused(changes: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=message):
        config(tmp_path, **changes)


def test_the_objects_of_the_suites_are_named_as_such(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What is fitted to them would be tested on them."""
    (tmp_path / "file").touch()
    nowhere = tmp_path / "file" / "data"
    others = Dataset(out=nowhere, split="test", seed=1), Dataset(out=nowhere)
    for dataset, said in ((Dataset(out=nowhere, split="test"), True), *((other, False) for other in others)):
        caplog.clear()
        with pytest.raises(UnirenderError):  # nothing is rendered
            dataset.run()
        assert ("has the objects of the bundled suites" in caplog.text) == said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"denoise": True, "split": "test"}, "never denoised"),
        ({"vary": "paper", "pairs": 12}, "expected 121"),
        ({"cluster": "somewhere"}, "cluster: got 'somewhere'"),
        ({"cluster": "slurm", "workers": 2}, "--workers 2"),
    ],
)
def test_wrong_options_are_usage_errors(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words):
        Dataset(out=tmp_path, **options).check()


def test_every_option_reaches_the_configuration(tmp_path: Path) -> None:
    """Each with another value than its default; those that exclude one another in turn."""
    given: dict[str, Any] = {"objects": 3, "pairs": 5, "resolution": 48, "vary": "independent", "seed": 7, "spp": 128}
    given |= {"meshes": "models", "holdout": 5, "turn_objects": True, "materials": "maps", "lights": tmp_path}
    given |= {"light_share": 0.25, "light_holdout": 3, "turn_lights": False, "light_height": 32}
    other = set()
    for more in ({"split": "test", "noise_floor": 30.0, "workers": 3}, {"denoise": True, "cluster": "slurm:2"}):
        found = Dataset(out=tmp_path, **given, **more).check()
        assert {name: getattr(found, name) for name in given | more} == given | more
        other |= {name for name, default in DEFAULTS.items() if getattr(found, name) != default}
    assert other == DEFAULTS.keys() - {"lights_digest"}  # which is no option


def test_numbers_that_are_not_given_depend_on_what_is_asked_for(tmp_path: Path) -> None:
    cases: list[tuple[dict[str, Any], int]] = [
        ({}, 36),
        ({"vary": "paper"}, 121),
        ({"vary": "sweep"}, 121),
        ({"vary": "independent", "materials": "maps"}, 8),
        ({"materials": "maps"}, 8),
        ({"vary": "independent", "materials": "maps", "pairs": 5}, 5),
    ]
    for options, pairs in cases:
        config = Dataset(out=tmp_path, **options).check()
        assert config.pairs == pairs
        assert config.vary == options.get("vary", "independent" if "materials" in options else "basis")
    assert plan_groups(Dataset(out=tmp_path).check()).objects == 20


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sweep")
    made(out, vary="sweep", pairs=121)
    return out


def test_sweep_stores_the_grid_under_one_light(swept: Path) -> None:
    ((_, members),) = read_groups(swept / "shard-000000.tar")
    images = [name for name in members if name.startswith("l0.m")]
    assert sorted(images) == sorted(f"l0.m{m:03d}_r{r:03d}.exr" for m in GRID for r in GRID)
    assert not any(name.startswith("l1") for name in members)
    rendered = [name for name in images if "interpolated" not in picture(members, name)[1]]
    assert sorted(rendered) == sorted(f"l0.m{m:03d}_r{r:03d}.exr" for m in (0, 50, 100) for r in GRID)
    assert len({picture(members, name)[1]["scene"] for name in images}) == 121
    data = GroupDataset(swept)
    assert len(data) == 121
    assert {(pair.roughness, pair.metallic) for pair in data.pairs(0)} == {
        (r / 100, m / 100) for r in GRID for m in GRID
    }


def test_interpolated_pictures_follow_from_the_rendered_ones(swept: Path) -> None:
    ((_, members),) = read_groups(swept / "shard-000000.tar")
    for r in (0, 60):
        nodes = np.stack([picture(members, f"l0.m{int(100 * m):03d}_r{r:03d}.exr")[0] for m in METALLIC_NODES])
        scale = nodes.max()
        stored = picture(members, f"l0.m030_r{r:03d}.exr")[0]
        np.testing.assert_allclose(interpolate_metallic(nodes, 0.3), stored, atol=2e-3 * scale)  # half precision
        assert np.abs(interpolate_metallic(nodes, 0.4) - stored).max() > 10 * 2e-3 * scale


def test_negative_pixels_of_a_sweep_are_counted(swept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ((_, members),) = read_groups(swept / "shard-000000.tar")
    images = {name: picture(members, name)[0] for name in members if name.startswith("l0.m")}
    below = {name: int((image < 0).any(axis=-1).sum()) for name, image in images.items()}
    rendered = [name for name in images if name.split("_")[0] in ("l0.m000", "l0.m050", "l0.m100")]
    assert not any(below[name] for name in rendered)
    count = sum(below.values())
    assert count > 0
    assert json.loads(members["json"])["negative_pixels"] == count
    assert json.loads((swept / "manifest.json").read_text())["shards"][0]["negative_pixels"] == count
    assert Dataset(out=swept, objects=1, vary="sweep", resolution=SIZE, spp=SPP, workers=1).run() == 0
    assert f"{count} pixels of interpolated pictures" in capsys.readouterr().out


@pytest.mark.long
def test_procedural_objects_with_maps_of_their_own(tmp_path: Path) -> None:
    (first, second) = made(tmp_path, objects=2, vary="independent", materials="maps", pairs=2, resolution=16)
    assert first["shared.exr"] != second["shared.exr"]
    varied = 0
    for members in (first, second):
        shared = read_exr_bytes(members["shared.exr"])[0]
        inside = shared["mask.Y"] > 0.99
        varied += sum(float(np.ptp(shared[name][inside])) > 0.02 for name in ("roughness.Y", "metallic.Y"))
        assert {"l0.maps.exr", "l0.maps.specular.exr", "l1.maps.exr"} <= set(members)
        assert json.loads(members["json"])["lights"][1]["pairs"] == [
            {"roughness": None, "metallic": None, "member": "l1.maps.exr", "specular": "l1.maps.specular.exr"}
        ]
        assert "roughness" not in picture(members, "l0.maps.exr")[1]
    assert varied >= 1
    assert len(GroupDataset(tmp_path)) == 4


@pytest.mark.long
def test_noise_floor_is_reached_and_said(tmp_path: Path) -> None:
    """Members, the group's json and the report agree; the floor holds against an independent render."""
    asked = 30.0
    own = config(tmp_path, pairs=3, noise_floor=asked)
    report = generate(own, executor=Inline())
    assert report.floor is not None
    ((_, members),) = read_groups(tmp_path / "shard-000000.tar")
    buffers = json.loads(members["json"])["noise_floor"]["buffers"]
    assert json.loads(members["json"])["noise_floor"]["asked_db"] == asked
    lit = {name.removesuffix(".exr") for name in members if name.startswith("l0") and "environment" not in name}
    assert set(buffers) == lit
    assert report.floor.buffers == len(lit)
    assert report.floor.reached == sum(buffer["reached"] for buffer in buffers.values())
    assert report.floor.minimum_db == min(buffer["floor_db"] for buffer in buffers.values())
    for name, buffer in buffers.items():
        attributes = read_exr_bytes(members[f"{name}.exr"])[1]
        assert float(attributes["noise_floor"]) == buffer["floor_db"]
        assert int(attributes["spp"]) == buffer["spp"]
        assert not buffer["reached"] or buffer["floor_db"] >= asked
    again = generate(own, executor=Inline())
    assert (again.groups, again.floor) == (0, report.floor)
    best = render_group(config(tmp_path, pairs=3, spp=1 << 12), plan_groups(own)[0]).members
    mask = read_exr_bytes(members["shared.exr"])[0]["mask.Y"][..., None]
    for name in (name for name in members if name.startswith("l0.m")):
        reached = buffers[name.removesuffix(".exr")]["floor_db"]
        assert abs(_psnr(picture(members, name)[0], picture(best, name)[0], mask) - reached) < 4
    assert len({buffer["spp"] for buffer in buffers.values()}) > 1


def _psnr(first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> float:
    """Masked, sRGB, of premultiplied pictures."""
    scale = np.maximum(mask, 1e-3)
    error = np.square(image_srgb(first / scale) - image_srgb(second / scale)) * mask
    return float(-10 * np.log10(error.sum() / (3 * mask.sum())))


@pytest.mark.long
@pytest.mark.skipif(not DENOISER, reason="needs mitsuba-oidn")
def test_denoised_pictures_are_marked_and_nearer_to_the_truth(tmp_path: Path) -> None:
    noisy, clean = (made(tmp_path / str(on), denoise=on, resolution=32, spp=4)[0] for on in (False, True))
    for name in noisy:
        if not name.endswith(".exr"):
            continue
        assert "denoised" not in read_exr_bytes(noisy[name])[1]
        rendered = name.startswith("l0") and "environment" not in name
        assert ("denoised" in read_exr_bytes(clean[name])[1]) == rendered
        if not rendered:
            assert read_exr_bytes(noisy[name])[0].keys() == read_exr_bytes(clean[name])[0].keys()
    assert "denoised" in json.loads(clean["json"])
    assert json.loads((tmp_path / "True" / "manifest.json").read_text())["config"]["denoise"] is True
    best = render_group(config(tmp_path, resolution=32, spp=1024), plan_groups(config(tmp_path))[0]).members
    mask = read_exr_bytes(best["shared.exr"])[0]["mask.Y"][..., None]
    name = next(name for name in best if name.startswith("l0.m050"))
    gain = _psnr(picture(clean, name)[0], picture(best, name)[0], mask) - _psnr(
        picture(noisy, name)[0], picture(best, name)[0], mask
    )
    assert gain > 1
    assert len(GroupDataset(tmp_path / "True")) == 1
