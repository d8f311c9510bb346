"""Folders of predictions: how their files are read, and that all that is wrong with one is found at once."""

import json
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from icc_profiles import P3_D50, SRGB_D50, matrix_profile
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from sixteen_bit_files import write_png16
from tiny_suites import make_suite

from unirender.color import srgb_encode, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import image_channels, intrinsics_channels, write_exr
from unirender.intrinsics import Intrinsics
from unirender_evaluation import engine
from unirender_evaluation.export import export_inputs
from unirender_evaluation.predictions.check import PredictionError, check_predictions
from unirender_evaluation.predictions.conventions import Conventions, read_conventions
from unirender_evaluation.predictions.png import read_png
from unirender_evaluation.rows import make_row, prediction_rows
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import Task
from unirender_evaluation.tasks import tasks


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("predictions"), objects=1)


def first(suite: Suite, table: str, protocol: str) -> Task:
    return next(tasks(suite, table, protocol, list(suite.scenes)))


def asked(
    suite: Suite, folder: Path, name: str, table: str = "inverse", protocol: str = "single-image"
) -> tuple[Task, Path]:
    """The first question, and the file in which a folder of predictions answers it; its folder is there."""
    task = first(suite, table, protocol)
    path = folder / task.folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return task, path


def test_png_predictions_and_broken_files(suite: Suite, tmp_path: Path) -> None:
    task, path = asked(suite, tmp_path / "png", "normal.png")
    folder = path.parent
    truth = suite.intrinsics(task.scene, task.scene.materials[0])
    levels = np.round((truth.require("normal")["normal"] + 1) / 2 * 255).astype(np.uint8)
    Image.fromarray(levels).save(path)
    Image.fromarray(np.full(task.mask.shape[:2], 51, np.uint8)).save(folder / "roughness.png")
    row = prediction_rows({"png": tmp_path / "png"})[0]
    assert row.predictions is not None
    _, maps = row.predictions.answer(task)
    assert maps is not None
    assert set(maps.present) == {"normal", "roughness", "mask"}
    values = engine.score(task, engine.Prediction(maps=maps), ())
    assert values["normal.cosine"] > 0.999
    np.testing.assert_allclose(maps.require("roughness")["roughness"], 0.2, rtol=0, atol=1e-6)
    Image.fromarray(levels[:16]).save(folder / "albedo.png")
    with pytest.raises(UnirenderError, match="resample it"):
        row.predictions.answer(task)
    (folder / "albedo.png").write_text("no picture")
    with pytest.raises(UnirenderError, match="not a readable PNG"):
        row.predictions.answer(task)


LINEAR, SRGB_NUMBERS, HDR_NUMBERS = round(1e5).to_bytes(4, "big"), bytes((1, 13, 0, 1)), bytes((9, 16, 0, 1))
SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


@pytest.mark.parametrize(
    ("chunks", "profile", "stated"),
    [
        ({b"gAMA": LINEAR}, None, r"linear values \(gAMA 1\)"),
        ({b"gAMA": (45455).to_bytes(4, "big")}, None, None),
        ({b"sRGB": b"\0", b"gAMA": LINEAR}, None, None),
        ({b"gAMA": LINEAR}, SRGB_PROFILE, None),
        ({}, matrix_profile(P3_D50, 2.2), "colours of another ICC profile"),
        ({b"gAMA": LINEAR}, matrix_profile(SRGB_D50, 1.0), "colours of another ICC profile"),
        ({b"cICP": SRGB_NUMBERS, b"gAMA": LINEAR}, matrix_profile(SRGB_D50, 1.0), None),
        ({b"cICP": HDR_NUMBERS, b"sRGB": b"\0"}, None, r"Rec.2020 primaries and PQ transfer \(cICP\)"),
        ({}, b"no profile", None),
    ],
)
def test_a_png_that_states_other_colours_is_not_decoded(
    tmp_path: Path, chunks: dict[bytes, bytes], profile: bytes | None, stated: str | None
) -> None:
    """Decoded all the same its colours would be wrong (of linear ones far too dark), and nothing but the score would
    say so. Of cICP, an ICC profile, sRGB and gAMA the first counts; of maps that are linear anyway all say nothing."""
    more = PngInfo()
    for name, value in chunks.items():
        more.add(name, value)
    path = tmp_path / "albedo.png"
    Image.fromarray(np.full((4, 4, 3), (128, 40, 200), np.uint8)).save(path, pnginfo=more, icc_profile=profile)
    read_png(path, 3)
    if profile == b"no profile":
        with pytest.raises(UnirenderError, match=r"albedo.png: its ICC profile cannot be used"):
            read_png(path, 3, encoded=True)
    elif stated is not None:
        with pytest.raises(UnirenderError, match=rf"albedo.png states {stated}, .* png_colour = .linear."):
            read_png(path, 3, encoded=True)
    else:
        read_png(path, 3, encoded=True)


def test_a_png_of_too_many_pixels_is_refused_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "albedo.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4)
    with pytest.raises(UnirenderError, match=r"not a readable PNG .*exceeds limit"):
        read_png(tmp_path / "albedo.png", 3)


@pytest.mark.parametrize("filter_type", [0, 1])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_are_read_in_full(tmp_path: Path, channels: int, filter_type: int) -> None:
    """Grey and colour, with and without alpha; eight bits would be off by up to 1/510."""
    values = np.random.default_rng(0).integers(0, 65536, (5, 7, channels))
    write_png16(tmp_path / "a.png", values, filter_type)
    expected = values[..., :3] / 65535 if channels > 2 else values[..., [0, 0, 0]] / 65535
    np.testing.assert_allclose(read_png(tmp_path / "a.png", 3), expected, rtol=0, atol=1e-6)
    if channels > 2:
        with pytest.raises(UnirenderError, match=r"a.png is in colour: .* metallic the blue"):
            read_png(tmp_path / "a.png", 1)
        write_png16(tmp_path / "a.png", np.broadcast_to(values[..., :1], values.shape), filter_type)
    grey = read_png(tmp_path / "a.png", 1)
    assert grey.dtype == np.float32
    np.testing.assert_allclose(grey, expected[..., :1], rtol=0, atol=1e-6)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:70])
    with pytest.raises(UnirenderError, match=r"a.png is not a readable PNG"):
        read_png(tmp_path / "a.png", 3)


def test_channels_that_differ_a_little_are_one_value(tmp_path: Path) -> None:
    """As a network's autoencoder writes a grey picture."""
    rng = np.random.default_rng(0)
    pixels = np.clip(rng.integers(40, 200, (8, 8, 1)) + rng.integers(-6, 7, (8, 8, 3)), 0, 255).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    expected = pixels.mean(axis=-1, keepdims=True) / 255
    np.testing.assert_allclose(read_png(tmp_path / "a.png", 1), expected, atol=1e-6)


def test_a_mask_among_the_maps_is_the_methods_own(suite: Suite, tmp_path: Path) -> None:
    task, path = asked(suite, tmp_path / "mine", "intrinsics.exr")
    truth = suite.intrinsics(task.scene, task.scene.materials[0])
    albedo = Intrinsics(albedo=truth.require("albedo")["albedo"])

    def values(maps: Intrinsics) -> dict[str, float]:
        write_exr(path, intrinsics_channels(maps))
        row = prediction_rows({"mine": tmp_path / "mine"})[0]
        return engine.score(task, engine.answer(row, task), ())

    whole, masked = "albedo.psnr@whole-srgb-raw", "albedo.psnr@masked-srgb-raw"
    pasted = values(albedo)
    assert "mask.iou" not in pasted
    assert values(albedo.replace(mask=task.mask)) == pasted  # that it was handed
    own = values(albedo.replace(mask=np.ones_like(task.mask)))
    assert own["mask.iou"] == pytest.approx(float(task.mask.mean()), rel=1e-3)
    assert own[masked] == pasted[masked]
    assert own[whole] < pasted[whole] - 10


def answer_all(suite: Suite, folder: Path) -> None:
    """Right answers to everything about the first scene."""
    for table, protocol in (("inverse", "single-image"), ("rendering", "given"), ("relighting", "from-image-sd")):
        for task in tasks(suite, table, protocol, [suite.scenes[0]]):
            target = folder / task.folder
            target.mkdir(parents=True, exist_ok=True)
            if task.truth_maps is not None:
                write_exr(target / "intrinsics.exr", intrinsics_channels(task.truth_maps))
            if task.truth_image is not None:
                write_exr(target / f"{task.answer}.exr", image_channels(task.truth_image))


def test_a_sound_folder_passes_with_what_others_leave_in_it(suite: Suite, tmp_path: Path) -> None:
    """The export's own files, notes and hidden files are nobody's answer."""
    folder = tmp_path / "mine"
    export_inputs(suite, folder)
    answer_all(suite, folder)
    (folder / "README.txt").write_text("notes")
    (folder / ".DS_Store").write_text("")
    (folder / "conventions.toml").write_text('roughness = "perceptual"\n')
    check_predictions(prediction_rows({"mine": folder}), suite)


def test_every_problem_is_listed_at_once(suite: Suite, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    answer_all(suite, folder)
    inverse, given = first(suite, "inverse", "single-image"), first(suite, "rendering", "given")
    maps, renders = folder / inverse.folder, folder / given.folder
    (maps / "albedo.png").write_text("no picture")
    Image.fromarray(np.zeros((8, 16), np.uint8)).save(maps / "metallic.png")
    Image.fromarray(np.zeros((32, 32), np.uint8)).save(maps / "roughnes.png")
    Image.fromarray(np.zeros((32, 32, 3), np.uint8)).save(renders / "render_given.png")
    Image.fromarray(np.zeros((32, 32, 3), np.uint8)).save(folder / "stray.png")
    (folder / "ball-0_l0_m050_r050").mkdir()
    (folder / "conventions.toml").write_text(
        'roughness = "squared"\nnormals = "opencv"\nnormal_axes = ["x", "y", "y"]\n'
    )
    other = tmp_path / "other"
    (other / given.folder).mkdir(parents=True)
    (other / given.folder / "render_given.exr").write_bytes(b"no EXR")
    with pytest.raises(PredictionError) as error:
        check_predictions(prediction_rows({"mine": folder, "other": other}), suite)
    for expected in (
        "conventions.toml: unknown key 'normals', expected some of normal_axes",
        "conventions.toml: roughness is 'squared', expected 'perceptual' or 'alpha'",
        "conventions.toml: normal_axes is ['x', 'y', 'y']",
        "albedo.png is not a readable PNG",
        "metallic.png: metallic is 16 x 8 pixels, expected 32 x 32",
        "roughnes.png: answers no question about this picture",
        "render_given is there as EXR and as PNG",
        "stray.png: lies outside the pictures' folders",
        "ball-0_l0_m050_r050: the suite 'ball' has no such picture, expected the folders' names of `unirender bench "
        "export`, like ",
        f"{other / given.folder / 'render_given.exr'}: not a readable OpenEXR file",
    ):
        assert sum(expected in problem for problem in error.value.problems) == 1, (expected, error.value.problems)
    assert len(error.value.problems) == 10
    assert "10 problems, nothing was run" in str(error.value)


def test_values_outside_the_contract_are_problems(suite: Suite, tmp_path: Path) -> None:
    task, path = asked(suite, tmp_path, "intrinsics.exr")
    channels = intrinsics_channels(suite.intrinsics(task.scene, task.scene.materials[0]))
    write_exr(path, channels | {"albedo.R": channels["albedo.R"] + 1})
    (problem,) = problems_of(suite, tmp_path)
    assert re.search(r"intrinsics.exr: albedo: got values in .*expected \[0, 1\]", problem)
    write_exr(path, {"albedo.X": channels["albedo.R"]})
    assert "intrinsics.exr has no map, expected channels like albedo.R" in problems_of(suite, tmp_path)[0]
    path.unlink()
    assert "no file answers any question" in problems_of(suite, tmp_path)[0]


def problems_of(suite: Suite, folder: Path) -> tuple[str, ...]:
    """What the check before a run says; nothing if the folder passes."""
    try:
        check_predictions(prediction_rows({"mine": folder}), suite)
    except PredictionError as error:
        return error.problems
    return ()


def test_a_picture_without_its_channels_is_named(suite: Suite, tmp_path: Path) -> None:
    """Every line says which file it is about."""
    task, path = asked(suite, tmp_path, "render_given.exr", "rendering", "given")
    assert task.truth_image is not None
    write_exr(path, {f"image.{c}": task.truth_image[..., i] for i, c in enumerate("RGB")})
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(f"{path}: EXR channels R, G, B missing")


@pytest.mark.parametrize("name", ["roughness.R", "metalic.Y", "normals.X", "albedo", "std.R"])
def test_channels_that_nothing_reads_are_problems(suite: Suite, tmp_path: Path, name: str) -> None:
    """Beside known ones, too: a misspelt map would be a map that the method does not have."""
    task, path = asked(suite, tmp_path, "intrinsics.exr")
    truth = suite.intrinsics(task.scene, task.scene.materials[0])
    channels = intrinsics_channels(truth)
    write_exr(path, channels | image_channels(truth.require("diffuse")["diffuse"]) | {"A": task.mask[..., 0]})
    assert problems_of(suite, tmp_path) == ()  # what unirender writes
    write_exr(path, channels | {name: channels["roughness.Y"]})
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(f"{path}: has channels that are not read, {name}; expected names of albedo.R")
    write_exr(path, {key: value for key, value in channels.items() if key != "albedo.R"})
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(f"{path}: EXR channels albedo.R missing")


@pytest.mark.parametrize("level", [0, 127, 128, 255])
def test_a_picture_s_background_is_no_normal(suite: Suite, tmp_path: Path, level: int) -> None:
    """Along the outline, where a method's mask is smaller: of length 0, as in an EXR, and no direction."""
    task, path = asked(suite, tmp_path, "normal.png")
    found = suite.intrinsics(task.scene, task.scene.materials[0]).require("normal")["normal"].copy()
    found[:, 14:16] = 0
    levels = np.where(found.any(axis=-1, keepdims=True), np.round((found + 1) / 2 * 255), level)
    Image.fromarray(levels.astype(np.uint8)).save(path)
    assert problems_of(suite, tmp_path) == ()
    read = engine.answer(prediction_rows({"mine": tmp_path})[0], task).maps
    assert read is not None
    np.testing.assert_allclose(read.require("normal")["normal"], found, rtol=0, atol=0.01)
    picture = Image.fromarray(levels.astype(np.uint8))
    for grey in (picture.convert("L"), Image.new("RGB", picture.size, (level, level, level))):  # one channel is none
        grey.save(path)
        (problem,) = problems_of(suite, tmp_path)
        assert problem.startswith(f"{path}: the three channels of its normal are equal, expected x, y and z")


def test_normals_that_are_encoded_as_colours_are_refused(suite: Suite, tmp_path: Path) -> None:
    """They are longer than 1, as no mean of normals is: their directions would be off by some 30 degrees."""
    task, path = asked(suite, tmp_path, "normal.png")
    shown = (suite.intrinsics(task.scene, task.scene.materials[0]).require("normal")["normal"] + 1) / 2
    for values, encoded in ((shown, False), ((shown + 0.5) / 2, False), (srgb_encode(shown), True)):
        Image.fromarray(np.round(255 * values).astype(np.uint8)).save(path)
        problems = problems_of(suite, tmp_path)
        assert bool(problems) == encoded
        assert all(
            re.match(rf"{path}: its normals have a length of 1\.\d+ \(median\), expected 1", p) for p in problems
        )


@pytest.mark.parametrize("bits", [8, 16])
def test_a_transparent_picture_has_to_say_that_it_is_straight(suite: Suite, tmp_path: Path, bits: int) -> None:
    """Taken for premultiplied its edges were too bright. Opaque alpha says nothing, and that of maps is no matter."""
    task, path = asked(suite, tmp_path, "render_given.png", "rendering", "given")
    assert task.truth_image is not None
    straight = srgb_encode(np.clip(unpremultiply(task.truth_image, task.mask), 0, 1))

    def write(path: Path, alpha: np.ndarray) -> None:
        levels = np.round(np.concatenate([straight, alpha], axis=-1) * (2**bits - 1))
        write_png16(path, levels.astype(np.uint16)) if bits == 16 else Image.fromarray(levels.astype(np.uint8)).save(
            path
        )

    write(path, np.ones_like(task.mask))
    assert problems_of(suite, tmp_path) == ()
    write(path, task.mask)
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(f"{path}: the picture has transparent pixels")
    (tmp_path / "conventions.toml").write_text("premultiplied = false\n")
    assert problems_of(suite, tmp_path) == ()
    found = engine.answer(prediction_rows({"mine": tmp_path})[0], task).image
    assert found is not None
    np.testing.assert_allclose(found, np.clip(task.truth_image, 0, task.mask), rtol=0, atol=0.006)
    (tmp_path / "conventions.toml").unlink()
    path.unlink()
    write(asked(suite, tmp_path, "albedo.png")[1], task.mask)
    assert problems_of(suite, tmp_path) == ()


@pytest.mark.parametrize("colour", ["linear", "srgb"])
def test_values_too_large_to_score_are_problems(suite: Suite, tmp_path: Path, colour: str) -> None:
    """What the check lets through is scored with numbers."""
    (tmp_path / "conventions.toml").write_text(f'exr_colour = "{colour}"\n')
    task, path = asked(suite, tmp_path, "render_given.exr", "rendering", "given")

    def write(value: float) -> None:
        picture = np.zeros((*task.mask.shape[:2], 3), np.float32)
        picture[16, 16] = value
        write_exr(path, image_channels(picture), half=False)

    write(9e29 if colour == "linear" else 1e12)
    assert problems_of(suite, tmp_path) == ()
    row = prediction_rows({"mine": tmp_path})[0]
    assert not np.isnan(list(engine.score(task, engine.answer(row, task), ()).values())).any()
    for value in (3e38, -3e38):
        write(value)
        (problem,) = problems_of(suite, tmp_path)
        assert f"{path}: the picture has values up to" in problem
        assert "expected at most 1e+30" in problem
    path.unlink()
    _, maps = asked(suite, tmp_path, "intrinsics.exr")
    specular = np.full((*task.mask.shape[:2], 3), 3e38, np.float32)
    write_exr(maps, intrinsics_channels(Intrinsics(specular=specular)), half=False)
    (problem,) = problems_of(suite, tmp_path)
    assert f"{maps}: specular has values up to 3e+38" in problem


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda picture, mask: 255 * picture, r"its median in the mask is .* \(0 to 255\?\)"),
        (lambda picture, mask: 2 * picture - mask, r"a tenth of its values in the mask is below .* \(-1 to 1\?\)"),
        (lambda picture, mask: picture + (1 - mask), r"\(median\) where no object is, .*premultiplied = false"),
    ],
)
def test_pictures_in_other_units_are_refused(suite: Suite, tmp_path: Path, change: Any, said: str) -> None:
    """In a folder before anything runs, of a method as it answers; declared, straight colour is right."""
    task, path = asked(suite, tmp_path / "mine", "render_given.exr", "rendering", "given")
    assert task.truth_image is not None
    made = change(task.truth_image, task.mask).astype(np.float32)
    write_exr(path, image_channels(task.truth_image), half=False)
    assert problems_of(suite, tmp_path / "mine") == ()
    write_exr(path, image_channels(made), half=False)
    (problem,) = problems_of(suite, tmp_path / "mine")
    assert re.search(f"{path}: .*{said}", problem), problem
    method = SimpleNamespace(name="mine", config={}, render=lambda intrinsics: made)
    with pytest.raises(UnirenderError, match=r"method 'mine', render_given .* straight colour times the mask"):
        engine.answer(make_row(method, "external"), task)
    if "premultiplied" in said:
        (tmp_path / "mine" / "conventions.toml").write_text("premultiplied = false\n")
        assert problems_of(suite, tmp_path / "mine") == ()


def test_stray_pixels_and_ringing_are_scored(suite: Suite) -> None:
    task = first(suite, "rendering", "given")
    assert task.truth_image is not None
    rng = np.random.default_rng(0)
    made = (task.truth_image + (task.mask > 0) * rng.normal(0, 0.04, task.truth_image.shape)).astype(np.float32)
    made[0, 0] = 300
    made *= 5
    row = make_row(SimpleNamespace(name="mine", config={}, render=lambda intrinsics: made), "external")
    answered = engine.answer(row, task).image
    assert answered is not None
    np.testing.assert_array_equal(answered, made)


def test_settings_of_a_method_do_no_harm(suite: Suite, tmp_path: Path) -> None:
    answer_all(suite, tmp_path)
    (tmp_path / "config.toml").write_text("steps = 3\n")
    (tmp_path / "pyproject.toml").write_text("")
    assert problems_of(suite, tmp_path) == ()


def test_conventions_under_another_name_or_elsewhere_are_problems(suite: Suite, tmp_path: Path) -> None:
    """They would be ignored, and the numbers wrong."""
    answer_all(suite, tmp_path)
    task = first(suite, "relighting", "from-image-sd")
    (tmp_path / task.folder / task.answer).mkdir()
    (tmp_path / "conventions.toml").write_text("")
    paths = [
        tmp_path / "convention.toml",
        tmp_path / "conventions.toml.txt",
        tmp_path / task.folder / "conventions.toml",
        tmp_path / task.folder / task.answer / "conventions.toml",
    ]
    for path in paths:
        path.write_text("premultiplied = false\n")
    problems = problems_of(suite, tmp_path)
    assert len(problems) == len(paths), problems
    for path in paths:
        assert sum(f"{path}: is not read, expected {tmp_path / 'conventions.toml'} for" in p for p in problems) == 1


def test_conventions_are_undone(suite: Suite, tmp_path: Path) -> None:
    """The same truth in OpenCV axes, sRGB EXR, GGX alpha and straight colour scores as the truth; undeclared it does
    not."""
    inverse, given = first(suite, "inverse", "single-image"), first(suite, "rendering", "given")
    truth = suite.intrinsics(inverse.scene, inverse.scene.materials[0]).replace(specular=None, diffuse=None)
    maps = truth.require("albedo", "normal", "roughness")
    foreign = intrinsics_channels(truth)
    foreign |= {f"albedo.{c}": srgb_encode(maps["albedo"])[..., i] for i, c in enumerate("RGB")}
    foreign |= {f"normal.{c}": maps["normal"][..., i] * (1, -1, -1)[i] for i, c in enumerate("XYZ")}
    foreign["roughness.Y"] = maps["roughness"][..., 0] ** 2
    assert given.truth_image is not None
    straight = srgb_encode(np.where(given.mask > 0, given.truth_image / np.maximum(given.mask, 1e-6), 0))
    for task, name, channels in (
        (inverse, "intrinsics.exr", foreign),
        (given, "render_given.exr", image_channels(straight)),
    ):
        (tmp_path / "mine" / task.folder).mkdir(parents=True, exist_ok=True)
        write_exr(tmp_path / "mine" / task.folder / name, channels, half=False)

    def scores() -> dict[str, float]:
        row = prediction_rows({"mine": tmp_path / "mine"})[0]
        answered = [(task, engine.answer(row, task)) for task in (inverse, given)]
        return {key: value for task, found in answered for key, value in engine.score(task, found, ()).items()}

    wrong = scores()
    (tmp_path / "mine" / "conventions.toml").write_text(
        'normal_axes = ["+x", "-y", "-z"]\nexr_colour = "srgb"\nroughness = "alpha"\npremultiplied = false\n'
    )
    right = scores()
    edit = f"{given.quantity}.psnr@masked-srgb-raw"
    assert right["albedo.psnr@masked-srgb-raw"] > 50 > 20 > wrong["albedo.psnr@masked-srgb-raw"]
    assert right["normal.cosine"] > 0.999 > 0.5 > wrong["normal.cosine"]
    assert right["roughness.mse@masked"] < 1e-6 < 1e-4 < wrong["roughness.mse@masked"]
    assert right[edit] > 50 > 25 > wrong[edit]


def test_conventions_are_part_of_the_key(suite: Suite, tmp_path: Path) -> None:
    answer_all(suite, tmp_path / "mine")
    before = prediction_rows({"mine": tmp_path / "mine"})[0].config
    (tmp_path / "mine" / "conventions.toml").write_text("premultiplied = false\n")
    assert prediction_rows({"mine": tmp_path / "mine"})[0].config != before


def test_conventions_are_the_contract_by_default(tmp_path: Path) -> None:
    assert read_conventions(tmp_path) == Conventions()
    (tmp_path / "conventions.toml").write_bytes(b"\xef\xbb\xbfpremultiplied = false\r\n")  # as Windows editors do
    assert read_conventions(tmp_path) == Conventions(premultiplied=False)
    (tmp_path / "conventions.toml").write_text("premultiplied = 1")
    with pytest.raises(UnirenderError, match="premultiplied is 1, expected True or False"):
        read_conventions(tmp_path)
    (tmp_path / "conventions.toml").write_text("premultiplied = ")
    with pytest.raises(UnirenderError, match="not a readable TOML file"):
        read_conventions(tmp_path)


def test_an_edit_behind_a_link_to_a_folder_is_part_of_the_key(suite: Suite, tmp_path: Path) -> None:
    """The answers are kept elsewhere: those of an edited one were taken for scored."""
    answer_all(suite, tmp_path / "kept")
    (tmp_path / "mine").mkdir()
    for folder in (tmp_path / "kept").iterdir():
        (tmp_path / "mine" / folder.name).symlink_to(folder)
    before = prediction_rows({"mine": tmp_path / "mine"})[0].config
    assert before == prediction_rows({"mine": tmp_path / "kept"})[0].config
    next((tmp_path / "kept").glob("*/*.exr")).unlink()
    assert prediction_rows({"mine": tmp_path / "mine"})[0].config != before


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("intrinsics.EXR", "intrinsics.exr"),
        ("Albedo.png", "albedo.png"),
        ("albedo.jpg", "albedo.png"),
        ("albedo.exr", "albedo.R, albedo.G, albedo.B of intrinsics.exr"),
        ("roughness.EXR", "roughness.Y of intrinsics.exr"),
        ("edit_m1_r05.exr", "edit_m100_r050.exr"),
        ("basecolor.png", "albedo.png"),
        ("metallicity.png", "metallic.png"),
        ("ORM.png", "roughness.png and metallic.png, its green and its blue channel"),
    ],
)
def test_the_name_that_was_probably_meant_is_said(suite: Suite, tmp_path: Path, name: str, meant: str) -> None:
    answer_all(suite, tmp_path)
    path = tmp_path / first(suite, "rendering", "from-image").folder / name
    path.write_bytes(b"")
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(f"{path}: answers no question about this picture (did you mean {meant}?), expected edit_")


def test_a_folder_for_each_map_is_told_what_is_wrong(suite: Suite, tmp_path: Path) -> None:
    task, path = asked(suite, tmp_path, "albedo.png")
    (tmp_path / "normal").mkdir()
    Image.new("RGB", (32, 32)).save(tmp_path / "normal" / f"{task.folder}_normal.png")
    Image.new("RGB", (32, 32)).save(path)
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(
        f"{tmp_path / 'normal'}: has 1 files named as pictures ({task.folder}_normal.png), expected a folder"
    )


def test_what_is_wrong_with_all_pictures_is_said_three_times(suite: Suite, tmp_path: Path) -> None:
    pictures = sorted({task.folder for task in tasks(suite, "inverse", "single-image", list(suite.scenes))})
    assert len(pictures) > 3
    for number, picture in enumerate(pictures):
        (tmp_path / picture).mkdir()
        Image.new("RGB", (31 - number, 32)).save(tmp_path / picture / "albedo.png")
    Image.new("RGB", (31, 32)).save(tmp_path / pictures[-1] / "normal.png")
    with pytest.raises(PredictionError) as caught:
        check_predictions(prediction_rows({"mine": tmp_path}), suite)
    assert len(caught.value.problems) == len(pictures) + 1
    _, *lines = str(caught.value).splitlines()
    more = f"... and {len(pictures) - 3} more like this, of other pictures"
    assert lines == [*caught.value.problems[:3], more, caught.value.problems[-1]]


def test_folders_under_names_of_before_are_said_three_times(suite: Suite, tmp_path: Path) -> None:
    for number in range(5):
        (tmp_path / f"ball-{number}_l0_m050_r050").mkdir()
    with pytest.raises(PredictionError) as caught:
        check_predictions(prediction_rows({"mine": tmp_path}), suite)
    lines = str(caught.value).splitlines()
    assert len(lines) == 5
    assert lines[-1] == "... and 2 more like this, of other pictures"


def test_another_methods_folder_and_an_archive_are_named_as_such(suite: Suite, tmp_path: Path) -> None:
    answer_all(suite, tmp_path / "all" / "other")
    (problem,) = problems_of(suite, tmp_path / "all")
    assert problem.startswith(f"{tmp_path / 'all' / 'other'}: has folders of ")
    assert problem.endswith(f"score it by itself, with --predictions NAME={tmp_path / 'all' / 'other'}")
    (tmp_path / "mine.zip").write_bytes(b"PK")
    with pytest.raises(UnirenderError, match=r"mine\.zip: a file, unpack it if it is an archive; expected a folder"):
        prediction_rows({"mine": tmp_path / "mine.zip"})


def test_files_in_an_answers_folder_are_problems(suite: Suite, tmp_path: Path) -> None:
    """Nobody looks for an answer there; the export's own files lie there rightly. A link to nothing is no file."""
    export_inputs(suite, tmp_path)
    answer_all(suite, tmp_path)
    task = first(suite, "relighting", "from-image-sd")
    folder = tmp_path / task.folder / task.answer
    assert {path.name for path in folder.iterdir()} == {"given.exr"}
    (folder / "notes.txt").write_text("notes")
    (folder / ".hidden.png").write_text("")
    assert problems_of(suite, tmp_path) == ()
    (folder / "out.exr").write_text("an answer")
    (folder / "deeper").mkdir()
    twin = tmp_path / task.folder.upper()
    twin.mkdir()
    pipe, loop = tmp_path / task.folder / "normal.png", tmp_path / task.folder / "roughness.png"
    os.mkfifo(pipe)
    loop.symlink_to(loop.name)
    links = (tmp_path / "far.png", tmp_path / task.folder / "albedo.png", folder / "given.png")
    for link in links:
        link.symlink_to("nowhere.png")
    problems = problems_of(suite, tmp_path)
    assert len(problems) == 8, problems
    assert any(problem.startswith(f"{pipe}: a pipe, a socket or a device, expected a file; ") for problem in problems)
    assert f"{loop}: a link to {loop.name}, which is not there; copy the file, or remove the link" in problems
    expected = f"the suite {suite.spec.name!r} has no such picture, expected the folders' names of"
    expected += f" `unirender bench export`, like {task.folder}"
    assert f"{twin}: {expected}; {task.folder} is there, too: keep one of them" in problems
    twin.rmdir()
    twin.symlink_to(task.folder)  # as on a file system without case, where it is that folder
    assert f"{twin}: {expected}" in problems_of(suite, tmp_path)
    for path in (folder / "out.exr", folder / "deeper"):
        assert f"{path}: lies in a folder where no answer is looked for, expected {folder}.exr or .png" in problems
    for link in links:
        assert f"{link}: a link to nowhere.png, which is not there; copy the file, or remove the link" in problems


def test_answers_to_another_truth_are_refused(suite: Suite, tmp_path: Path) -> None:
    """In one line, however many pictures there are; the `meta.json` of other programs says nothing of it."""
    export_inputs(suite, tmp_path)
    answer_all(suite, tmp_path)
    metas = sorted(tmp_path.glob("*/meta.json"))
    metas[0].write_text('{"fov_deg": 36}')
    metas[1].write_text("no JSON")
    metas[2].write_text("[1]")
    assert problems_of(suite, tmp_path) == ()
    for path in metas[3:5]:
        path.write_text(json.dumps(json.loads(path.read_text()) | {"suite_sha256": "0" * 64}))
    (problem,) = problems_of(suite, tmp_path)
    assert problem.startswith(f"{metas[3]}: suite_sha256 is {'0' * 64}, and {suite.sha256} of the truth here (2 such")
    assert "export them again (`unirender bench export`) and predict anew" in problem
