"""Pictures and masks from files: what the pixels become, and which files are refused."""

import dataclasses
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from icc_profiles import SRGB_D50, matrix_profile
from PIL import ExifTags, Image, ImageCms
from sixteen_bit_files import write_png16, write_small_grey_png, write_tiff16

from unirender.color import srgb_decode, srgb_encode
from unirender.command_line.commands import Decompose, Relight, Render
from unirender.command_line.input_picture import BYTES_A_PIXEL, BYTES_OF_NONE, RENDERED_BYTES_A_PIXEL, read_input
from unirender.command_line.options import DecompositionOptions, InputOptions, OutputOptions
from unirender.errors import UnirenderError
from unirender.exr import image_channels, write_exr
from unirender.picture_files.display_files import (
    MAX_PIXELS,
    display_values,
    open_picture,
    srgb_values_and_remarks,
    stored_values,
)
from unirender.pictures import header_pixels, read_mask, read_picture
from unirender.pipelines.inputs import as_mask, as_picture

RNG = np.random.default_rng(0)


def test_alpha_becomes_the_mask_and_palettes_are_understood(tmp_path: Path) -> None:
    rgba = RNG.integers(0, 256, (4, 4, 4), dtype=np.uint8)
    rgba[0, 0, 3] = 255
    Image.fromarray(rgba).save(tmp_path / "a.png")
    mask = read_picture(tmp_path / "a.png").mask
    assert mask is not None
    np.testing.assert_array_equal(np.round(mask[..., 0] * 255), rgba[..., 3])
    Image.fromarray(rgba[..., :3]).convert("P").save(tmp_path / "p.png")
    assert read_picture(tmp_path / "p.png").image_srgb.shape == (4, 4, 3)


def test_a_palette_of_rgba_keeps_its_alpha() -> None:
    rgba = Image.new("RGBA", (12, 10), (200, 100, 9, 0))
    rgba.paste((200, 100, 9, 255), (3, 2, 9, 8))
    palette = rgba.quantize(8, method=Image.Quantize.FASTOCTREE)
    assert palette.mode == "P"
    assert "transparency" not in palette.info
    np.testing.assert_array_equal(as_picture(palette)[1], as_picture(rgba)[1])
    palette.info["icc_profile"] = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    np.testing.assert_array_equal(as_picture(palette)[1], as_picture(rgba)[1])


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_of_a_png_are_read_in_full(channels: int, tmp_path: Path) -> None:
    values = RNG.integers(0, 65536, (8, 9, channels))
    values[0, 0, -1] = 65535  # an alpha channel covers something
    write_png16(tmp_path / "a.png", values)
    picture, remarks = read_input(tmp_path / "a.png", None)
    colours = values[..., :3] if channels > 2 else values[..., [0, 0, 0]]
    np.testing.assert_allclose(picture.image_srgb, colours / 65535, rtol=0, atol=1e-7)
    assert "depth" not in remarks
    mask = read_mask(tmp_path / "a.png", (8, 9))[..., 0]
    expected = values[..., -1] if channels in (2, 4) else values.mean(axis=-1)
    np.testing.assert_allclose(mask, expected / 65535, rtol=0, atol=1e-7)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("channels", "extra"), [(3, None), (4, 0), (4, 1), (4, 2)])
def test_sixteen_bits_of_a_tiff_are_read_in_full(channels: int, extra: int | None, order: str, tmp_path: Path) -> None:
    """Of a fourth channel a tag says that it means nothing (0), or is alpha, premultiplied (1) or not (2)."""
    values = RNG.integers(0, 65536, (8, 9, channels))
    values[0, 0] = 65535
    stored = values.copy()
    if extra == 1:
        stored[..., :3] = (values[..., :3] * (values[..., 3:] / 65535)).round()
    for compressed in (False, True):
        write_tiff16(tmp_path / "a.tif", stored, order, extra=extra, compressed=compressed)
        picture, remarks = read_input(tmp_path / "a.tif", None)
        visible = values[..., 3] > 6000 if extra == 1 else np.ones((8, 9), bool)  # of dim ones rounding leaves less
        found = picture.image_srgb[visible]
        np.testing.assert_allclose(found, values[visible][:, :3] / 65535, rtol=0, atol=1e-4 if extra == 1 else 1e-7)
        assert "depth" not in remarks
        if extra:
            assert picture.mask is not None
            np.testing.assert_allclose(picture.mask, values[..., 3:] / 65535, rtol=0, atol=1e-7)


def test_sixteen_bits_are_turned_as_exif_says_and_a_transparent_colour_is_alpha(tmp_path: Path) -> None:
    values = RNG.integers(0, 65536, (8, 9, 3))
    write_tiff16(tmp_path / "a.tif", values, "<", orientation=6)
    np.testing.assert_allclose(read_picture(tmp_path / "a.tif").image_srgb, np.rot90(values, -1) / 65535, atol=1e-7)
    values[2, 3] = (1, 2, 3)
    write_png16(tmp_path / "a.png", values, chunks={b"tRNS": struct.pack(">HHH", 1, 2, 3)})
    mask = read_picture(tmp_path / "a.png").mask
    assert mask is not None
    np.testing.assert_array_equal(np.argwhere(mask[..., 0] == 0), [[2, 3]])


@pytest.mark.parametrize("bits", [1, 2, 4, 16])
def test_a_transparent_grey_is_alpha(bits: int, tmp_path: Path) -> None:
    values = RNG.integers(0, 2**bits, (8, 9))
    values[2:4], transparent = values[0, 0], int(values[0, 0])
    chunk = {b"tRNS": struct.pack(">H", transparent)}
    if bits == 16:
        write_png16(tmp_path / "a.png", values[..., None], chunks=chunk)
    else:
        write_small_grey_png(tmp_path / "a.png", values, bits, chunk)
    picture = read_picture(tmp_path / "a.png")
    assert picture.mask is not None
    np.testing.assert_array_equal(picture.mask[..., 0], values != transparent)
    np.testing.assert_allclose(picture.image_srgb[..., 0], values / (2**bits - 1), rtol=0, atol=1e-7)


TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {  # what each EXIF orientation asks for
    1: lambda picture: picture,
    2: lambda picture: picture[:, ::-1],
    3: lambda picture: picture[::-1, ::-1],
    4: lambda picture: picture[::-1],
    5: lambda picture: picture.swapaxes(0, 1),
    6: lambda picture: np.rot90(picture, -1),
    7: lambda picture: picture[::-1, ::-1].swapaxes(0, 1),
    8: np.rot90,
}


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_of_posed_pictures_lie_as_they_are_stored(orientation: int, tmp_path: Path) -> None:
    """Of every format, with 8 bits or 16; Pillow turns a TIFF while it decodes it."""
    values = RNG.integers(0, 65536, (8, 9, 3))
    write_tiff16(tmp_path / "a.tif", values, "<", orientation=orientation)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    eight = Image.fromarray((values >> 8).astype(np.uint8))
    for name in ("b.tif", "b.png"):
        eight.save(tmp_path / name, exif=exif)
    eight.save(tmp_path / "c.tif", exif=exif, compression="tiff_lzw")
    eight.convert("RGBA").save(tmp_path / "d.tif", exif=exif)  # pixels that Pillow maps into memory
    write_tiff16(tmp_path / "e.tif", values[..., :1], orientation=orientation, photometric=1)
    for name in ("a.tif", "b.tif", "b.png", "c.tif", "d.tif", "e.tif"):
        stored = values / 65535 if name in ("a.tif", "e.tif") else (values >> 8) / 255
        stored = stored[..., :1].repeat(3, axis=-1) if name == "e.tif" else stored
        colours, _ = srgb_values_and_remarks(tmp_path / name, name, upright=False)
        for found in (colours, stored_values(tmp_path / name, upright=False)):
            np.testing.assert_allclose(found[..., :3], stored, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(
            stored_values(tmp_path / name)[..., :3], TURNS[orientation](stored), atol=1e-6, err_msg=name
        )


def test_sixteen_bits_that_are_converted_lose_half_of_them_which_is_told(tmp_path: Path) -> None:
    profile = zlib.compress(matrix_profile(SRGB_D50, 1.0))
    write_png16(tmp_path / "a.png", np.full((8, 9, 3), 40000), chunks={b"iCCP": b"a\0\0" + profile})
    assert read_input(tmp_path / "a.png", None)[1]["depth"].startswith("its colours have 16 bits, of which 8 are read")


def test_a_tiff_with_channels_one_after_the_other_loses_half_of_its_bits_or_is_refused(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 65536, (8, 9, 3))
    write_tiff16(tmp_path / "a.tif", values, planar=True, compressed=True)
    picture, remarks = read_input(tmp_path / "a.tif", None)
    assert remarks["depth"].startswith("its colours have 16 bits, of which 8 are read")
    np.testing.assert_allclose(picture.image_srgb, values / 65535, atol=1 / 255)
    write_tiff16(tmp_path / "b.tif", values, planar=True)
    with pytest.raises(UnirenderError, match="channels are stored one after the other, uncompressed"):
        read_input(tmp_path / "b.tif", None)
    write_tiff16(tmp_path / "c.tif", values >> 8, planar=True, bits=8)
    picture, remarks = read_input(tmp_path / "c.tif", None)
    assert "depth" not in remarks
    np.testing.assert_allclose(picture.image_srgb, (values >> 8) / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("bits", "photometric", "signed", "told"),
    [
        (16, 1, False, None),
        (16, 0, False, "its 0 is white"),
        (12, 1, False, "its grey has 12 bits"),
        (16, 1, True, "its values are signed"),
        (8, 1, True, "its values are signed"),
    ],
)
def test_a_grey_tiff_whose_values_mean_something_else_is_refused(
    bits: int, photometric: int, signed: bool, told: str | None, tmp_path: Path
) -> None:
    """Pillow hands out such values as they are stored: inverted, or at a sixteenth or a half of their brightness."""
    values = RNG.integers(0, 2 ** (bits - signed), (8, 10, 1))
    write_tiff16(tmp_path / "a.tif", values, bits=bits, photometric=photometric, signed=signed)
    readers = (
        lambda: read_picture(tmp_path / "a.tif").image_srgb,
        lambda: read_mask(tmp_path / "a.tif", (8, 10)),
        lambda: as_picture(Image.open(tmp_path / "a.tif"))[0],
    )
    for read in readers:
        if told is None:
            np.testing.assert_allclose(read()[..., :1], values / 65535, rtol=0, atol=1e-6)
        else:
            with pytest.raises(UnirenderError, match=f"{told}, expected .* save it as PNG"):
                read()


def test_a_bitmap_of_16_bits_a_pixel_has_lost_nothing(tmp_path: Path) -> None:
    pixels = np.full((8, 9), 0xF81F, dtype="<u2")  # magenta: five bits of red, six of green, five of blue
    rows = np.pad(pixels, ((0, 0), (0, 1))).tobytes()
    sizes = struct.pack("<IiiHHIIiiII", 40, 9, 8, 1, 16, 3, len(rows), 0, 0, 0, 0)
    masks = struct.pack("<III", 0xF800, 0x07E0, 0x001F)
    start = 14 + len(sizes) + len(masks)
    (tmp_path / "a.bmp").write_bytes(
        b"BM" + struct.pack("<IHHI", start + len(rows), 0, 0, start) + sizes + masks + rows
    )
    picture, remarks = read_input(tmp_path / "a.bmp", None)
    assert "depth" not in remarks
    np.testing.assert_array_equal(picture.image_srgb, np.broadcast_to([1, 0, 1], (8, 9, 3)))


def test_an_alpha_that_a_float_writer_rounded_down_says_nothing_of_a_mask(tmp_path: Path) -> None:
    values = np.zeros((8, 9, 4), dtype=int)
    values[2:6, 2:6, :3], values[..., 3] = 65535, 65534
    write_png16(tmp_path / "mask.png", values)
    assert read_mask(tmp_path / "mask.png", (8, 9)).mean() == pytest.approx(16 / 72)
    assert "covers the whole frame" in read_input(tmp_path / "mask.png", None)[1]["mask"]


def test_a_file_of_several_pictures_gives_its_first_which_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = [Image.new("RGB", (9, 8), colour) for colour in ("white", "red", "green")]
    for suffix in ("gif", "png", "tif", "webp"):
        path = tmp_path / f"a.{suffix}"
        frames[0].save(path, save_all=True, append_images=frames[1:])
        picture, remarks = read_input(path, path)
        assert picture.image_srgb.min() > 0.99
        assert remarks["frames"] == "the file holds 3 pictures, of which the first is taken"
        assert remarks["mask_frames"] == "the mask's file holds 3 pictures, of which the first is taken"
        caplog.clear()
        read_mask(path, (8, 9))
        assert [record.getMessage() for record in caplog.records] == [f"{path}: {remarks['mask_frames']}"]
        frames[0].save(path)
        assert not {"frames", "mask_frames"} & set(read_input(path, path)[1])


def test_a_mask_outside_of_0_to_1_is_told_or_refused(tmp_path: Path) -> None:
    Image.new("RGB", (9, 8), "white").save(tmp_path / "a.png")
    mask = np.zeros((8, 9), np.float32)
    for most, least in ((1.05, -0.02), (1.05, 0), (1, -0.02), (1, 0)):
        mask[2:6], mask[0] = most, least
        write_exr(tmp_path / "m.exr", {"Y": mask})
        picture, remarks = read_input(tmp_path / "a.png", tmp_path / "m.exr")
        told = f"the mask has values in [{least}, {most}], clipped to [0, 1]" if (most, least) != (1, 0) else None
        assert remarks.get("mask_range") == told
        assert picture.mask is not None
        assert (picture.mask.min(), picture.mask.max()) == (0, 1)
    for wrong in (255.0, 3.0, -1.0):  # of 8 bits, an object's number, a depth
        mask[3] = wrong
        write_exr(tmp_path / "m.exr", {"Y": mask})
        with pytest.raises(
            UnirenderError, match=r"the mask has values in \[.*\], expected coverage in \[0, 1\]; divide"
        ):
            read_input(tmp_path / "a.png", tmp_path / "m.exr")


def test_exr_is_unpremultiplied_and_encoded(tmp_path: Path) -> None:
    alpha = np.array([[1.0, 0.5, 0.0]], dtype=np.float32)
    rgb = np.array([[0.2, 0.2, 0.2]], dtype=np.float32) * alpha
    write_exr(tmp_path / "a.exr", image_channels(np.stack([rgb, rgb, rgb * 9, alpha], axis=-1)))
    picture = read_picture(tmp_path / "a.exr")
    np.testing.assert_allclose(picture.image_srgb[0, :2, 0], srgb_encode(np.full(2, 0.2)), atol=1e-3)
    assert picture.image_srgb[0, 0, 2] == pytest.approx(1)
    assert picture.clipped == pytest.approx(1)


def test_the_combined_picture_of_a_layer_is_read(tmp_path: Path) -> None:
    path, light = tmp_path / "render.exr", np.full((4, 4), 0.75, np.float32)
    layer = {f"ViewLayer.Combined.{name}": light * (name != "B") for name in "RGBA"}
    write_exr(path, {**layer, "ViewLayer.Depth.Z": light, "ViewLayer.DiffCol.R": 0 * light})
    picture = read_picture(path)
    assert picture.mask is not None
    assert np.allclose(picture.image_srgb[0, 0], [1, 1, 0])  # straight: premultiplied 0.75 of coverage 0.75
    assert np.allclose(picture.mask, 0.75)
    write_exr(path, {**layer, **{name.replace("View", "Other"): value for name, value in layer.items()}})
    with pytest.raises(UnirenderError, match="rename those of the layer"):
        read_picture(path)


def test_an_exr_mask_beside_the_colours_is_their_alpha(tmp_path: Path) -> None:
    alpha = np.zeros((8, 9), np.float32)
    alpha[2:6, 2:6] = 1
    alpha[2, 2:6] = 0.5
    channels = image_channels(np.repeat(0.2 * alpha[..., None], 3, axis=-1))
    write_exr(tmp_path / "a.exr", channels | {"mask.Y": alpha})
    picture, remarks = read_input(tmp_path / "a.exr", None)
    np.testing.assert_array_equal(picture.mask, alpha[..., None])
    np.testing.assert_allclose(picture.image_srgb[alpha > 0], srgb_encode(np.full(3, 0.2, np.float32))[0], atol=1e-3)
    assert "alpha" not in remarks
    for factor, most in ((2, 1.5), (1.5, 1)):
        write_exr(tmp_path / "b.exr", channels | {"A": factor * alpha - 0.5, "mask.Y": alpha})
        _, remarks = read_input(tmp_path / "b.exr", None)
        assert remarks["alpha"] == f"A has values in [-0.5, {most}], clipped to [0, 1]"


def test_what_a_picture_cannot_show_is_told(tmp_path: Path) -> None:
    mask = np.zeros((10, 12), np.uint8)
    mask[2:8, 3:9] = 255
    for value, factor, kinds in [(200, 1.0, set()), (60, 1.0, {"dark"}), (0, 1.0, {"dark"}), (200, 0.7, {"coverage"})]:
        colours = np.full((10, 12, 3), 250, np.uint8)
        colours[mask > 0] = [value, 0, 0]  # what lies behind the object does not count
        Image.fromarray(np.dstack([colours, (factor * mask).astype(np.uint8)])).save(tmp_path / "a.png")
        assert set(read_input(tmp_path / "a.png", None)[1]) == kinds
    Image.new("L", (12, 10), 255).save(tmp_path / "mask.png")
    remarks = read_input(tmp_path / "a.png", tmp_path / "mask.png")[1]
    assert remarks == {"mask": "the mask covers the whole frame, which is taken as the object"}
    Image.new("L", (12, 10), 60).save(tmp_path / "mask.png")
    with pytest.raises(UnirenderError, match=r"the mask is empty: no pixel .* more than half, and the most by 0\.235"):
        read_input(tmp_path / "a.png", tmp_path / "mask.png")


@pytest.mark.parametrize(
    ("rows", "columns", "inverted", "told"),
    [
        ((3, 9), (3, 9), False, {}),
        ((3, 9), (3, 9), True, {"inverted": "the mask holds all four corners of the frame, expected"}),
        ((0, 10), (0, 6), True, {}),  # half of the frame
        ((3, 6), (3, 8), False, {"small": "the object covers 15 pixels:"}),
        ((3, 7), (3, 7), False, {}),
        ((3, 4), (3, 4), False, {"small": "the object covers 1 pixel:"}),
    ],
)
def test_a_mask_that_is_inverted_or_of_a_few_pixels_is_told(
    rows: tuple[int, int], columns: tuple[int, int], inverted: bool, told: dict[str, str], tmp_path: Path
) -> None:
    Image.new("RGB", (12, 10), "grey").save(tmp_path / "a.png")
    mask = np.zeros((10, 12), np.uint8)
    mask[slice(*rows), slice(*columns)] = 255
    Image.fromarray(255 - mask if inverted else mask).save(tmp_path / "m.png")
    remarks = read_input(tmp_path / "a.png", tmp_path / "m.png")[1]
    assert remarks.keys() == told.keys()
    assert all(remarks[kind].startswith(text) for kind, text in told.items())


def test_a_mask_on_its_side_is_told_of_the_exif_orientation(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (12, 10)).save(tmp_path / "a.jpg", exif=exif)
    Image.new("L", (12, 10), 255).save(tmp_path / "m.png")
    with pytest.raises(UnirenderError, match=r"12 x 10 pixels, expected 10 x 12 like the picture as its EXIF"):
        read_input(tmp_path / "a.jpg", tmp_path / "m.png")
    Image.new("L", (6, 5), 255).save(tmp_path / "m.png")
    with pytest.raises(UnirenderError, match=r"6 x 5 pixels, expected 10 x 12 like the picture$"):
        read_input(tmp_path / "a.jpg", tmp_path / "m.png")


def test_lost_highlights_and_an_underexposed_object_are_told(tmp_path: Path) -> None:
    """By shares of the object, whatever lies behind it; a highlight of three percent shows the exposure."""
    clipped = {"clipped": "8% of the object's pixels are clipped"}
    for bright, told in ((1, {"dark": "the object is dark, 99% of it below 0.2"}), (6, {}), (16, clipped)):  # of 200
        rgba = np.full((20, 20, 4), (255, 255, 255, 0), np.uint8)
        rgba[:10] = (60, 40, 20, 255)
        rgba[0, :bright, :3] = 255
        Image.fromarray(rgba).save(tmp_path / "a.png")
        remarks = read_input(tmp_path / "a.png", None)[1]
        assert remarks.keys() == told.keys()
        assert all(remarks[kind].startswith(text) for kind, text in told.items())


@pytest.mark.parametrize("stops", [3, 6])
def test_by_how_much_an_underexposed_picture_is_to_be_brightened_is_told(stops: int, tmp_path: Path) -> None:
    """Of a picture that reaches 0.8 of white at the exposures that were taught."""
    radiance = srgb_decode(np.linspace(0.2, 0.81, 400, dtype=np.float32).reshape(20, 20, 1).repeat(3, axis=-1))
    write_exr(tmp_path / "a.exr", image_channels(radiance / 2**stops))
    assert read_input(tmp_path / "a.exr", None)[1]["dark"].endswith(
        f"brighten the picture first, by some {stops} stops"
    )


def test_what_is_no_number_is_refused_with_its_place(tmp_path: Path) -> None:
    """NumPy writes it here: `write_exr` refuses."""
    pixels = np.full((4, 5, 4), 0.5, np.float32)
    for channel, value in ((1, np.nan), (3, np.inf)):
        broken = pixels.copy()
        broken[2, 3:, channel] = value
        channels = {name: np.ascontiguousarray(broken[..., i]) for i, name in enumerate("RGBA")}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "a.exr"))
        with pytest.raises(UnirenderError, match=r"2 of 20 pixels are NaN or infinite \(the first in row 2, column 3,"):
            read_picture(tmp_path / "a.exr")
    with pytest.raises(UnirenderError, match="2 of 20 pixels are NaN"):
        read_mask(tmp_path / "a.exr", (4, 5))


def test_a_little_negative_radiance_passes_and_is_told(tmp_path: Path) -> None:
    pixels = np.full((4, 5, 3), 0.5, np.float32)
    write_exr(tmp_path / "a.exr", image_channels(pixels))
    assert read_picture(tmp_path / "a.exr").negative == 0
    assert "negative" not in read_input(tmp_path / "a.exr", None)[1]
    pixels[0, 0] = (-0.25, -0.25, 0)
    write_exr(tmp_path / "a.exr", image_channels(pixels))
    picture, remarks = read_input(tmp_path / "a.exr", None)
    assert picture.negative == pytest.approx(0.5 / (0.5 + 19 * 1.5))
    assert remarks["negative"] == "2% of the picture's radiance is negative and was set to 0"
    assert picture.image_srgb.min() == 0
    pixels[:2] = -0.5  # a normal map, or what else is no picture
    write_exr(tmp_path / "a.exr", image_channels(pixels))
    with pytest.raises(UnirenderError, match="50% of the radiance is negative"):
        read_picture(tmp_path / "a.exr")


def test_clipped_is_the_share_of_the_object_at_display_white(tmp_path: Path) -> None:
    rgba = np.full((2, 4, 4), 254, dtype=np.uint8)
    rgba[..., 3] = 255
    rgba[0, :2, 1] = 255  # one channel is enough
    rgba[1, :2] = (255, 255, 255, 0)  # not on the object
    Image.fromarray(rgba).save(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png").clipped == pytest.approx(2 / 6)
    Image.fromarray(rgba[..., :3]).save(tmp_path / "b.png")
    assert read_picture(tmp_path / "b.png").clipped == pytest.approx(4 / 8)
    rgba[..., :3] = 254
    Image.fromarray(rgba[..., :3]).save(tmp_path / "c.png")
    assert read_picture(tmp_path / "c.png").clipped == 0


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"\0\0\0\x18ftypheic", "a HEIC picture"),
        (b"\xff\x0a12345", "a JPEG XL picture"),
        (b"#?RADIANCE\n\n", "a Radiance file"),
        (b"\0\0\0\x20ftypisom", "a video, whose frames"),
        (b"\x1a\x45\xdf\xa3\1", "a video"),
        (b"RIFF\0\1\2\3AVI LIST", "a video"),
        (b"", "is empty"),
        (b"GIF", r"not a readable picture \("),
    ],
)
def test_what_a_file_is_that_cannot_be_read(data: bytes, told: str, tmp_path: Path) -> None:
    """Telephones name HEIC pictures .jpg."""
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(UnirenderError, match=rf"a\.jpg: {told}.*, expected PNG, JPG.*; save it as PNG \(linear"):
        read_picture(tmp_path / "a.jpg")


@pytest.mark.parametrize("suffix", ["qoi", "avif"])
def test_a_damaged_picture_of_a_rarer_format_is_told(suffix: str, tmp_path: Path) -> None:
    """Pillow raises an `IndexError` or a `RuntimeError` for these."""
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(RNG.integers(0, 256, (8, 8, 3), dtype=np.uint8)).save(path)
    for kept in (0.5, 0.9):
        path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
        header_pixels(path)  # says nothing
        with pytest.raises(UnirenderError, match=rf"a\.{suffix}: not a readable picture .*; save it as PNG"):
            read_picture(path)


def test_what_cannot_be_opened_is_told_in_words(tmp_path: Path) -> None:
    """A folder here; a file without permission fails likewise."""
    with pytest.raises(UnirenderError, match=r"not a readable picture \(.*, expected PNG, JPG"):
        open_picture(tmp_path)


def test_a_picture_bomb_is_refused(tmp_path: Path) -> None:
    side = int(MAX_PIXELS**0.5) + 10
    Image.new("1", (side, side)).save(tmp_path / "bomb.png")
    with pytest.raises(UnirenderError, match="scale it down"):
        read_picture(tmp_path / "bomb.png")


def test_so_many_pixels_that_pillow_does_not_open_them_are_told(tmp_path: Path) -> None:
    """20,000 squared, by the header alone."""
    Image.new("L", (1, 1)).save(tmp_path / "a.png")
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[16:24] = struct.pack(">2I", 20_000, 20_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(
        UnirenderError, match=r"a\.png: too many pixels \(.*400000000 .*at most 100,000,000; scale it down"
    ):
        read_picture(tmp_path / "a.png")


def test_a_picture_that_the_machine_is_too_small_for_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.new("RGB", (400, 300), "white").save(tmp_path / "a.png")
    needed = BYTES_OF_NONE + BYTES_A_PIXEL * 400 * 300
    monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda: needed)
    read_input(tmp_path / "a.png", None)
    source, out = InputOptions(tmp_path / "a.png"), OutputOptions(tmp_path / "out")
    with pytest.raises(UnirenderError, match=r"a picture of 0\.12 megapixels"):
        Relight(source, tmp_path / "a.hdr", out).run(np.asarray)
    with pytest.raises(UnirenderError, match=r"a picture of 0\.12 megapixels"):
        Decompose(source, out, decomposition=DecompositionOptions(tile=True)).run()
    with pytest.raises(UnirenderError, match=r"for it; scale it down first, or ask for fewer --samples"):
        read_input(tmp_path / "a.png", None, samples=2)
    monkeypatch.setattr("unirender.system.machine.unswapped_bytes", lambda: needed - 1)
    assert read_input(tmp_path / "a.png", None)[1]["memory"].endswith(
        "without swap: it may be very slow; scale it down"
    )
    monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda: needed - 1)
    with pytest.raises(
        UnirenderError, match=r"a picture of 0\.12 megapixels.* about 0\.5 GiB .* has 0\.4 GiB for it; scale"
    ):
        read_input(tmp_path / "a.png", None)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:100])  # told before it is decoded
    with pytest.raises(UnirenderError, match=r"a picture of 0\.12 megapixels"):
        read_input(tmp_path / "a.png", None)


def test_maps_that_the_machine_is_too_small_for_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_exr(tmp_path / "a.exr", {"roughness.Y": np.zeros((300, 400), np.float32)})
    needed = BYTES_OF_NONE + RENDERED_BYTES_A_PIXEL * 400 * 300
    render = Render(tmp_path / "a.exr", OutputOptions(tmp_path / "out"))
    monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda: needed)
    with pytest.raises(UnirenderError, match="normal"):  # read, and found wanting
        render.run(np.asarray)
    with pytest.raises(UnirenderError, match=r"a\.exr: a picture of 0\.12 megapixels, which would take about"):
        dataclasses.replace(render, environment=tmp_path / "light.exr").run(np.asarray)
    lit = tmp_path / "lit"  # from whose light s and d are derived
    lit.mkdir()
    (tmp_path / "a.exr").rename(lit / "intrinsics.exr")
    (lit / "environment.exr").touch()
    with pytest.raises(UnirenderError, match=r"lit: a picture of 0\.12 megapixels"):
        dataclasses.replace(render, maps=lit).run(np.asarray)


def test_mask_from_luminance_or_alpha(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 255]], dtype=np.uint8)).save(tmp_path / "m.png")
    np.testing.assert_allclose(read_mask(tmp_path / "m.png", (1, 2))[..., 0], [[0, 1]])
    Image.fromarray(np.array([[[9, 9, 9, 255], [9, 9, 9, 0]]], dtype=np.uint8)).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_mask(tmp_path / "a.png", (1, 2))[..., 0], [[1, 0]])
    Image.fromarray(np.array([[[255, 255, 255, 255], [0, 0, 51, 255]]], dtype=np.uint8)).save(tmp_path / "opaque.png")
    np.testing.assert_allclose(read_mask(tmp_path / "opaque.png", (1, 2))[..., 0], [[1, 17 / 255]], rtol=1e-6)


def ramp() -> tuple[np.ndarray, np.ndarray]:
    """16-bit grey, and the display values that it means."""
    values = np.linspace(0, 65535, 256).round().astype(np.uint16).reshape(16, 16)
    return values, (values / 65535).astype(np.float32)


def test_sixteen_bit_pil_pictures_and_masks_keep_their_values() -> None:
    values, expected = ramp()
    for grey in (Image.fromarray(values), Image.fromarray(values.astype(np.int32))):
        assert grey.mode in ("I;16", "I")
        picture, _ = as_picture(grey)
        mask = as_mask(grey, (16, 16))
        np.testing.assert_allclose(picture, expected[..., None].repeat(3, axis=-1), rtol=0, atol=1e-6)
        np.testing.assert_allclose(mask[..., 0], expected, rtol=0, atol=1e-6)
        saturated = np.asarray(grey.convert("L"), dtype=np.float32) / 255  # the twin: Pillow's own conversion
        assert np.abs(saturated - expected).max() > 0.4


def test_eight_bit_values_in_a_picture_of_more_bits_are_refused() -> None:
    values = np.arange(256, dtype=np.int32).reshape(16, 16)
    for grey in (Image.fromarray(values), Image.fromarray(values.astype(np.uint8)).convert("I")):
        assert grey.mode == "I"
        for read in (as_picture, lambda picture: as_mask(picture, (16, 16))):
            with pytest.raises(UnirenderError, match=r'mode I whose values end at 255 may .* convert it to mode "L"'):
                read(grey)
    assert not as_picture(Image.fromarray(0 * values))[0].any()  # black either way


def test_the_same_pixels_from_a_file_and_from_pil(tmp_path: Path) -> None:
    rgba = RNG.integers(0, 256, (9, 12, 4), dtype=np.uint8)
    rgba[0, 0, 3] = 255
    pictures = [Image.fromarray(rgba), Image.fromarray(rgba[..., :3]), Image.fromarray(ramp()[0])]
    pictures += [Image.fromarray(rgba[..., 0]), Image.fromarray(rgba[..., :3]).convert("P")]
    for image in pictures:
        image.save(tmp_path / "a.png")
        read, (values, mask) = read_picture(tmp_path / "a.png"), as_picture(image)
        np.testing.assert_array_equal(read.image_srgb, values)
        np.testing.assert_array_equal(1 if read.mask is None else read.mask, mask)
        np.testing.assert_array_equal(read_mask(tmp_path / "a.png", mask.shape[:2]), as_mask(image, mask.shape[:2]))


def test_grey_masks_are_exact() -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(as_mask(Image.fromarray(grey), (16, 16))[..., 0], grey.astype(np.float32) / 255)


@pytest.mark.parametrize("values", [np.full((8, 8), 0.5, np.float32), np.full((8, 8), 70000, np.int32)])
def test_values_without_a_display_white_are_refused(values: np.ndarray, tmp_path: Path) -> None:
    image = Image.fromarray(values)
    image.save(tmp_path / "a.tiff")
    for use in (lambda: as_picture(image), lambda: as_mask(image, (8, 8)), lambda: read_picture(tmp_path / "a.tiff")):
        with pytest.raises(UnirenderError, match="has no display values"):
            use()


@pytest.mark.parametrize(("premultiplied", "straight"), [("RGBa", "RGBA"), ("La", "LA")])
def test_premultiplied_modes_of_pil_keep_their_alpha(premultiplied: str, straight: str) -> None:
    pixels = np.full((8, 8, len(straight)), 200, np.uint8)
    pixels[..., -1] = 128
    image = Image.fromarray(pixels, straight)
    found = display_values(image.convert(premultiplied), "image")
    np.testing.assert_allclose(found, display_values(image, "image"), rtol=0, atol=2 / 255)
