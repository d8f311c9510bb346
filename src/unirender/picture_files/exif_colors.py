"""What EXIF says of a picture's colours where no ICC profile does: cameras write Adobe RGB so.

By the rule of DCF, ColorSpace 65535 (not sRGB) with the interoperability index R03 is Adobe RGB (1998); some cameras
write ColorSpace 2. Of 65535 alone it is not known what the colours are.
"""

import struct
import warnings

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image

from unirender.blocks import by_rows
from unirender.color import image_srgb

ADOBE_RGB, NOT_SRGB = 2, 65535  # of EXIF's ColorSpace
ADOBE_RGB_INDEX = "R03"
ADOBE_RGB_GAMMA = np.float32(563 / 256)
ADOBE_RGB_TO_REC709 = np.array(  # one white, red and blue; green lies further out
    [[1.398356, -0.398356, 0], [0, 1, 0], [0, -0.042929, 1.042929]], dtype=np.float32
)
STATED = "exif_color_space"  # entry of the `info` of a TIFF, whose copies lose its tags
PNG_CHUNKS = ("srgb", "gamma", "chromaticity")  # of Pillow's `info`: they count more


def exif_color_space(image: Image.Image) -> int | None:
    """`ADOBE_RGB`; `NOT_SRGB` where it is another, which is not said; None for sRGB, where nothing is said, and of
    pictures of data or CMYK."""
    if image.info.get("icc_profile") or any(chunk in image.info for chunk in PNG_CHUNKS):
        return None
    if image.mode.startswith(("I", "F")) or image.mode in ("CMYK", "LAB"):
        return None
    if STATED in image.info:
        return image.info[STATED]
    try:
        with warnings.catch_warnings(action="ignore"):  # of what is damaged
            exif = image.getexif()
            ifd = exif.get_ifd(ExifTags.IFD.Exif)
            below = exif.get_ifd(ExifTags.IFD.Interop) if ExifTags.IFD.Interop in ifd else {}
    except (OSError, ValueError, SyntaxError, TypeError, struct.error):
        return None
    space, index = ifd.get(ExifTags.Base.ColorSpace), below.get(ExifTags.Interop.InteropIndex)
    if space == ADOBE_RGB or (space == NOT_SRGB and str(index).rstrip("\0") == ADOBE_RGB_INDEX):
        return ADOBE_RGB
    return NOT_SRGB if space == NOT_SRGB else None


def keep_color_space(tiff: Image.Image) -> None:
    """Has copies of an opened TIFF state what its EXIF does."""
    if (space := exif_color_space(tiff)) is not None:
        tiff.info[STATED] = space


def adobe_rgb_in_srgb(image: Image.Image) -> Image.Image:
    """A picture in Adobe RGB brought to sRGB, 8 bits a channel, RGB or RGBA; what sRGB has not is clipped."""
    mode = "RGBA" if image.has_transparency_data or image.mode in ("RGBa", "La") else "RGB"
    return Image.fromarray(by_rows(_in_srgb, np.asarray(image.convert(mode))))


def exif_remark(image: Image.Image) -> str | None:
    """What is due on a picture whose colours are not sRGB's by EXIF alone."""
    return {
        ADOBE_RGB: "the file has no ICC profile and its EXIF states Adobe RGB, from which it is converted",
        NOT_SRGB: "the file has no ICC profile and its EXIF states colours that are not sRGB's (ColorSpace 65535), its "
        "values are taken as sRGB: convert it",
    }.get(exif_color_space(image) or 0)


def _in_srgb(values: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    linear = (values[..., :3] / np.float32(255)) ** ADOBE_RGB_GAMMA @ ADOBE_RGB_TO_REC709.T
    return np.concatenate([np.round(255 * image_srgb(linear)).astype(np.uint8), values[..., 3:]], axis=-1)
