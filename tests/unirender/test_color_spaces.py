"""Files that state another colour space than ours: pictures by an ICC profile, EXRs by chromaticities."""

import io
import re
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from icc_profiles import ADOBE_RGB_D50, P3_D50, SRGB_D50, grey_profile, matrix_profile
from PIL import ExifTags, Image, ImageCms
from PIL.PngImagePlugin import PngInfo

from unirender.color import srgb_decode, srgb_encode
from unirender.errors import UnirenderError
from unirender.exr import read_exr
from unirender.picture_files.icc import in_srgb
from unirender.picture_files.primaries import REC709
from unirender.pictures import read_mask, read_picture
from unirender.pipelines.inputs import as_picture

RNG = np.random.default_rng(3)
PIXELS = RNG.integers(30, 200, (6, 9, 3), dtype=np.uint8)
ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
TO_REC709 = np.array(  # published, of AP0 with Bradford: the ACES project's AP0 to Rec.709 D65
    [[2.52169, -1.13413, -0.38756], [-0.27648, 1.37272, -0.09624], [-0.01538, -0.15298, 1.16835]]
)


def linear(primaries: np.ndarray, gamma: float) -> np.ndarray:
    """What `PIXELS` mean under a profile, in linear sRGB, by the definition of a matrix profile."""
    return (PIXELS / 255.0) ** gamma @ (np.linalg.inv(SRGB_D50) @ primaries).T


@pytest.mark.parametrize(("primaries", "gamma"), [(SRGB_D50, 1.0), (P3_D50, 2.2), (SRGB_D50, 1.8)])
def test_a_picture_of_another_profile_is_converted(tmp_path: Path, primaries: np.ndarray, gamma: float) -> None:
    Image.fromarray(PIXELS).save(tmp_path / "a.png", icc_profile=matrix_profile(primaries, gamma))
    expected = srgb_encode(np.clip(linear(primaries, gamma), 0, 1).astype(np.float32))
    seen = read_picture(tmp_path / "a.png").image_srgb
    np.testing.assert_allclose(seen, expected, rtol=0, atol=2 / 255)
    assert np.abs(seen - PIXELS / 255).max() > 0.02
    picture, _ = as_picture(Image.open(tmp_path / "a.png").resize((9, 8), Image.Resampling.NEAREST))
    np.testing.assert_array_equal(picture[0], seen[0])


def test_dark_grey_of_a_linear_profile_is_converted_exactly() -> None:
    """A colour engine that interpolates between few values makes 6 of what is 13."""
    grey = Image.fromarray(np.arange(256, dtype=np.uint8)[None])
    seen = np.asarray(in_srgb(_with_profile(grey, grey_profile(1.0)), "grey"))[0]
    expected = 255 * srgb_encode(np.linspace(0, 1, 256, dtype=np.float32))
    np.testing.assert_allclose(seen, np.repeat(expected[:, None], 3, axis=-1), rtol=0, atol=0.51)


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ((1, 13), None),  # sRGB
        ((1, 1), None),  # what video tools write
        ((12, 13), r"states Display P3 primaries and sRGB transfer \(cICP\), its values are taken as sRGB"),
        ((9, 16), "states Rec.2020 primaries and PQ transfer"),
    ],
)
def test_cicp_goes_before_all_other_chunks(tmp_path: Path, numbers: tuple[int, int], told: str | None) -> None:
    """By the specification of PNG; where it is not sRGB, a profile beside it is what can be converted."""
    more = PngInfo()
    more.add(b"cICP", bytes((*numbers, 0, 1)))
    more.add(b"gAMA", (100_000).to_bytes(4, "big"))
    Image.fromarray(PIXELS).save(tmp_path / "a.png", pnginfo=more)
    picture = read_picture(tmp_path / "a.png")
    np.testing.assert_allclose(picture.image_srgb, PIXELS / 255, rtol=0, atol=1e-6)
    assert list(picture.remarks.values()) == [] if told is None else re.search(told, picture.remarks["primaries"])
    Image.fromarray(PIXELS).save(tmp_path / "a.png", pnginfo=more, icc_profile=matrix_profile(P3_D50, 2.2))
    both = read_picture(tmp_path / "a.png")
    assert not both.remarks
    assert np.allclose(both.image_srgb, PIXELS / 255, rtol=0, atol=1e-6) == (told is None)


@pytest.mark.parametrize(("numbers", "told"), [((9, 16), "Rec.2020 primaries and PQ transfer"), ((1, 13), None)])
def test_an_avif_of_other_colours_is_told_unless_a_profile_counts(
    tmp_path: Path, numbers: tuple[int, int], told: str | None
) -> None:
    Image.fromarray(PIXELS).save(tmp_path / "a.avif")
    data = (tmp_path / "a.avif").read_bytes()
    place = data.index(b"colrnclx") + 8
    (tmp_path / "a.avif").write_bytes(data[:place] + struct.pack(">HH", *numbers) + data[place + 4 :])
    remarks = read_picture(tmp_path / "a.avif").remarks
    assert remarks == {} if told is None else told in remarks["primaries"]
    Image.fromarray(PIXELS).save(tmp_path / "b.avif", quality=100, icc_profile=matrix_profile(SRGB_D50, 1.0))
    picture = read_picture(tmp_path / "b.avif")
    assert not picture.remarks
    assert picture.image_srgb.mean() > PIXELS.mean() / 255 + 0.1


def exif(color_space: int, index: str, orientation: int = 1) -> bytes:
    """A camera's: an orientation, and in folders below it the colour space and the interoperability index."""

    def folder(*tags: tuple[int, int, int, bytes]) -> bytes:
        entries = b"".join(struct.pack("<HHI", *numbers) + value.ljust(4, b"\0") for *numbers, value in tags)
        return struct.pack("<H", len(tags)) + entries + bytes(4)

    first = folder((0x112, 3, 1, struct.pack("<H", orientation)), (0x8769, 4, 1, struct.pack("<I", 38)))
    second = folder((0xA001, 3, 1, struct.pack("<H", color_space)), (0xA005, 4, 1, struct.pack("<I", 68)))
    return b"Exif\0\0II*\0\x08\0\0\0" + first + second + folder((1, 2, 4, index.encode() + b"\0"))


ADOBE_RGB_TOLD = "its EXIF states Adobe RGB, from which it is converted"


@pytest.mark.parametrize(
    ("stated", "told"),
    [
        ((65535, "R03"), ADOBE_RGB_TOLD),
        ((2, "R98"), ADOBE_RGB_TOLD),
        ((65535, "R03", 3), ADOBE_RGB_TOLD),
        ((65535, "R98"), "its EXIF states colours that are not sRGB's .*taken as sRGB: convert it"),
        ((1, "R98"), None),
        ((1, "R03"), None),
    ],
)
def test_adobe_rgb_by_exif_alone_is_converted(tmp_path: Path, stated: tuple, told: str | None) -> None:
    """As the profile of Adobe RGB would be; a profile beside it counts more, and chunks of a PNG do."""
    image = Image.fromarray(PIXELS)
    image.save(tmp_path / "a.webp", lossless=True, exif=exif(*stated))
    picture = read_picture(tmp_path / "a.webp")
    expected = PIXELS / 255
    if told == ADOBE_RGB_TOLD:
        image.save(tmp_path / "b.png", icc_profile=matrix_profile(ADOBE_RGB_D50, 563 / 256))
        expected = read_picture(tmp_path / "b.png").image_srgb
        assert np.abs(expected - PIXELS / 255).max() > 0.1
    turned = expected[::-1, ::-1] if stated[2:] else expected
    np.testing.assert_allclose(picture.image_srgb, turned, rtol=0, atol=2 / 255)
    assert list(picture.remarks) == ([] if told is None else ["primaries"])
    assert told is None or re.search(told, picture.remarks["primaries"])
    chunk = PngInfo()
    chunk.add(b"sRGB", b"\0")
    image.save(tmp_path / "c.png", pnginfo=chunk, exif=exif(*stated[:2]))
    chunk = PngInfo()
    chunk.add(b"cICP", bytes((1, 13, 0, 1)))
    image.save(tmp_path / "d.png", pnginfo=chunk, exif=exif(*stated[:2]))
    image.save(tmp_path / "e.webp", lossless=True, exif=exif(*stated[:2]), icc_profile=matrix_profile(SRGB_D50, 1.0))
    for name in ("c.png", "d.png", "e.webp"):
        assert not read_picture(tmp_path / name).remarks
    np.testing.assert_array_equal(np.round(255 * read_picture(tmp_path / "d.png").image_srgb), PIXELS)


def test_adobe_rgb_by_the_exif_of_a_tiff_is_converted(tmp_path: Path) -> None:
    """Pillow's copies of a TIFF, which pictures are read from, have none of its tags."""
    image = Image.fromarray(PIXELS)
    image.save(tmp_path / "a.tif", tiffinfo={ExifTags.IFD.Exif: {ExifTags.Base.ColorSpace: 2}})
    image.save(tmp_path / "b.webp", lossless=True, exif=exif(2, "R98"))
    found, wanted = (read_picture(tmp_path / name) for name in ("a.tif", "b.webp"))
    np.testing.assert_array_equal(found.image_srgb, wanted.image_srgb)
    assert ADOBE_RGB_TOLD in found.remarks["primaries"]


def test_adobe_rgb_by_exif_keeps_its_alpha_and_a_damaged_exif_says_nothing(tmp_path: Path) -> None:
    rgba = np.dstack([PIXELS, np.full(PIXELS.shape[:2], 128, np.uint8)])
    rgba[0, 0, 3] = 255
    Image.fromarray(rgba).save(tmp_path / "a.webp", lossless=True, exif=exif(2, "R03"))
    picture, _ = as_picture(Image.open(tmp_path / "a.webp").resize((9, 8), Image.Resampling.NEAREST))
    seen = read_picture(tmp_path / "a.webp")
    np.testing.assert_array_equal(picture[0], seen.image_srgb[0])
    assert seen.mask is not None
    np.testing.assert_array_equal(np.round(255 * seen.mask[..., 0]), rgba[..., 3])
    Image.fromarray(PIXELS).save(tmp_path / "b.webp", lossless=True, exif=exif(65535, "R03")[:50])
    assert not read_picture(tmp_path / "b.webp").remarks


def test_cmyk_without_a_profile_is_told(tmp_path: Path) -> None:
    Image.fromarray(PIXELS).convert("CMYK").save(tmp_path / "a.jpg", quality=100)
    picture = read_picture(tmp_path / "a.jpg")
    np.testing.assert_allclose(picture.image_srgb, PIXELS / 255, rtol=0, atol=0.05)
    assert "CMYK without a profile, of which sRGB is a guess" in picture.remarks["primaries"]


@pytest.mark.parametrize("profile", [None, ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()])
def test_a_picture_in_srgb_keeps_its_values(tmp_path: Path, profile: bytes | None) -> None:
    Image.fromarray(PIXELS).save(tmp_path / "a.png", icc_profile=profile)
    np.testing.assert_array_equal(np.round(read_picture(tmp_path / "a.png").image_srgb * 255), PIXELS)


@pytest.mark.parametrize(
    ("chunks", "told"),
    [
        ({b"gAMA": 100_000}, "gamma of 1 .*if they are linear, save the picture as EXR"),
        ({b"gAMA": 55_556}, r"gamma of 0\.556 \(gAMA; sRGB: 0\.455\), its values are taken as sRGB$"),
        ({b"gAMA": 45_455}, None),
        ({b"gAMA": 100_000, b"sRGB": 0}, None),  # which counts more
    ],
)
def test_a_png_of_another_gamma_is_told(tmp_path: Path, chunks: dict[bytes, int], told: str | None) -> None:
    more = PngInfo()
    for name, value in chunks.items():
        more.add(name, value.to_bytes(4 if name == b"gAMA" else 1, "big"))
    Image.fromarray(PIXELS).save(tmp_path / "a.png", pnginfo=more)
    picture = read_picture(tmp_path / "a.png")
    np.testing.assert_allclose(picture.image_srgb, PIXELS / 255, rtol=0, atol=1e-6)
    assert told is None or re.search(told, picture.remarks["gamma"])
    assert ("gamma" in picture.remarks) == (told is not None)


@pytest.mark.parametrize(
    ("green", "more", "told"),
    [
        ((0.30, 0.60), {}, False),
        ((0.3001, 0.60), {}, False),
        ((0.21, 0.71), {}, True),  # Adobe RGB's; its red and blue are ours
        ((0.21, 0.71), {b"sRGB": b"\0"}, False),
    ],
)
def test_a_png_of_other_primaries_is_told(
    tmp_path: Path, green: tuple[float, float], more: dict[bytes, bytes], told: bool
) -> None:
    chunks = PngInfo()
    points = (0.3127, 0.329, 0.64, 0.33, *green, 0.15, 0.06)
    chunks.add(b"cHRM", struct.pack(">8I", *(round(100_000 * x) for x in points)))
    for name, value in more.items():
        chunks.add(name, value)
    Image.fromarray(PIXELS).save(tmp_path / "a.png", pnginfo=chunks)
    picture = read_picture(tmp_path / "a.png")
    np.testing.assert_allclose(picture.image_srgb, PIXELS / 255, rtol=0, atol=1e-6)
    assert ("green at 0.21, 0.71; sRGB: 0.3, 0.6" in picture.remarks.get("primaries", "")) == told
    assert ("primaries" in picture.remarks) == told
    Image.fromarray(PIXELS[..., 0]).save(tmp_path / "a.png", pnginfo=chunks)
    assert "primaries" not in read_picture(tmp_path / "a.png").remarks, "grey has none"


def test_alpha_and_palettes_go_through_a_profile(tmp_path: Path) -> None:
    alpha = RNG.integers(0, 256, PIXELS.shape[:2], dtype=np.uint8)
    alpha[0, 0] = 255
    profile = matrix_profile(SRGB_D50, 1.0)
    Image.fromarray(PIXELS).save(tmp_path / "rgb.png", icc_profile=profile)
    Image.fromarray(np.dstack([PIXELS, alpha])).save(tmp_path / "rgba.png", icc_profile=profile)
    few = Image.fromarray(PIXELS).convert("P")
    few.save(tmp_path / "palette.png", icc_profile=profile)
    few.convert("RGB").save(tmp_path / "same.png", icc_profile=profile)
    opaque, seen = (read_picture(tmp_path / f"{name}.png") for name in ("rgb", "rgba"))
    assert seen.mask is not None
    np.testing.assert_array_equal(np.round(seen.mask[..., 0] * 255), alpha)
    np.testing.assert_array_equal(seen.image_srgb, opaque.image_srgb)
    palette, same = (read_picture(tmp_path / f"{name}.png") for name in ("palette", "same"))
    np.testing.assert_array_equal(palette.image_srgb, same.image_srgb)


@pytest.mark.parametrize(("premultiplied", "straight"), [("La", "LA"), ("RGBa", "RGBA")])
def test_premultiplied_pictures_go_through_a_profile(premultiplied: str, straight: str) -> None:
    image = Image.fromarray(np.dstack([PIXELS, np.full(PIXELS.shape[:2], 255, np.uint8)])).convert(straight)
    both = [_with_profile(image.convert(mode), matrix_profile(SRGB_D50, 1.0)) for mode in (premultiplied, straight)]
    one, other = (np.asarray(in_srgb(shown, "a picture")) for shown in both)
    np.testing.assert_array_equal(one, other)


def _with_profile(image: Image.Image, profile: bytes) -> Image.Image:
    image.info["icc_profile"] = profile
    return image


def test_a_mask_has_no_colour_space(tmp_path: Path) -> None:
    """Coverage 0.5 is 0.5 in a file with whatever profile."""
    grey = np.full((4, 4, 3), 128, np.uint8)
    grey[0] = 255
    Image.fromarray(grey).save(tmp_path / "a.png", icc_profile=matrix_profile(SRGB_D50, 1.0))
    assert read_mask(tmp_path / "a.png", (4, 4))[1, 1, 0] == pytest.approx(128 / 255)


@pytest.mark.parametrize("profile", [b"no profile", matrix_profile(SRGB_D50, 1.0)[:200]])
def test_a_damaged_profile_is_refused(profile: bytes, tmp_path: Path) -> None:
    image = Image.fromarray(PIXELS)
    image.info["icc_profile"] = profile
    with pytest.raises(UnirenderError, match=r"a picture: its ICC profile cannot be used .* convert it"):
        in_srgb(image, "a picture")


def test_grey_with_a_profile_of_colours(tmp_path: Path) -> None:
    """As programs leave it that take the colours out of a picture: it means what three equal channels mean."""
    grey, profile = Image.fromarray(PIXELS[..., 0]), matrix_profile(SRGB_D50, 1.0)
    grey.save(tmp_path / "grey.png", icc_profile=profile)
    grey.convert("RGB").save(tmp_path / "rgb.png", icc_profile=profile)
    one, three = (read_picture(tmp_path / f"{name}.png").image_srgb for name in ("grey", "rgb"))
    np.testing.assert_array_equal(one, three)
    assert np.abs(one[..., 0] - PIXELS[..., 0] / 255).max() > 0.1


def test_grey_with_a_profile_of_grey(tmp_path: Path) -> None:
    Image.fromarray(PIXELS[..., 0]).save(tmp_path / "grey.png", icc_profile=grey_profile(1.0))
    expected = srgb_encode((PIXELS[..., 0] / 255.0).astype(np.float32))
    seen = read_picture(tmp_path / "grey.png").image_srgb
    np.testing.assert_allclose(seen, np.repeat(expected[..., None], 3, axis=-1), rtol=0, atol=2 / 255)


def test_a_profile_of_grey_in_a_colour_picture_is_refused() -> None:
    image = Image.fromarray(PIXELS)
    image.info["icc_profile"] = grey_profile()
    with pytest.raises(UnirenderError, match="its ICC profile cannot be used"):
        in_srgb(image, "a picture")


def test_a_lab_picture_is_refused(tmp_path: Path) -> None:
    """Its second band is named A, and is no alpha."""
    Image.merge("LAB", Image.fromarray(PIXELS).split()).save(tmp_path / "lab.tif")
    with pytest.raises(UnirenderError, match="a picture of mode LAB, expected RGB, grey or CMYK"):
        read_picture(tmp_path / "lab.tif")


def write(path: Path, channels: dict[str, np.ndarray], chromaticities: tuple[float, ...] | None) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stated = {} if chromaticities is None else {"chromaticities": chromaticities}
    OpenEXR.File(
        header | stated, {name: np.ascontiguousarray(value, np.float32) for name, value in channels.items()}
    ).write(str(path))


def test_an_exr_of_other_primaries_is_converted(tmp_path: Path) -> None:
    rgb = RNG.uniform(0.2, 0.8, (5, 4, 3)).astype(np.float32)
    image = dict(zip("RGB", np.moveaxis(rgb, -1, 0), strict=True))
    maps = {f"albedo.{name}": value for name, value in image.items()}
    data = {f"normal.{axis}": value for axis, value in zip("XYZ", image.values(), strict=True)} | {"A": np.ones((5, 4))}
    write(tmp_path / "a.exr", image | maps | data, ACES_AP0)
    seen, _ = read_exr(tmp_path / "a.exr")
    expected = rgb @ TO_REC709.T
    for prefix in ("", "albedo."):
        found = np.stack([seen[f"{prefix}{name}"] for name in "RGB"], axis=-1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)
    for name, value in data.items():
        np.testing.assert_array_equal(seen[name], np.float32(value))
    grey = {name: np.full((4, 4), 0.5) for name in "RGB"}
    write(tmp_path / "white.exr", grey, ACES_AP0)
    np.testing.assert_allclose(srgb_decode(read_picture(tmp_path / "white.exr").image_srgb), 0.5, atol=1e-4)


@pytest.mark.parametrize("chromaticities", [None, REC709, (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.31271, 0.32902)])
def test_an_exr_in_rec709_keeps_its_values(tmp_path: Path, chromaticities: tuple[float, ...] | None) -> None:
    image = {name: RNG.uniform(0, 1, (3, 3)).astype(np.float32) for name in "RGB"}
    write(tmp_path / "a.exr", image, chromaticities)
    seen, _ = read_exr(tmp_path / "a.exr")
    for name, value in image.items():
        np.testing.assert_array_equal(seen[name], value)


@pytest.mark.parametrize("chromaticities", [(0.3, 0.3) * 4, (0.0,) * 8, (*REC709[:6], 0.0, 0.0)])
def test_chromaticities_of_no_space_are_refused(tmp_path: Path, chromaticities: tuple[float, ...]) -> None:
    write(tmp_path / "a.exr", {name: np.ones((3, 3)) for name in "RGB"}, chromaticities)
    with pytest.raises(UnirenderError, match="are those of no colour space, expected x, y of red, green, blue"):
        read_exr(tmp_path / "a.exr")


def every_pixel(kind: type, step: int = 1) -> dict[str, OpenEXR.Channel]:
    values = np.ones((6, 8), kind)  # of which every `step`-th row is written
    return {name: OpenEXR.Channel(name, values, step, step) for name in "RGB"}


def several_samples() -> dict[str, np.ndarray]:
    values = np.empty((6, 8), object)
    values[:] = [[np.ones(2, np.float32) for _ in range(8)] for _ in range(6)]
    return dict.fromkeys("RGBAZ", values)


DEEP = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
REFUSED = {
    "deep": (several_samples(), DEEP, "got a deep file .* flatten it"),
    "subsampled": (every_pixel(np.float32, 2), {}, "got one value of . for 2 x 2 pixels, .* without subsampling"),
    "whole numbers": (every_pixel(np.uint32), {}, "got whole numbers in ., expected radiance in half or float"),
    "wide pixels": (every_pixel(np.float32), {"pixelAspectRatio": 2.0}, "got pixels 2 times as wide as high"),
    "ACEScg": (every_pixel(np.float32), {"colorInteropID": "lin_ap1_scene"}, "got colours of 'lin_ap1_scene'"),
    "encoded": (
        every_pixel(np.float32),
        {"colorInteropID": "srgb_rec709_scene", "chromaticities": REC709},
        "got colours of 'srgb_rec709_scene' .*convert it",
    ),
    "a layer": ({"beauty.R": np.ones((6, 8), np.float32)}, {}, "expected a picture with R, G, B .*; rename"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_an_exr_that_is_no_picture_of_radiance_is_refused(tmp_path: Path, what: str) -> None:
    """Whole numbers were radiance without a word, of subsampled colours the picture was smaller than it is."""
    channels, header, message = REFUSED[what]
    plain = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(plain | header, channels).write(str(tmp_path / "a.exr"))
    with pytest.raises(UnirenderError, match=f"a.exr: .*{message}"):
        read_picture(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "header",
    [
        {"colorInteropID": "lin_rec709_scene"},
        {"colorInteropID": ""},
        {"colorInteropID": "lin_ap0_scene", "chromaticities": ACES_AP0},
        {"pixelAspectRatio": 0.999},
        {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()},
    ],
)
def test_an_exr_that_states_what_is_so_is_read(tmp_path: Path, header: dict[str, object]) -> None:
    plain = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    number = {"id": np.ones((6, 8), np.uint32)}  # of an object, beside the picture
    OpenEXR.File(plain | header, every_pixel(np.float32) | number).write(str(tmp_path / "a.exr"))
    np.testing.assert_allclose(read_picture(tmp_path / "a.exr").image_srgb, 1, rtol=0, atol=1e-4)


@pytest.mark.parametrize("names", [("R", "G", "B"), ("R", "G", "B", "A"), ("mask.Y",), ("Y",), ("A",)])
def test_a_mask_in_an_exr_is_coverage_as_it_is(tmp_path: Path, names: tuple[str, ...]) -> None:
    """No transfer curve: half covered is 0.5. An alpha of 1 everywhere says nothing where there are colours."""
    mask = np.ones((4, 4), np.float32)
    mask[:, 0], mask[:, 1] = 0.5, 0.25
    only_alpha = names == ("A",)
    channels = {name: np.ones((4, 4)) if name == "A" and not only_alpha else mask for name in names}
    write(tmp_path / "m.exr", channels, None)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.exr", (4, 4))[..., 0], mask)
    buffer = io.BytesIO()
    Image.fromarray((mask * 255).astype(np.uint8)).save(buffer, "PNG")
    (tmp_path / "m.png").write_bytes(buffer.getvalue())
    np.testing.assert_allclose(read_mask(tmp_path / "m.png", (4, 4))[..., 0], mask, atol=1 / 255)


def test_an_exr_without_a_mask_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "m.exr", {"depth.Z": np.ones((4, 4))}, None)
    with pytest.raises(UnirenderError, match=r"has the channels depth.Z, expected a mask: A, mask.Y, Y, or R, G and B"):
        read_mask(tmp_path / "m.exr", (4, 4))
