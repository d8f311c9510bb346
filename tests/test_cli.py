"""The command line end to end, with the shipped checkpoint: results, or one clear line; never a partial folder."""

import functools
import importlib.metadata
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from seen_shapes import as_maps, gutter
from synthetic_shards import write_dataset

from unirender.cli import main, read_light, refuse
from unirender.command_line.parse import parse
from unirender.command_line.remarks import missing_maps
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, image_channels, intrinsics_channels, read_exr, write_exr
from unirender.files import read_result
from unirender.intrinsics import Intrinsics
from unirender.pipelines.editing import under_light
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender_reference.lights import load_light

DECOMPOSED = {"intrinsics.exr", "environment.exr", "meta.json"} | {
    f"{name}.png"
    for name in ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment", "mask")
}


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photograph-like PNG with alpha: a shaded ball with a highlight, 150 x 100 pixels."""
    y, x = np.mgrid[:100, :150]
    x, y = (x - 74.5) / 42, -(y - 49.5) / 42
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    shade = np.clip(0.3 * x + 0.5 * y + 0.8 * z, 0, 1)
    highlight = np.exp(40 * (np.clip(0.25 * x + 0.35 * y + 0.9 * z, 0, 1) - 1))
    rgb = np.clip(shade[..., None] * np.array([0.7, 0.35, 0.2]) + 0.6 * highlight[..., None], 0, 1)
    pixels = np.concatenate([rgb, (x**2 + y**2 < 1)[..., None]], axis=-1)
    path = tmp_path_factory.mktemp("picture") / "ball.png"
    Image.fromarray(np.round(pixels * 255).astype(np.uint8)).save(path)
    return path


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.fixture(scope="module")
def decomposed(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball as `unirender decompose` wrote it, seen at 30 degrees; to be read alone."""
    folder = tmp_path_factory.mktemp("decomposed") / "maps"
    assert run("decompose", ball, "--output", folder, "--fov", "30") == 0
    return folder


def test_decompose_a_picture_with_alpha(ball: Path, tmp_path: Path) -> None:
    assert run("decompose", ball, "--output", tmp_path / "out") == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == DECOMPOSED
    intrinsics = read_result(tmp_path / "out")
    assert (intrinsics.height, intrinsics.width) == (100, 150)
    assert intrinsics.environment is not None
    assert intrinsics.environment.shape == (16, 32, 3)
    assert intrinsics.normal is not None
    inside = np.array(Image.open(ball))[..., 3] == 255
    length = np.linalg.norm(intrinsics.normal, axis=-1)
    np.testing.assert_allclose(length[inside], 1, rtol=0, atol=5e-3)
    assert (length[~inside] == 0).all()
    meta = json.loads((tmp_path / "out" / "meta.json").read_text())
    assert (meta["fov_deg"], meta["mode"], meta["steps"], meta["seed"]) == (36, "mean", 1, 0)
    assert 0 < meta["clipped"] < 0.05  # the highlight
    assert meta["remarks"] == {"camera": "field of view not given: 36 degrees assumed (--fov)"}
    for name in ("intrinsics.exr", "environment.exr"):
        _, header = read_exr(tmp_path / "out" / name)
        expected = {"input": "ball.png", "mode": "mean", "seed": "0", "camera": "fov_deg=36 principal=0.5,0.5"}
        assert expected.items() <= header.items()
        assert header["checkpoint_sha256"] == meta["checkpoint_sha256"] == checkpoint_sha256(checkpoint_folder())
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_render_takes_what_decompose_wrote(ball: Path, decomposed: Path, tmp_path: Path) -> None:
    assert run("render", decomposed, "--output", tmp_path / "out") == 0
    channels, _ = read_exr(tmp_path / "out" / "image.exr")
    rendered = np.array(Image.open(tmp_path / "out" / "image.png"), dtype=np.float32) / 255
    original = np.array(Image.open(ball), dtype=np.float32) / 255
    assert set(channels) == set("RGBA")
    inside = original[..., 3] == 1
    error = np.mean((rendered[inside, :3] - original[inside, :3]) ** 2)
    constant = np.mean((original[inside, :3].mean(axis=0) - original[inside, :3]) ** 2)
    assert error < constant  # the cycle explains the picture better than its mean colour
    assert json.loads((tmp_path / "out" / "meta.json").read_text())["fov_deg"] == 30


def test_render_shows_what_was_painted_and_takes_pictures_alone(
    decomposed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the pictures alone the object is the same within what 8 bits and a clipped light leave."""
    shutil.copytree(decomposed, tmp_path / "painted")
    albedo = np.array(Image.open(decomposed / "albedo.png"))
    albedo[40:60, 60:90] = [20, 200, 40]
    Image.fromarray(albedo).save(tmp_path / "painted" / "albedo.png")
    shutil.copytree(decomposed, tmp_path / "alone", ignore=shutil.ignore_patterns("*.exr"))
    pictures = {}
    for name, folder in {"as found": decomposed, **{n: tmp_path / n for n in ("painted", "alone")}}.items():
        assert run("render", folder, "--output", tmp_path / f"{name} rendered", "--dtype", "float32") == 0
        pictures[name] = np.array(Image.open(tmp_path / f"{name} rendered" / "image.png"), np.float32)[..., :3] / 255
        edited = json.loads((tmp_path / f"{name} rendered" / "meta.json").read_text())["edited"]
        assert edited == (["albedo"] if name == "painted" else [])
    assert "edited in" in capsys.readouterr().err
    inside = np.array(Image.open(decomposed / "mask.png"))[..., None] == 255
    difference = {name: np.abs(picture - pictures["as found"]) * inside for name, picture in pictures.items()}
    middle = pictures["painted"][45:55, 65:85].mean(axis=(0, 1))
    assert middle.argmax() == 1
    assert pictures["as found"][45:55, 65:85].mean(axis=(0, 1)).argmax() == 0
    assert difference["painted"][:20].max() < 0.03  # away from it
    assert difference["alone"].mean() / inside.mean() < 0.02


def test_render_takes_one_file_and_the_camera_in_its_header(
    decomposed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(decomposed, tmp_path / "maps")
    (tmp_path / "maps" / "meta.json").unlink()
    capsys.readouterr()
    for name in ("maps", "maps/intrinsics.exr"):
        assert run("render", tmp_path / name, "--output", tmp_path / "out", "--overwrite") == 0
        assert "assumed" not in capsys.readouterr().err
        assert json.loads((tmp_path / "out" / "meta.json").read_text())["fov_deg"] == 30
    assert not (tmp_path / "out" / "environment.exr").exists()  # one file is that file


def test_a_picture_that_was_written_here_brings_its_camera(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    channels = image_channels(np.array(Image.open(ball), np.float32)[::4, ::4] / 255)
    (tmp_path / "film").mkdir()
    for name, camera in {"film/b.exr": "fov_deg=60 principal=0.5,0.4", "a.exr": "Canon", "film/c.exr": None}.items():
        write_exr(tmp_path / name, channels, attributes=None if camera is None else {"camera": camera})
    given = ("--fov", "70")
    for name, options, expected, words in [
        ("film/b.exr", (), (60, [0.5, 0.4]), "field of view of 60 degrees, as the picture's header says (--fov)"),
        ("film/b.exr", given, (70, [0.5, 0.4]), ""),
        ("a.exr", (), (36, [0.5, 0.5]), "field of view not given: 36 degrees assumed (--fov)"),
    ]:
        assert run("decompose", tmp_path / name, "--output", tmp_path / "out", "--overwrite", *options) == 0
        lines = capsys.readouterr().err
        assert words in lines
        assert ("field of view" in lines) == bool(words)
        meta = json.loads((tmp_path / "out" / "meta.json").read_text())
        assert (meta["fov_deg"], meta["principal"]) == expected
    for _ in range(2):  # a second run keeps what is there
        assert run("decompose", tmp_path / "film", "--output", tmp_path / "maps") == 0
    assert "2 pictures (2 of them from before)" in capsys.readouterr().out
    metas = [json.loads((tmp_path / "maps" / name / "meta.json").read_text()) for name in ("b.exr", "c.exr")]
    assert [meta["fov_deg"] for meta in metas] == [60, 36]
    for name, meta in zip(("b.exr", "c.exr"), metas, strict=True):  # of a version that knew neither
        older = {key: value for key, value in meta.items() if key not in ("looks", "flat")}
        (tmp_path / "maps" / name / "meta.json").write_text(json.dumps(older))
    assert run("decompose", tmp_path / "film", "--output", tmp_path / "maps") == 0
    assert "2 pictures (2 of them from before)" in capsys.readouterr().out
    assert run("decompose", tmp_path / "film", "--output", tmp_path / "maps", *given) == 1
    assert "is a result with another fov" in capsys.readouterr().err


def test_render_takes_maps_without_a_mask_under_a_new_light(decomposed: Path, tmp_path: Path) -> None:
    whole = read_result(decomposed)
    maps = whole.replace(**{name: value[::4, ::4] for name, value in whole.maps.items() if name != "environment"})
    bare = intrinsics_channels(maps.replace(mask=None, environment=None, specular=None, diffuse=None))
    write_exr(tmp_path / "bare.exr", bare)
    lights = {"dim": 0.2, "bright": 0.9}
    for name, value in lights.items():
        write_exr(tmp_path / f"{name}.exr", image_channels(np.full((8, 16, 3), value, dtype=np.float32)), half=False)
        arguments = ("--environment", tmp_path / f"{name}.exr", "--exposure", "0", "--output", tmp_path / name)
        assert run("render", tmp_path / "bare.exr", *arguments) == 0
    inside = maps.require("mask")["mask"] == 1
    means = [np.array(Image.open(tmp_path / name / "image.png"))[inside[..., 0], :3].mean() for name in lights]
    assert means[0] < 0.7 * means[1]
    np.testing.assert_array_equal(read_result(tmp_path / "dim").require("mask")["mask"], inside)  # by the normals


def test_render_says_which_maps_it_was_not_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    normal, mask, _ = gutter()
    inside = (np.arange(normal.shape[1]) > 5)[:, None]
    normal, mask = normal * inside, mask * inside
    light = np.ones((16, 32, 3), np.float32)
    maps = as_maps(normal, mask).replace(albedo=np.full(normal.shape, 0.5, np.float32), metallic=0 * mask)
    ready = under_light(maps, light, "keep")
    imagined = "maps that are missing: the network imagines"
    where = "the mask is where the normal is not 0"
    for given, new_light, words, facts in [
        (ready, False, "", ([], [], None)),
        (
            ready.replace(diffuse=None),
            False,
            "maps that are missing: diffuse follows from the",
            ([], ["diffuse"], None),
        ),
        (
            ready.replace(albedo=None, specular=None, environment=None, mask=None),
            False,
            f"{imagined} albedo, specular, environment; {where}\n",
            (["albedo", "specular", "environment"], [], "normal"),
        ),
        (maps, True, "", ([], ["specular", "diffuse"], None)),
        (
            maps.replace(albedo=None, normal=np.ones_like(normal) / 2, mask=None),
            True,
            f"{imagined} albedo; the mask is the whole frame\n",
            (["albedo"], ["specular", "diffuse"], "frame"),
        ),
    ]:
        found = missing_maps(given, new_light)
        lines = capsys.readouterr().err
        assert words in lines
        assert bool(lines) == bool(words)
        assert (found["imagined"], found["derived"], found.get("mask_from")) == facts
    write_exr(tmp_path / "maps.exr", intrinsics_channels(maps.replace(mask=None)))
    assert run("render", tmp_path / "maps.exr", "--output", tmp_path / "out") == 0
    assert f"{imagined} specular, diffuse, environment; {where}\n" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "meta.json").read_text())["mask_from"] == "normal"
    np.testing.assert_array_equal(read_result(tmp_path / "out").require("mask")["mask"], mask)


def test_render_of_a_folder_without_maps_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What OpenEXR prints of a missing file by itself counts, too."""
    assert run("render", tmp_path, "--output", tmp_path / "out") == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert "has no intrinsics.exr and no maps like albedo.png, expected the output of" in line


def test_render_says_where_normals_face_away(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    normal, mask, _ = gutter()
    maps = as_maps(normal, mask).replace(metallic=0 * mask)
    for sign in (1, -1):
        turned = maps.replace(normal=normal * np.array([1, 1, sign], np.float32))
        write_exr(tmp_path / "maps.exr", intrinsics_channels(turned))
        assert run("render", tmp_path / "maps.exr", "--output", tmp_path / "out", "--overwrite") == 0
        assert ("normals face away from the camera" in capsys.readouterr().err) == (sign < 0)
        assert (json.loads((tmp_path / "out" / "meta.json").read_text())["facing_away"] > 0.2) == (sign < 0)


def test_render_draws_what_the_object_reflects_and_keeps_direct_light(tmp_path: Path) -> None:
    normal, mask, _ = gutter()
    maps = as_maps(normal, mask).replace(albedo=np.full(normal.shape, 0.8, np.float32), metallic=0 * mask)
    light = np.ones((16, 32, 3), np.float32)
    write_exr(tmp_path / "maps.exr", intrinsics_channels(maps), half=False)
    write_exr(tmp_path / "light.exr", image_channels(light), half=False)
    arguments = ("--environment", tmp_path / "light.exr", "--exposure", "0", "--dtype", "float32")
    assert run("render", tmp_path / "maps.exr", *arguments, "--output", tmp_path / "out") == 0
    kept, direct = read_result(tmp_path / "out"), under_light(maps, light, "keep", shadows=True)
    for name in ("specular", "diffuse"):
        np.testing.assert_allclose(getattr(kept, name), getattr(direct, name), rtol=2e-3, atol=1e-3)
    drawn = channels_rgb(read_exr(tmp_path / "out" / "image.exr")[0])
    pipeline = UniRenderPipeline.from_pretrained()
    whole, black = pipeline.render(maps.replace(environment=light)), pipeline.render(direct, derived=["diffuse"])
    assert np.abs(drawn - whole).mean() < 0.05 * np.abs(drawn - black).mean()


def test_what_lies_outside_the_models_range_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], ball: Path
) -> None:
    rgb = np.array(Image.open(ball).convert("RGBA"))
    rgb[30:70, 50:100, :3] = 255
    Image.fromarray(rgb).save(tmp_path / "bright.png")
    light = np.full((16, 32, 3), 0.2, dtype=np.float32)
    light[8, 20] = 3e4
    write_exr(tmp_path / "sun.exr", image_channels(light), half=False)
    arguments = ("--environment", tmp_path / "sun.exr", "--exposure", "0", "--output", tmp_path / "out")
    assert run("relight", tmp_path / "bright.png", *arguments) == 0
    lines = capsys.readouterr().err
    assert "of the object's pixels are clipped" in lines
    assert lines.count("environment: values above 200") == 1
    assert "come out at display white" in lines
    meta = json.loads((tmp_path / "out" / "meta.json").read_text())
    assert 0.2 < meta["clipped"] < 0.6
    assert 0.05 < meta["at_white"] <= 1
    over = meta["above_x_max"]["environment"]
    assert over["count"] >= 3  # one texel in 16 x 32, three channels
    assert (over["share"], over["x_max"]) == (over["count"] / (3 * 16 * 32), 200.0)
    assert run("relight", ball, *arguments[:2], "--output", tmp_path / "dim") == 0  # scaled to the gauge
    lines = capsys.readouterr().err
    assert "clipped" not in lines
    assert "display white" not in lines


def test_an_edit_is_the_same_from_the_command_line_and_from_python(ball: Path, tmp_path: Path) -> None:
    change = ["--roughness", "0.9", "--metallic", "1", "--dtype", "float32"]
    assert run("edit", ball, *change, "--output", tmp_path / "edited") == 0
    written = channels_rgb(read_exr(tmp_path / "edited" / "image.exr")[0])
    edited = UniRenderPipeline.from_pretrained().edit(Image.open(ball), roughness=0.9, metallic=1.0)
    np.testing.assert_allclose(written, edited.image_linear, rtol=0, atol=6e-4)  # of half precision
    before, after = (np.array(Image.open(path)).astype(int) for path in (ball, tmp_path / "edited" / "image.png"))
    assert after.shape == (100, 150, 4)
    assert np.abs(after - before).mean() > 1


def test_every_option_reaches_the_model(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with a value that is not its default, under the name that the pipeline has for it; it then stops."""
    calls: list[tuple[UniRenderPipeline, tuple[Any, ...], dict[str, Any]]] = []

    def stop(pipeline: UniRenderPipeline, *arguments: Any, **settings: Any) -> None:
        calls.append((pipeline, arguments, settings))
        raise UnirenderError("far enough")

    monkeypatch.setattr(UniRenderPipeline, "from_pretrained", functools.cache(UniRenderPipeline.from_pretrained))
    for name in ("decompose", "decompose_batch", "edit", "relight", "render"):
        monkeypatch.setattr(UniRenderPipeline, name, stop)
    light, maps = tmp_path / "light.exr", tmp_path / "maps.exr"
    write_exr(light, image_channels(np.full((8, 16, 3), 0.5, np.float32)), half=False)
    ones = np.ones((8, 8, 1), np.float32)
    known = Intrinsics(normal=ones * np.array([0, 0, 1], np.float32), roughness=ones, metallic=ones, mask=ones)
    write_exr(maps, intrinsics_channels(known))
    film = tmp_path / "film"
    film.mkdir()
    shutil.copy(ball, film)
    model = ["--checkpoint", "tiny", "--dtype", "bfloat16", "--device", "cpu", "--seed", "3", "--steps", "4"]
    model += ["--samples", "5", "--sampler", "unipc", "--size", "96", "--fov", "40", "--output", str(tmp_path / "out")]
    taken = ["--no-closed", "--flat", "--tile", "--material", "map"]
    decomposed = {"closed": False, "flat": True, "tile": True, "material": "map", "looks": 1}
    lit = ["--environment", str(light), "--exposure", "1"]
    changed = ["--roughness", "0.2", "--metallic", "0.7", "--no-anchored"]
    anchored, shadowed = {"anchored": False}, {"shadows": True, "exposure": "keep"}
    for arguments, own in (
        (["decompose", ball, *taken], decomposed),
        (["decompose", film, *taken], decomposed),
        (["edit", ball, *taken, *changed], decomposed | anchored | {"roughness": 0.2, "metallic": 0.7}),
        (["relight", ball, *taken, *lit, "--shadows"], decomposed | shadowed | {"anchored": True}),
        (["relight", ball, *lit[:2], "--no-anchored"], anchored | {"exposure": "auto", "shadows": False}),
        (["render", maps, *lit], {"derived": frozenset({"diffuse"})}),
        (["render", maps, *lit, "--no-shadows"], {"derived": frozenset({"specular", "diffuse"})}),
    ):
        assert run(*arguments, *model) == 1
        pipeline, given, settings = calls.pop()
        camera = given[0].camera if arguments[0] == "render" else settings.pop("camera", None) or settings["cameras"][0]
        assert camera.fov_deg == 40
        generator = settings.pop("generator")
        assert np.atleast_1d(generator)[0].initial_seed() == 3
        expected = own | {"mode": "sample", "num_inference_steps": 4, "num_samples": 5, "sampler": "unipc", "size": 96}
        assert expected.items() <= settings.items()
        assert pipeline.dtype == torch.bfloat16
        if "exposure" in settings:
            assert given[1].mean() == (1.0 if "--exposure" in arguments else 0.5)


def test_an_alpha_channel_that_hides_nothing_is_no_mask(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a screenshot has it."""
    colours = np.random.default_rng(0).integers(0, 255, (20, 30, 4), dtype=np.uint8)
    for alpha, told in ((255, True), (254, False)):
        colours[..., 3] = 255
        colours[0, 0, 3] = alpha
        Image.fromarray(colours).save(tmp_path / f"{alpha}.png")
        assert run("decompose", tmp_path / f"{alpha}.png", "--output", tmp_path / f"out{alpha}") == 0
        assert ("covers the whole frame" in capsys.readouterr().err) == told


def test_parts_of_the_mask_that_are_left_out_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By a picture, by a folder of pictures, and by the maps that come of it."""
    pixels = np.full((200, 200, 4), 150, np.uint8)
    pixels[..., 3] = 0
    pixels[60:110, 70:120, 3] = 255
    pixels[5, 5:7, 3] = 255
    (tmp_path / "pictures").mkdir()
    Image.fromarray(pixels).save(tmp_path / "pictures" / "a.png")
    said = "left out as stray: 2 pixels of the mask, in parts away from the object"
    assert run("decompose", tmp_path / "pictures" / "a.png", "--output", tmp_path / "out") == 0
    assert capsys.readouterr().err.count(said) == 1
    assert run("decompose", tmp_path / "pictures", "--output", tmp_path / "folder") == 0
    assert f"a.png: {said}" in capsys.readouterr().err
    assert run("render", tmp_path / "out", "--output", tmp_path / "again") == 0
    assert capsys.readouterr().err.count(said) == 1
    for folder in ("out", "folder/a.png", "again"):
        assert said in json.loads((tmp_path / folder / "meta.json").read_text())["remarks"]["parts"]
    normal = read_result(tmp_path / "out").require("normal")["normal"]
    assert not normal[5, 5:7].any()
    pixels[5, 5:12, 3] = 255  # now they count, and nothing is cut out
    Image.fromarray(pixels).save(tmp_path / "b.png")
    assert run("decompose", tmp_path / "b.png", "--output", tmp_path / "more") == 0
    assert "stray" not in capsys.readouterr().err


def test_tiles_that_add_nothing_are_told(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small").mkdir()
    Image.open(ball).resize((60, 40)).save(tmp_path / "small" / "a.png")
    said = "--tile adds nothing: the part of the picture that the network looks at has 60 pixels along a side"
    for picture in (tmp_path / "small" / "a.png", tmp_path / "small"):
        assert run("decompose", picture, "--tile", "--output", tmp_path / f"of {picture.name}") == 0
        assert said in capsys.readouterr().err
    meta = json.loads((tmp_path / "of a.png" / "meta.json").read_text())
    assert said in meta["remarks"]["tile"]
    assert run("decompose", ball, "--tile", "--output", tmp_path / "twin") == 0
    assert run("decompose", tmp_path / "small" / "a.png", "--output", tmp_path / "plain") == 0
    assert "--tile" not in capsys.readouterr().err


@pytest.mark.long
def test_a_large_jpg_without_a_mask_and_several_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    small = Image.fromarray(rng.integers(0, 255, (20, 30, 3), dtype=np.uint8))
    small.resize((3000, 2000), Image.Resampling.BICUBIC).save(tmp_path / "large.jpg", quality=90)
    arguments = ("--samples", "2", "--steps", "2", "--output", tmp_path / "out")
    assert run("decompose", tmp_path / "large.jpg", *arguments) == 0
    assert "whole frame" in capsys.readouterr().err
    assert Image.open(tmp_path / "out" / "albedo.png").size == (3000, 2000)
    assert (tmp_path / "out" / "albedo.std.png").exists()


def test_settings_are_recorded(ball: Path, decomposed: Path, tmp_path: Path) -> None:
    """That they reach the model shows `test_every_option_reaches_the_model`; what they do, its own tests."""
    light = tmp_path / "light.exr"
    write_exr(light, image_channels(np.ones((8, 16, 3), np.float32)), half=False)
    sampled = ("--steps", "3", "--sampler", "unipc", "--size", "96", "--tile", "--no-closed")
    for folder, arguments, recorded in (
        (decomposed, (), {"steps": 1, "sampler": None, "size": 64, "tile": False, "looks": 1, "flat": False}),
        ("sampled", ("decompose", ball, *sampled), {"steps": 3, "sampler": "unipc", "size": 96, "tile": True}),
        (
            "relit",
            ("relight", ball, "--flat", "--steps", "2", "--environment", light),
            {"flat": True, "sampler": "ddim"},
        ),
        ("edited", ("edit", ball, "--looks", "2", "--metallic", "1"), {"looks": 2}),
    ):
        if arguments:
            assert run(*arguments, "--output", tmp_path / folder) == 0
        assert recorded.items() <= json.loads((tmp_path / folder / "meta.json").read_text()).items()
        assert Image.open(tmp_path / folder / "albedo.png").size == (150, 100)


def test_the_mask_file_is_recorded_and_where_it_lies_is_no_setting(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    Image.open(ball).convert("RGB").save(tmp_path / "in" / "ball.png")
    for name in ("masks", "moved"):
        (tmp_path / name).mkdir()
        Image.open(ball).getchannel("A").save(tmp_path / name / "ball.png")
    picture, mask = tmp_path / "in" / "ball.png", tmp_path / "masks" / "ball.png"
    assert run("edit", picture, "--mask", mask, "--metallic", "1", "--output", tmp_path / "edited") == 0
    assert run("edit", ball, "--metallic", "1", "--output", tmp_path / "alpha") == 0
    metas = [json.loads((tmp_path / name / "meta.json").read_text()) for name in ("edited", "alpha")]
    assert [meta["mask"] for meta in metas] == [str(mask), None]
    for masks, kept in (("masks", 0), ("moved", 1)):
        assert run("decompose", tmp_path / "in", "--mask", tmp_path / masks, "--output", tmp_path / "out") == 0
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["mask"] == str(tmp_path / masks)
        stored = json.loads((tmp_path / "out" / "ball.png" / "meta.json").read_text())
        assert stored["mask"] == str(mask), f"kept: {kept}"


def test_a_folder_of_frames(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "film").mkdir()
    picture = Image.open(ball)
    for name, size in {"f1.png": (75, 50), "f2.png": (75, 50), "f3.png": (75, 50), "f10.png": (60, 40)}.items():
        picture.resize(size).save(tmp_path / "film" / name)
    (tmp_path / "film" / "f4.png").write_text("no picture")
    arguments = ("decompose", tmp_path / "film", "--frames", "--output", tmp_path / "out", "--samples", "2")
    assert run(*arguments, "--steps", "2") == 1
    printed = capsys.readouterr()
    assert "4 pictures (0 of them from before), 1 failed" in printed.out
    assert "2 pairs of frames: input 0.0000, albedo 0.0000" in printed.out  # f1, f2, f3: the same noise for all
    assert "pictures: 0 of 5\n" in printed.err
    assert printed.err.count("f4.png: not a readable picture") == 1
    assert printed.err.count("field of view") == 1
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert set(summary["pictures"]) == {"f1.png", "f2.png", "f3.png", "f10.png"}
    assert set(summary["failed"]) == {"f4.png"}
    assert summary["temporal_difference"]["pairs"] == 2
    assert summary["temporal_difference"]["normal"] == 0
    assert summary["pictures"]["f1.png"]["std_max"]["albedo"] > 0
    # Alone, a picture is decomposed as in its folder.
    alone = ("--samples", "2", "--steps", "2", "--output", tmp_path / "alone")
    assert run("decompose", tmp_path / "film" / "f2.png", *alone) == 0
    both = [read_result(path) for path in (tmp_path / "alone", tmp_path / "out" / "f2.png")]
    for name, value in both[0].maps.items():
        np.testing.assert_allclose(both[1].maps[name], value, rtol=5e-3, atol=5e-3, err_msg=name)
    # Mended and started again, it does what is missing.
    capsys.readouterr()
    picture.resize((75, 50)).rotate(20).save(tmp_path / "film" / "f4.png")
    assert run(*arguments, "--steps", "2") == 0
    printed = capsys.readouterr().out
    assert "5 pictures (4 of them from before)\n" in printed
    changes = json.loads((tmp_path / "out" / "summary.json").read_text())["temporal_difference"]
    assert changes["pairs"] == 3
    assert changes["albedo"] > 0
    assert changes["input"] > 0
    # With other settings all are refused, and the account of what is there stays.
    before = (tmp_path / "out" / "summary.json").read_bytes()
    assert run(*arguments, "--steps", "3") == 1
    assert "0 pictures (0 of them from before), 5 failed" in capsys.readouterr().out
    assert (tmp_path / "out" / "summary.json").read_bytes() == before


def test_a_folder_says_which_picture_and_which_option(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    Image.open(ball).resize((75, 50)).save(tmp_path / "in" / "a.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "in" / "b.png")
    assert run("decompose", tmp_path / "in", "--output", tmp_path / "out") == 1
    assert "in/b.png: image: got (4, 4) pixels" in capsys.readouterr().err
    assert run("decompose", tmp_path / "in", "--mask", tmp_path / "nowhere", "--output", tmp_path / "other") == 1
    lines = capsys.readouterr().err
    assert lines.count("error") == 1
    assert f"--mask {tmp_path / 'nowhere'}: no such file or folder" in lines
    assert not (tmp_path / "other").exists()
    assert run("render", tmp_path / "out", "--output", tmp_path / "other") == 1
    assert "name one of the folders inside, like" in capsys.readouterr().err
    assert run("decompose", tmp_path / "out" / "a.png", "--output", tmp_path / "other") == 1
    assert "`unirender render`" in capsys.readouterr().err


BAD = {  # after `decompose`, and what the line must say; of a picture's own faults tests/unirender/test_pictures.py
    "text": (["IN/text.png"], "not a readable picture"),
    "empty folder": (["IN"], "has no pictures"),
    "frames": (["BALL", "--frames"], "is no folder"),
    "mask size": (["BALL", "--mask", "IN/.mask.png"], "expected 150 x 100"),
    "checkpoint": (["BALL", "--checkpoint", "IN/nowhere"], "nowhere"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_one_line_and_no_output(
    case: str, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, message = BAD[case]
    folder = tmp_path / "in"
    folder.mkdir()
    Image.new("L", (8, 8), 255).save(folder / ".mask.png")
    if case == "text":
        (folder / "text.png").write_text("no picture")
    given = [word.replace("BALL", str(ball)).replace("IN", str(folder)) for word in arguments]
    assert run("decompose", *given, "--output", tmp_path / "out") == 1
    error = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(error) == 1
    assert message in error[0]
    assert "internal" not in error[0]
    assert [path.name for path in tmp_path.iterdir()] == ["in"]  # neither the folder nor a temporary one


def test_an_existing_folder_is_kept(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious").write_text("1")
    assert run("decompose", ball, "--output", tmp_path / "out") == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run("decompose", ball, "--output", tmp_path / "out", "--overwrite") == 1
    assert "meta.json" in capsys.readouterr().err
    assert (tmp_path / "out" / "precious").exists()
    (tmp_path / "out" / "meta.json").write_text("{}")
    assert run("decompose", ball, "--output", tmp_path / "out", "--overwrite") == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == DECOMPOSED
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("decompose", "BALL", "--output", "OLD"),
        ("edit", "BALL", "--output", "NEW", "--metallic", "1", "--size", "65"),
        ("relight", "BALL", "--output", "NEW", "--environment", "none.hdr"),
        ("render", "MAPS", "--output", "NEW", "--fov", "30", "--checkpoint", "none"),
        ("render", "BARE", "--output", "NEW", "--fov", "30"),
    ],
)
def test_a_refusal_stands_alone(
    arguments: tuple[str, ...], ball: Path, decomposed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What a picture lacks is of no interest to whom it was refused."""
    maps = read_result(decomposed)
    write_exr(tmp_path / "maps.exr", intrinsics_channels(maps.replace(mask=None)))  # a notice is due on it
    write_exr(tmp_path / "bare.exr", intrinsics_channels(maps.replace(roughness=None, albedo=None)))
    named = {"BALL": ball, "MAPS": tmp_path / "maps.exr", "BARE": tmp_path / "bare.exr"}
    named |= {"OLD": decomposed, "NEW": tmp_path / "new"}
    assert run(*(named.get(word, word) for word in arguments)) != 0
    printed = capsys.readouterr().err
    assert (printed.count("\n"), printed[:17]) == (1, "unirender: error:")


def test_the_working_directory_is_no_output(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("decompose", ball, "--output", ".") == 2
    assert "folder that you are in" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert run("decompose", ball, "--output", "out") == 0


def test_negative_radiance_of_a_light_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pixels = np.ones((16, 32, 3), np.float32)
    write_exr(tmp_path / "light.exr", image_channels(pixels))
    read_light(tmp_path / "light.exr")
    assert not capsys.readouterr().err
    pixels[8, 10] = -3
    write_exr(tmp_path / "light.exr", image_channels(pixels))
    assert read_light(tmp_path / "light.exr").min() == 0
    assert "of its radiance is negative and was set to 0" in capsys.readouterr().err


def test_a_light_that_is_taken_as_a_photograph_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Image.new("RGB", (64, 32), (200, 180, 160)).save(tmp_path / "panorama.jpg")
    for photograph in (True, False):  # asked for
        load_light(tmp_path / "panorama.jpg", photograph)
    assert not caplog.messages
    assert read_light(tmp_path / "panorama.jpg").shape == (128, 256, 3)
    (message,) = caplog.messages
    assert "panorama.jpg: taken as a photograph" in message


@pytest.mark.parametrize(
    ("size", "said"), [((64, 43), ""), ((64, 64), "only the middle 50% of its height"), ((48, 64), "the middle 38%")]
)
def test_a_photograph_that_does_not_fit_the_sphere_is_told(
    size: tuple[int, int], said: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Image.new("RGB", size, (200, 180, 160)).save(tmp_path / "light.jpg")
    load_light(tmp_path / "light.jpg", photograph=True)
    assert said in caplog.text
    assert len(caplog.messages) == bool(said)


@pytest.mark.parametrize(("covered", "told"), [(64, False), (63, False), (40, True)])
def test_a_light_that_is_an_object_cut_out_is_told(
    covered: int, told: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rgba = np.full((32, 64, 4), 180, np.uint8)
    rgba[..., 3] = 255 * (np.arange(64) < covered)
    Image.fromarray(rgba).save(tmp_path / "albedo.png")
    load_light(tmp_path / "albedo.png", photograph=True)
    assert ("38% of it is transparent, as around an object that is cut out" in caplog.text) == told
    assert len(caplog.messages) == told


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 120. GiB for an array"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory: you tried"),
        RuntimeError("CUDA out of memory. Tried to allocate 20.00 MiB"),
        RuntimeError("unable to mmap 21736176 bytes from file <x.safetensors>: Cannot allocate memory (12)"),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
    ],
)
def test_too_little_memory_is_no_internal_error(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    assert refuse(error) == 1
    said = capsys.readouterr().err
    assert f"not enough memory{f' ({error})' if error.args else ''}; expected" in said
    assert "internal error" not in said
    assert refuse(RuntimeError("shape mismatch")) == 1
    assert "internal error: RuntimeError: shape mismatch" in capsys.readouterr().err


USAGE = {
    "nothing to change": (["edit", "PICTURE", "--output", "OUT"], "nothing to change"),
    "metallic": (["edit", "PICTURE", "--output", "OUT", "--metallic", "nan"], "[0, 1]"),
    "fov": (["decompose", "PICTURE", "--output", "OUT", "--fov", "190"], "--fov 190: expected degrees"),
    "samples": (["decompose", "PICTURE", "--output", "OUT", "--samples", "0"], "at least 1"),
    "steps": (["render", "FOLDER", "--output", "OUT", "--steps", "0"], "expected 1 to 500"),
    "seed": (["render", "FOLDER", "--output", "OUT", "--seed", "99999999999999999999"], "64 bits"),
    "sampler of one step": (["decompose", "PICTURE", "--output", "OUT", "--sampler", "unipc"], "one step needs none"),
    "size": (["decompose", "PICTURE", "--output", "OUT", "--size", "100"], "expected a multiple of 32, like 64"),
    "looks": (["decompose", "PICTURE", "--output", "OUT", "--looks", "13"], "looks: got 13"),
    "looks of samples": (["decompose", "PICTURE", "--output", "OUT", "--looks", "2", "--samples", "2"], "mode sample"),
    "device": (["decompose", "PICTURE", "--output", "OUT", "--device", "tpu"], "tpu"),
    "exposure": (["relight", "PICTURE", "--environment", "L", "--output", "OUT", "--exposure", "99"], "stops"),
    "exposure of nothing": (["render", "FOLDER", "--output", "OUT", "--exposure", "1"], "--environment"),
    "preset": (["train", "--data", "FOLDER", "--preset", "huge"], "expected one of tiny"),
    "best of nothing": (["train", "--data", "FOLDER", "--keep-best", "albedo.psnr"], "--validate"),
    "best of another": (
        ["train", "--data", "FOLDER", "--out", "OUT", "--validate", "1", "--keep-best", "albedo.snr"],
        "expected one of albedo.psnr, normal.cosine, metallic.mse, roughness.mse, render.psnr, edit.psnr",
    ),
    "pairs": (["dataset", "--pairs", "5", "--out", "OUT"], "expected 3 x lights"),
}
FAILURES = {
    "picture": (["edit", "MISSING", "--output", "OUT", "--roughness", "0.5"], "no such file"),
    "folder of pictures": (["edit", "FOLDER", "--output", "OUT", "--roughness", "0.5"], "is a folder"),
    "light": (["relight", "PICTURE", "--environment", "MISSING", "--output", "OUT"], "missing"),
    "no maps": (["render", "PICTURE", "--output", "OUT"], "no EXR file"),
    "incomplete maps": (["render", "MAPS", "--output", "OUT"], "normal, roughness, metallic missing"),
    "checkpoint": (
        ["edit", "PICTURE", "--output", "OUT", "--roughness", "0.5", "--checkpoint", "FOLDER"],
        "model_index.json",
    ),
    "data": (["train", "--data", "MISSING", "--out", "OUT"], "no such data folder"),
}


def run_case(arguments: list[str], ball: Path, tmp_path: Path) -> int:
    """Exit status of a command line with its placeholders filled in."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "maps").mkdir()
    mask = np.ones((8, 8, 1), dtype=np.float32)
    write_exr(tmp_path / "maps" / "intrinsics.exr", intrinsics_channels(Intrinsics(mask=mask)))
    paths = {name.upper(): tmp_path / name for name in ("folder", "maps", "missing", "out")} | {"PICTURE": ball}
    return run(*(paths.get(argument, argument) for argument in arguments))


@pytest.mark.parametrize("case", USAGE)
def test_wrong_usage_exits_with_2(case: str, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, words = USAGE[case]
    assert run_case(arguments, ball, tmp_path) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", FAILURES)
def test_a_failure_exits_with_1(case: str, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, words = FAILURES[case]
    assert run_case(arguments, ball, tmp_path) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert words in line
    assert not (tmp_path / "out").exists()


def test_doctor_finds_a_working_backend(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("doctor") == 0
    text = capsys.readouterr().out
    assert "LLVM" in text
    assert "checkpoints" in text
    assert "tiny" in text


def test_doctor_finds_what_does_not_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("unirender_reference.backend.doctor", lambda: [("kernel", "sum(0..4) = 10", "ok")])
    assert run("doctor") == 0
    capsys.readouterr()
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "file" / "cache"))
    assert run("doctor") == 1
    assert "cannot be written" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "new"))
    assert run("doctor") == 0
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr("unirender_reference.backend.doctor", lambda: [("kernel", "sum(0..4) = 11", "fail")])
    assert run("doctor") == 1


def test_doctor_shows_all_of_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """However long it is: it is folded, and brackets are no markup."""
    monkeypatch.setattr("unirender_reference.backend.doctor", lambda: [("kernel", "sum(0..4) = 10", "ok")])
    cache = tmp_path / "[old]" / ("long-" * 20)
    monkeypatch.setenv("UNIRENDER_CACHE", str(cache))
    assert run("doctor") == 0
    cells = [line.split("│")[2].strip() for line in capsys.readouterr().out.splitlines() if line.count("│") == 4]
    assert str(cache) in "".join(cells)


def test_help_loads_nothing_heavy() -> None:
    """Not even what takes some hundredths of a second of the standard library's."""
    code = (
        "import sys, unirender.cli\n"
        "try: unirender.cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'diffusers', 'mitsuba', 'drjit', 'matplotlib', 'skimage', 'gradio', 'colour', 'scipy'}\n"
        "heavy |= {'numpy', 'importlib.metadata', 'multiprocessing.connection', 'statistics'}\n"
        "assert not heavy & {*sys.modules}, heavy & {*sys.modules}\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@dataclass(frozen=True)
class Described:
    """A command."""

    size: int = 8
    """One sentence that runs
    over a line end, with `code`
    `at` the start of a line.

    A paragraph:
    - an item
    """


def test_help_breaks_no_sentence_of_an_option_where_the_source_does(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        parse(Described, ["--help"], "described", "")
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    assert "--size INT  One sentence that runs over a line end, with `code` `at` the start of a line." in lines
    assert {"A paragraph:", "- an item (default: 8)"} <= set(lines)


def test_train_writes_a_pipeline_that_decompose_loads(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    assert run("train", "--data", tmp_path / "empty", "--out", tmp_path / "run") == 1
    assert not (tmp_path / "run").exists()
    write_dataset(tmp_path / "data", size=64, shards=1)
    length = ("--steps", "1", "--batch-size", "2")
    scored = ("--validate", "1", "--keep-best", "albedo.psnr")
    assert run("train", "--data", tmp_path / "data", "--out", tmp_path / "run", *length, *scored) == 0
    assert "albedo.psnr" in capsys.readouterr().out
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    scores = [line["validation"] for line in log if "validation" in line]
    assert len(scores) == 2  # before the first step and after the last
    best = json.loads((tmp_path / "run" / "best" / "validation.json").read_text())
    assert best["scores"]["albedo.psnr"] == {
        "value": max(s["albedo.psnr"] for s in scores),
        "higher_is_better": True,
    }
    checkpoint = tmp_path / "run" / "pipeline"
    assert json.loads((checkpoint / "training.json").read_text())["data"]["folder"] == "data"
    assert run("train", "--data", tmp_path / "data", "--out", tmp_path / "run", *length) == 0
    assert "finished at step 1 of 1: nothing to train; pass --steps (more than 1)" in capsys.readouterr().out
    assert run("decompose", ball, "--checkpoint", checkpoint, "--output", tmp_path / "out") == 0
    assert read_exr(tmp_path / "out" / "intrinsics.exr")[1]["checkpoint"] == "pipeline"


def test_dataset_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("--objects", "1", "--pairs", "3", "--resolution", "8", "--spp", "4", "--workers", "1")
    assert run("dataset", *arguments, "--out", tmp_path / "data") == 0
    printed = capsys.readouterr()
    assert "3 pairs in 1 group," in printed.out
    assert "% of it spent rendering" in printed.out
    assert "groups: 0 of 1\n" in printed.err, "a log shows that it goes on"
    assert run("dataset", *arguments, "--out", tmp_path / "data") == 0
    assert "complete" in capsys.readouterr().out


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"unirender {importlib.metadata.version('unirender')}\n"
