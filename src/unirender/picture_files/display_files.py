"""Picture files of Pillow's and PIL pictures as display values in [0, 1]: colours in sRGB, data as it is stored."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import ExifTags, Image, ImageOps

from unirender.errors import UnirenderError
from unirender.picture_files.cicp import Cicp, read_cicp
from unirender.picture_files.exif_colors import exif_remark, keep_color_space
from unirender.picture_files.icc import in_srgb
from unirender.picture_files.primaries import REC709, SAME_PRIMARIES
from unirender.picture_files.sixteen_bits import (
    as_stored,
    has_sixteen_bits,
    misread,
    opened,
    sixteen_bit_values,
    unheeded_grey,
)

FORMATS = "PNG, JPG, TIFF, WebP, BMP or EXR"
RAW_SUFFIXES = (".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2")  # Pillow may read the thumbnail inside
OTHER_FORMATS = {  # and how their files begin
    "a HEIC picture": rb".{4}ftyp(hei|hev|mif1|msf1)",
    "a JPEG XL picture": rb"\xff\x0a|\x00\x00\x00\x0cJXL ",
    "an OpenEXR file under another name": rb"\x76\x2f\x31\x01",
    "a Radiance file": rb"#\?",
    "a video, whose frames a folder is to hold as pictures": (
        rb".{4}ftyp(3gp|avc1|dash|iso|M4V|mp4|MSNV|qt)|\x1a\x45\xdf\xa3|RIFF.{4}AVI "
    ),
    "a PDF": rb"%PDF",
    "an SVG or another text": rb"\s*<",
}
FIRST_BYTES = 12
MAX_PIXELS = 100_000_000
DISPLAY_MAX_8_BIT, DISPLAY_MAX_16_BIT = 255, 65535  # display white of grey
SRGB_GAMMA, SAME_GAMMA = 1 / 2.2, 0.05  # of the gAMA chunk of a PNG, and how far others may be from it
GREY_STEPS = {"L;2": 255 // 3, "L;4": 255 // 15}  # grey of 2 and 4 bits as Pillow names it: a step in 8 bits
GREYS = ("1", "L", "I")  # first bands of modes without colour; of a palette it is P
PNG_POINTS, PNG_SRGB = ("white", "red", "green", "blue"), (*REC709[6:], *REC709[:6])  # of the cHRM chunk
CMYK = "its colours are CMYK without a profile, of which sRGB is a guess: save it in sRGB where it was made"
SIXTEEN_BITS = "its colours have 16 bits, of which 8 are read: save it as PNG in sRGB to keep them"


def open_picture(path: str | Path, *, upright: bool = True) -> Image.Image:
    """A picture file in a format of Pillow's, decoded and, if `upright`, turned as its EXIF orientation says.

    Raises:
        UnirenderError: no readable picture, a camera's raw file, one of more than `MAX_PIXELS`, or grey that Pillow
            hands out otherwise than it is meant.
    """
    if Path(path).suffix.lower() in RAW_SUFFIXES:
        raise UnirenderError(f"{path}: a camera's raw file, expected {FORMATS}; develop it first")
    try:
        with opened(Path(path)) as file:
            width, height = file.size
            if width * height > MAX_PIXELS:
                raise UnirenderError(
                    f"{path}: {width} x {height} pixels, expected at most {MAX_PIXELS:,}; scale it down first"
                )
            if what := misread(file):
                raise UnirenderError(f"{path}: {what}; save it as PNG, or with interleaved channels")
            _check_grey(file, str(path))
            _scale_transparent_grey(file)
            if file.format == "TIFF":
                keep_color_space(file)
            if not upright:
                return as_stored(file).copy()
            file.load()
            return ImageOps.exif_transpose(file)
    except (UnirenderError, MemoryError):
        raise
    except Image.DecompressionBombError as error:  # so many that Pillow does not open it; its message says how many
        raise UnirenderError(
            f"{path}: too many pixels ({error}), expected at most {MAX_PIXELS:,}; scale it down first"
        ) from error
    except Exception as error:  # Pillow's formats raise half a dozen kinds for what is broken
        raise UnirenderError(
            f"{path}: {_unreadable(Path(path), error)}, expected {FORMATS}; save it as PNG (linear radiance as EXR)"
        ) from error


def pixel_count(path: Path) -> int:
    """By the header of a file of Pillow's; 0 where it has none that can be read, or names more than `MAX_PIXELS`."""
    try:
        with opened(path) as file:
            pixels = file.width * file.height
    except Exception:  # half a dozen kinds, told where it is read
        return 0
    return pixels if pixels <= MAX_PIXELS else 0


def _unreadable(path: Path, error: Exception) -> str:
    """What a file is that Pillow did not read, where its first bytes tell, else what Pillow says."""
    try:
        with path.open("rb") as file:
            start = file.read(FIRST_BYTES)
    except OSError:  # a folder, or no permission: Pillow's sentence says so
        return f"not a readable picture ({error})"
    told = (what for what, sign in OTHER_FORMATS.items() if re.match(sign, start, re.DOTALL))
    return next(told, "is empty" if not start else f"not a readable picture ({error})")


def _check_grey(image: Image.Image, name: str) -> None:
    if what := unheeded_grey(image):
        raise UnirenderError(f"{name}: a TIFF, {what}, expected 8 or 16 bits and 0 for black; save it as PNG")


def _scale_transparent_grey(file: Image.Image) -> None:
    """A PNG's transparent grey in the 8 bits of the decoded pixels: Pillow leaves that of 2 or 4 bits as it is."""
    step = next((GREY_STEPS.get(str(tile.args), 1) for tile in getattr(file, "tile", ())), 1)
    if step > 1 and isinstance(key := file.info.get("transparency"), int):
        file.info["transparency"] = key * step


def stored_values(path: str | Path, *, upright: bool = True) -> Float[np.ndarray, "h w c"]:
    """Display values in [0, 1] of a file of Pillow's, of data and not of colours: RGB, or RGBA, with all their bits.

    Args:
        path: of the file.
        upright: turn it as its EXIF orientation says.

    Raises:
        UnirenderError: as `open_picture` and `display_values`.
    """
    image = open_picture(path, upright=upright)
    full = sixteen_bit_values(Path(path), upright=upright)
    return display_values(image, str(path)) if full is None else full


def srgb_values(path: str | Path, name: str | None = None) -> Float[np.ndarray, "h w c"]:
    """The same of a file of colours: in sRGB, whatever its ICC profile says; what is converted keeps 8 bits of 16.

    Args:
        path: of the file.
        name: what to call it in messages; None: the path.

    Raises:
        UnirenderError: as `stored_values`, or for its ICC profile (`picture_files.icc`).
    """
    return srgb_values_and_remarks(Path(path), name or str(path))[0]


def srgb_values_and_remarks(
    path: Path, name: str, *, upright: bool = True
) -> tuple[Float[np.ndarray, "h w c"], dict[str, str]]:
    """The same, and remarks by kind on what was lost in reading it; `upright` as of `stored_values`."""
    image = open_picture(path, upright=upright)
    coded = read_cicp(path)
    if coded is not None:  # it counts more
        image.info.pop("exif", None)
        if coded.is_srgb:
            image.info.pop("icc_profile", None)
    srgb = in_srgb(image, name)
    remarks = _png_remarks(image, coded)
    if image.mode == "CMYK" and not image.info.get("icc_profile"):
        remarks["primaries"] = CMYK
    if said := exif_remark(image):
        remarks["primaries"] = said
    full = sixteen_bit_values(path, upright=upright) if srgb is image else None
    if full is not None:
        return full, remarks
    with opened(path) as file:
        cut = has_sixteen_bits(file)
    return display_values(srgb, name), remarks | ({"depth": SIXTEEN_BITS} if cut else {})


def _png_remarks(image: Image.Image, coded: Cicp | None) -> dict[str, str]:
    """What is due on a PNG or an AVIF that states other colours than sRGB's and has no ICC profile, by which it is
    converted; of gamma and primaries where nothing counts more (`unirender.picture_files.cicp`)."""
    if image.info.get("icc_profile"):
        return {}
    if coded is not None:
        said = f"the file states {coded}, its values are taken as sRGB: convert it"
        return {} if coded.is_srgb else {"primaries": said}
    if "srgb" in image.info:
        return {}
    remarks, gamma = {}, image.info.get("gamma")
    if gamma is not None and abs(gamma - SRGB_GAMMA) > SAME_GAMMA:
        said = f"the file states a gamma of {gamma:.3g} (gAMA; sRGB: {SRGB_GAMMA:.3g}), its values are taken as sRGB"
        remarks["gamma"] = f"{said}: if they are linear, save the picture as EXR" if gamma > 0.9 else said
    points = PNG_SRGB if image.getbands()[0] in GREYS else image.info.get("chromaticity", PNG_SRGB)
    stated, ours = (np.reshape(each, (4, 2)) for each in (points, PNG_SRGB))
    farthest = int(np.abs(stated - ours).max(axis=1).argmax())
    if np.abs(stated - ours).max() > SAME_PRIMARIES:
        (x, y), (our_x, our_y) = stated[farthest], ours[farthest]
        where = f"{PNG_POINTS[farthest]} at {x:.3g}, {y:.3g}; sRGB: {our_x:.3g}, {our_y:.3g}"
        remarks["primaries"] = (
            f"the file states other primaries than sRGB's (cHRM: {where}), its colours are taken as sRGB: convert it"
        )
    return remarks


def display_values(image: Image.Image, name: str) -> Float[np.ndarray, "h w c"]:
    """The pixels of a PIL picture of any mode as display values in [0, 1], not premultiplied: RGB, or RGBA where the
    picture has an alpha channel or a transparent colour. 16-bit grey keeps its 16 bits (Pillow's own conversion
    saturates it).

    Args:
        image: the picture; its EXIF orientation is not looked at.
        name: what to call it in messages.

    Raises:
        UnirenderError: a floating-point or 32-bit picture, whose values have no display white or may have either; one
            of L*a*b*; or a TIFF of grey that Pillow hands out otherwise than it is meant.
    """
    _check_grey(image, name)
    if image.mode.startswith("I;16") or image.mode in ("I", "F"):
        values = np.asarray(image, dtype=np.float32)
        if image.mode == "I" and 0 < values.max(initial=0) <= DISPLAY_MAX_8_BIT:
            raise UnirenderError(
                f"{name}: a picture of mode I whose values end at {values.max():g} may be 8-bit or very dark 16-bit "
                'grey; convert it to mode "L", or to "I;16" if display white is 65535'
            )
        if image.mode == "F" or values.min(initial=0) < 0 or values.max(initial=0) > DISPLAY_MAX_16_BIT:
            raise UnirenderError(
                f"{name}: a picture of mode {image.mode} has no display values, expected 8 bits a channel or 16-bit "
                "grey; save linear radiance as EXR"
            )
        grey = np.repeat(values[..., None] / np.float32(DISPLAY_MAX_16_BIT), 3, axis=-1)
        key = image.info.get("transparency")  # one value of the pixels, in a PNG
        return grey if key is None else np.concatenate([grey, (values != key)[..., None].astype(np.float32)], axis=-1)
    if image.mode == "LAB":
        raise UnirenderError(f"{name}: a picture of mode {image.mode}, expected RGB, grey or CMYK; convert it to sRGB")
    if image.mode in ("RGBa", "La"):  # premultiplied
        image = image.convert("RGBA" if image.mode == "RGBa" else "LA")
    mode = "RGBA" if image.has_transparency_data else "RGB"
    return np.asarray(image.convert(mode), dtype=np.float32) / 255


def display_colors(image: Image.Image, name: str) -> Float[np.ndarray, "h w c"]:
    """The same of a picture of colours and not of data: in sRGB, whatever its ICC profile says (`icc`)."""
    return display_values(in_srgb(image, name), name)


def is_turned(picture: Path | Image.Image) -> bool:
    """Whether a file or a PIL picture has an EXIF orientation that is not that of its pixels; a damaged one is none."""
    try:
        if isinstance(picture, Path):
            with opened(picture) as file:
                return is_turned(file)
        return picture.getexif().get(ExifTags.Base.Orientation, 1) in range(2, 9)
    except Exception:  # half a dozen kinds, told where it is read
        return False


def picture_count(path: Path) -> int:
    """How many pictures a file of Pillow's holds: of an animation, pages, or what its format has."""
    try:
        with opened(path) as file:
            return getattr(file, "n_frames", 1)
    except Exception:  # half a dozen kinds, of what is broken behind the first picture
        return 1
