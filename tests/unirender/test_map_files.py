"""A file for each map, and edits of the pictures in a result folder: as image editors save them."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from icc_profiles import matrix_profile
from PIL import Image, ImageCms
from seen_shapes import as_maps
from seen_shapes import ball as ball_shape
from sixteen_bit_files import write_png16

from unirender.camera import Camera
from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.exr import image_channels, intrinsics_channels, on_pole_grid, read_exr, write_exr
from unirender.files import read_result, write_result
from unirender.intrinsics import IMAGE_MAPS, RADIANCE_MAPS, Intrinsics
from unirender.visualization import map_picture

SIZE = 24
STEP = 1 / 255
MIDDLE = slice(10, 14)  # rows and columns that are painted
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def lit_ball() -> Intrinsics:
    """A ball whose maps vary, with s and a light above display white."""
    normal, mask, _ = ball_shape(SIZE)
    maps = as_maps(normal, mask).replace(camera=Camera(40))
    mask = maps.require("mask")["mask"]
    ramp = np.linspace(0.2, 0.8, SIZE, dtype=np.float32)[:, None] * mask
    colour = ramp * np.array([0.9, 0.6, 0.3], np.float32)
    light = np.random.default_rng(0).uniform(0, 3, (8, 16, 3)).astype(np.float32)
    return maps.replace(
        albedo=colour,
        roughness=ramp,
        metallic=0.5 * ramp,
        specular=3 * colour,
        diffuse=0.8 * colour,
        environment=light,
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_result(tmp_path, lit_ball(), {})
    return tmp_path


def opened(path: Path) -> Image.Image:
    with Image.open(path) as file:
        return file.copy()


def paint(path: Path, value: int | tuple[int, ...]) -> None:
    """Fills the middle of a picture."""
    image = opened(path)
    image.paste(value, (MIDDLE.start, MIDDLE.start, MIDDLE.stop, MIDDLE.stop))
    image.save(path)


def with_alpha(image: Image.Image, path: Path) -> None:
    image.convert("RGBA").save(path.with_suffix(".png"), icc_profile=SRGB)


SAVES: dict[str, Callable[[Image.Image, Path], None]] = {
    "untouched": lambda image, path: image.save(path.with_suffix(".png")),
    "alpha and a profile": with_alpha,
    "TIFF": lambda image, path: image.save(path.with_suffix(".TIF"), format="TIFF"),
    "grey as colour": lambda image, path: image.convert("RGB").save(path.with_suffix(".bmp")),
}


@pytest.mark.parametrize("case", SAVES)
def test_saving_without_a_change_edits_nothing_and_is_the_maps_in_eight_bits(case: str, folder: Path) -> None:
    expected = lit_ball()
    for name in IMAGE_MAPS:
        image = opened(folder / f"{name}.png")
        (folder / f"{name}.png").unlink()
        SAVES[case](image, folder / name)
    stored = read_result(folder, edits=False)
    for name, value in read_result(folder).maps.items():
        np.testing.assert_array_equal(value, stored.maps[name], err_msg=name)
    (folder / "intrinsics.exr").unlink()
    found = read_result(folder)
    assert (found.present, found.camera) == (expected.present, expected.camera)
    np.testing.assert_array_equal(found.require("environment")["environment"], expected.environment)
    for name in IMAGE_MAPS:
        shown, wanted = map_picture(name, found.maps[name]), map_picture(name, expected.maps[name])
        tolerance = STEP if name == "normal" else 0.501 * STEP  # it is brought to length 1 again
        np.testing.assert_allclose(shown, wanted, rtol=0, atol=tolerance, err_msg=name)


def test_an_edit_counts_where_it_was_made(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What was not painted keeps its radiance above display white, and its digits."""
    stored = read_result(folder, edits=False)
    paint(folder / "albedo.png", (250, 200, 30))
    paint(folder / "roughness.png", 51)
    paint(folder / "specular.png", (0, 0, 255))
    with caplog.at_level(logging.WARNING):
        found = read_result(folder)
    said = "albedo.png (4.26% of the object), roughness.png (4.26% of the object), specular.png (4.26% of the object)"
    assert said in caplog.text
    for name, value in {"albedo": (250, 200, 30), "roughness": (51,), "specular": (0, 0, 255)}.items():
        middle = map_picture(name, found.maps[name])[MIDDLE, MIDDLE]
        np.testing.assert_allclose(middle, np.broadcast_to(np.array(value) / 255, middle.shape), atol=1e-6)
        beside = np.ones((SIZE, SIZE), bool)
        beside[MIDDLE, MIDDLE] = False
        np.testing.assert_array_equal(found.maps[name][beside], stored.maps[name][beside])
    assert found.maps["specular"].max() > 1
    for name in ("normal", "metallic", "diffuse", "mask", "environment"):
        assert np.array_equal(found.maps[name], stored.maps[name]), name


def test_pictures_beside_maps_of_another_program_are_no_edits(folder: Path) -> None:
    """They may show anything, in any encoding."""
    albedo = lit_ball().require("albedo")["albedo"]
    write_exr(folder / "intrinsics.exr", intrinsics_channels(Intrinsics(albedo=0.5 * albedo)), half=False)
    np.testing.assert_array_equal(read_result(folder).require("albedo")["albedo"], 0.5 * albedo)


def test_a_mask_that_was_painted_counts(folder: Path) -> None:
    paint(folder / "mask.png", 0)
    assert read_result(folder).require("mask")["mask"][MIDDLE, MIDDLE].max() == 0


def test_where_an_edit_is_transparent_the_map_stays(folder: Path) -> None:
    stored = read_result(folder, edits=False).require("albedo")["albedo"]
    image = Image.new("RGBA", (SIZE, SIZE))
    image.paste((255, 255, 255, 255), (MIDDLE.start, MIDDLE.start, MIDDLE.stop, MIDDLE.stop))
    image.save(folder / "albedo.png")  # a layer by itself
    found = read_result(folder).require("albedo")["albedo"]
    assert found[MIDDLE, MIDDLE].min() == 1
    np.testing.assert_array_equal(found[: MIDDLE.start], stored[: MIDDLE.start])


def paint_light(folder: Path) -> None:
    """Switches a quarter of it off."""
    image = opened(folder / "environment.png")
    image.paste((0, 0, 0), (0, 0, 4, 8))
    image.save(folder / "environment.png")


@pytest.mark.parametrize("lit", [True, False])
def test_a_light_that_was_painted_takes_its_s_and_d_along(
    lit: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, maps = tmp_path, lit_ball()
    write_result(folder, maps if lit else maps.replace(specular=None, diffuse=None), {})
    stored = read_result(folder).require("environment")["environment"]
    assert not caplog.text
    paint_light(folder)
    found = read_result(folder)
    assert "environment.png: specular and diffuse follow from it" in caplog.text
    light = found.require("environment")["environment"]
    assert not light[:, :4].any()
    np.testing.assert_array_equal(light[:, 4:], stored[:, 4:])
    assert not {"specular", "diffuse"} & set(found.present)
    assert (read_result(folder, light=False).specular is not None) == lit


def test_a_light_whose_file_was_edited_is_on_the_grid_it_was_on(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An editor keeps no mark; its picture beside it is that of the old light, and no edit."""
    channels, attributes = read_exr(folder / "environment.exr")
    assert on_pole_grid(attributes)
    brighter = np.stack([2 * channels[name] for name in "RGB"], axis=-1)
    write_exr(folder / "environment.exr", image_channels(brighter), half=False)
    found = read_result(folder)
    np.testing.assert_array_equal(found.require("environment")["environment"], brighter)
    assert not {"specular", "diffuse"} & set(found.present)
    assert "environment.exr: edited, so that specular and diffuse follow from it" in caplog.text
    (folder / "intrinsics.exr").unlink()  # of ours, which alone say whose picture is beside it
    with pytest.raises(UnirenderError, match="is no environment that unirender wrote"):
        read_result(folder)
    caplog.clear()
    write_result(folder, lit_ball().replace(specular=None, diffuse=None), {})
    write_exr(folder / "environment.exr", image_channels(brighter), half=False)
    np.testing.assert_array_equal(read_result(folder).require("environment")["environment"], brighter)
    assert "environment.exr: edited" in caplog.text
    larger = np.ones((16, 32, 3), np.float32)
    write_exr(folder / "environment.exr", image_channels(larger), half=False)
    with pytest.raises(UnirenderError, match="is no environment that unirender wrote"):
        read_result(folder)


@pytest.mark.parametrize("file", ["environment.png", "environment.exr"])
def test_s_that_was_painted_beside_another_light_is_told(
    file: str, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    paint(folder / "specular.png", (0, 0, 255))
    if file == "environment.png":
        paint_light(folder)
    else:
        light = lit_ball().require("environment")["environment"]
        write_exr(folder / file, image_channels(2 * light), half=False)
    assert read_result(folder).specular is None
    assert "not looked at: diffuse.png, specular.png, since the light" in caplog.text
    assert "specular.png (" not in caplog.text


def test_what_is_hardly_there_was_not_edited(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A mask below one half everywhere, and normals that a picture shows as none."""
    maps = lit_ball()
    mask, roughness = maps.require("mask", "roughness").values()
    faint = Intrinsics(mask=0.4 * mask, roughness=roughness, normal=np.full((SIZE, SIZE, 3), 1e-9, np.float32))
    write_result(tmp_path, faint, {})
    stored = read_result(tmp_path, edits=False)
    for name, value in read_result(tmp_path).maps.items():
        np.testing.assert_array_equal(value, stored.maps[name], err_msg=name)
    assert "edited" not in caplog.text
    paint(tmp_path / "mask.png", 0)
    with pytest.raises(UnirenderError, match=r"mask.png: the mask is empty"):
        read_result(tmp_path)


def test_maps_of_other_programs_in_exr(tmp_path: Path) -> None:
    """Linear values; normals in [-1, 1]; premultiplied where there is alpha, and one channel of any name for grey."""
    maps = lit_ball()
    half = np.full((SIZE, SIZE, 1), 0.5, np.float32)
    albedo, normal, roughness = maps.require("albedo", "normal", "roughness").values()
    write_exr(tmp_path / "albedo.exr", image_channels(np.concatenate([albedo * half, half], axis=-1)), half=False)
    write_exr(tmp_path / "normal.exr", dict(zip("XYZ", np.moveaxis(normal, -1, 0), strict=True)), half=False)
    write_exr(tmp_path / "roughness.exr", {"V": roughness[..., 0]}, half=False)
    write_exr(tmp_path / "specular.exr", image_channels(maps.require("specular")["specular"]), half=False)
    opened_mask = Image.fromarray((255 * maps.require("mask")["mask"][..., 0]).round().astype(np.uint8))
    opened_mask.save(tmp_path / "mask.png")
    found = read_result(tmp_path)
    assert found.present == ("albedo", "normal", "roughness", "specular", "mask")
    for name in ("albedo", "normal", "roughness", "specular"):
        np.testing.assert_allclose(found.maps[name], maps.maps[name], rtol=0, atol=1e-6, err_msg=name)


def test_normals_of_an_exr_that_are_nowhere_negative_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    normal = lit_ball().require("normal")["normal"]
    facing = np.zeros_like(normal) + np.array([0, 0, 1], np.float32)
    for value, told in ((normal, False), (facing, False), (0.5 * normal + 0.5, True)):
        write_exr(tmp_path / "normal.exr", image_channels(value))
        caplog.clear()
        _ = read_result(tmp_path)
        assert ("no x, y or z is negative" in caplog.text) == told


def test_the_mask_is_what_is_opaque_and_sixteen_bits_are_kept(tmp_path: Path) -> None:
    values = np.zeros((SIZE, SIZE, 4), np.uint16)
    values[4:12] = (40000, 30000, 20001, 65535)
    write_png16(tmp_path / "albedo.png", values)
    found = read_result(tmp_path)
    mask = found.require("mask")["mask"]
    assert (mask[4:12] == 1).all()
    assert mask.sum() == 8 * SIZE
    shown = image_srgb(found.require("albedo")["albedo"])[5, 5]
    np.testing.assert_allclose(shown, np.array([40000, 30000, 20001]) / 65535, rtol=0, atol=1e-5)


def test_colours_are_converted_to_srgb_and_data_are_not(folder: Path) -> None:
    """A profile of twice the gamma's effect: linear values."""
    (folder / "intrinsics.exr").unlink()
    primaries = np.array([[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]])
    linear = matrix_profile(primaries, 1.0)
    for name in ("albedo", "normal"):
        Image.new("RGB", (SIZE, SIZE), (128, 128, 255)).save(folder / f"{name}.png", icc_profile=linear)
    found = read_result(folder)
    np.testing.assert_allclose(found.require("albedo")["albedo"][12, 12, 0], 128 / 255, atol=0.02)  # not 0.22
    np.testing.assert_allclose(found.require("normal")["normal"][12, 12], [0, 0, 1], atol=0.01)


def _remove_alone(folder: Path) -> None:
    (folder / "intrinsics.exr").unlink()


def _smaller(folder: Path) -> None:
    opened(folder / "albedo.png").resize((12, 12)).save(folder / "albedo.png")


def _smaller_light(folder: Path) -> None:
    opened(folder / "environment.png").resize((8, 4)).save(folder / "environment.png")


def _smaller_alone(folder: Path) -> None:
    _remove_alone(folder)
    _smaller(folder)


def _packed(folder: Path) -> None:
    Image.new("RGB", (SIZE, SIZE), (255, 128, 0)).save(folder / "roughness.png")


def _twice(folder: Path) -> None:
    opened(folder / "albedo.png").save(folder / "albedo.jpg")


def _encoded_normals(folder: Path) -> None:
    normals = np.asarray(opened(folder / "normal.png")) / np.float32(255)
    Image.fromarray((255 * image_srgb(normals)).astype(np.uint8)).save(folder / "normal.png")


def _display_normals_in_exr(folder: Path) -> None:
    (folder / "normal.png").unlink()
    normal, mask = lit_ball().require("normal", "mask").values()
    write_exr(folder / "normal.exr", image_channels((0.5 * normal + 0.5) * mask))


def _rough(folder: Path) -> None:
    (folder / "roughness.png").unlink()
    write_exr(folder / "roughness.exr", {"Y": np.full((SIZE, SIZE), 2.0)})


def _odd_channels(folder: Path) -> None:
    (folder / "albedo.png").unlink()
    write_exr(folder / "albedo.exr", {"U": np.zeros((SIZE, SIZE)), "V": np.zeros((SIZE, SIZE))})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_smaller, r"albedo.png: is 12 x 12 pixels, expected 24 x 24 like intrinsics.exr; resample it"),
        (_smaller_light, r"environment.png: is 8 x 4 pixels, expected 16 x 8 like environment.exr; resample it"),
        (_smaller_alone, r"albedo.png: is 12 x 12 pixels, expected 24 x 24 like the other maps; resample it"),
        (_packed, r"roughness.png is in colour: .* roughness is the green channel"),
        (_twice, r"albedo.png: is the map albedo, as albedo.jpg is; keep the one that counts"),
        (_encoded_normals, r"normal.png: its normals have a length of 1\.\d+ \(median\), expected 1: write \(n \+ 1\)"),
        (_display_normals_in_exr, r"normal.exr: its normals have a length of 1\.\d+ .* an EXR holds the unit normals"),
        (_rough, r"roughness: got values in \[0, 2\], expected \[0, 1\]"),
        (_odd_channels, r"albedo.exr: has the channels U, V, expected R, G and B; rename them"),
    ],
)
def test_what_is_no_such_map_is_one_sentence(change: Callable[[Path], None], said: str, folder: Path) -> None:
    change(folder)
    with pytest.raises(UnirenderError, match=said):
        read_result(folder)


def test_pictures_of_other_names_and_what_a_picture_loses_are_told(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "albedo.std.png").write_bytes((folder / "albedo.png").read_bytes())  # of several samples
    assert read_result(folder).present == lit_ball().present
    assert not caplog.text
    (folder / "albedo copy.png").write_bytes((folder / "albedo.png").read_bytes())
    _ = read_result(folder)
    assert "not read: albedo copy.png; maps are named albedo, normal, roughness," in caplog.text
    (folder / "intrinsics.exr").unlink()
    image = opened(folder / "albedo.png").convert("RGBA")
    image.paste((0, 0, 0, 0), (MIDDLE.start, MIDDLE.start, MIDDLE.stop, MIDDLE.stop))
    image.save(folder / "albedo.png")
    _ = read_result(folder)
    assert "albedo.png: is transparent on 4.26% of the object, where its hidden colour counts" in caplog.text
    assert "specular.png: is at display white on" in caplog.text
    assert "diffuse.png: is at" not in caplog.text
    assert set(RADIANCE_MAPS) <= set(read_result(folder).present)
    assert "environment.png" not in caplog.text
    (folder / "environment.exr").unlink()
    assert read_result(folder).environment is None
    assert "environment.png: not read: its values end at display white, expected environment.exr" in caplog.text
