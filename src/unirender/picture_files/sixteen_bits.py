"""Pictures of 16 bits a channel in colour, or of grey with alpha: in full.

Pillow has no mode for such pixels and drops their low bytes. Its decoder unpacks them a second time here, as if their
bytes were in the other order, and then keeps what it dropped before.
"""

import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import ExifTags, Image, ImageOps

OTHER_ORDER = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}  # N: this machine's own
UNPACKED = {"RGB": "RGB", "RGBX": "RGBX", "RGBA": "RGBA", "RGBa": "RGBA"}  # as Pillow names them -> bytes as they are
PLANAR_CONFIGURATION, SEPARATE = 284, 2  # tags and values of TIFF
COMPRESSION, UNCOMPRESSED = 259, 1
BITS_PER_SAMPLE = 258
PHOTOMETRIC, WHITE_IS_ZERO = 262, 0
SAMPLE_FORMAT, SIGNED = 339, 2
TURNED_BACK = {  # EXIF orientation -> what undoes its turn
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
GREY_AND_ALPHA = "LA"  # four bytes a pixel: the grey's, then the alpha's


def sixteen_bit_values(path: Path, *, upright: bool = False) -> Float[np.ndarray, "h w c"] | None:
    """Values in [0, 1], not premultiplied: three channels, or four where the picture has alpha or a transparent colour.

    Args:
        path: of a PNG, a TIFF or another picture that Pillow reads.
        upright: turn it as its EXIF orientation says.

    Returns:
        The values; None where Pillow itself keeps all bits of the pixels, or where they are CMYK or `planar`.

    Raises:
        OSError, ValueError or SyntaxError: the picture is broken, as Pillow says it.
    """
    with opened(path) as picture:
        name = "" if planar(picture) else has_sixteen_bits(picture)
        key = picture.info.get("transparency")
    pixels, _, order = (name or "").partition(";16")
    if pixels == GREY_AND_ALPHA:
        both = _bytes(path, "RGBA", upright)
        high, low = both[..., [0, 0, 0, 2]], both[..., [1, 1, 1, 3]]
    elif pixels in UNPACKED:
        high, low = (_bytes(path, f"{UNPACKED[pixels]};16{each}", upright) for each in (order, OTHER_ORDER[order]))
    else:
        return None
    values = (high.astype(np.float32) * 256 + low) / 65535.0
    if pixels == "RGBa":
        values[..., :3] = np.divide(values[..., :3], values[..., 3:], where=values[..., 3:] > 0, out=values[..., :3])
        return np.minimum(values, 1)
    if isinstance(key, tuple) and pixels == "RGB":
        opaque = (np.round(values * 65535) != key).any(axis=-1, keepdims=True)
        return np.concatenate([values, opaque.astype(np.float32)], axis=-1)
    return values


def has_sixteen_bits(picture: Image.Image) -> str:
    """How Pillow names pixels of which it would drop half of the bits; empty where it drops none.

    Args:
        picture: opened, and not decoded yet.
    """
    for tile in getattr(picture, "tile", ()):
        name = _name(tile.args)
        if ";16" in name and not picture.mode.startswith("I") and not name.startswith("BGR"):  # 16 bits a pixel
            return name
    return ""


def planar(picture: Image.Image) -> bool:
    """Whether it is a TIFF whose channels are stored one after the other: their low bytes are not to be had."""
    return getattr(picture, "tag_v2", {}).get(PLANAR_CONFIGURATION) == SEPARATE


def misread(picture: Image.Image) -> str:
    """Of what Pillow makes noise, or nothing: such a TIFF, uncompressed, of 16 bits. Empty where it reads the picture,
    as it does grey of 32 bits."""
    tags = getattr(picture, "tag_v2", {})
    deep = max(tags.get(BITS_PER_SAMPLE, (8,))) > 8 and picture.mode not in ("I", "F")
    if not (planar(picture) and tags.get(COMPRESSION) == UNCOMPRESSED and deep):
        return ""
    return "its channels are stored one after the other, uncompressed, with 16 bits, which cannot be read"


def white_is_zero(tags: Mapping[int, Any]) -> bool:
    """Whether the tags of a TIFF say that its greys count down from white."""
    return tags.get(PHOTOMETRIC) == WHITE_IS_ZERO


def unheeded_grey(picture: Image.Image) -> str:
    """What a TIFF of grey, signed or of more than 8 bits, says of its values and Pillow does not heed; empty where
    nothing is."""
    tags = getattr(picture, "tag_v2", {})
    if SIGNED in tags.get(SAMPLE_FORMAT, ()) and max(tags.get(BITS_PER_SAMPLE, (8,))) <= 16:
        return "its values are signed"
    if not picture.mode.startswith("I"):
        return ""
    if white_is_zero(tags):
        return "its 0 is white"
    return f"its grey has {bits} bits" if 8 < (bits := max(tags.get(BITS_PER_SAMPLE, (16,)))) < 16 else ""


def _bytes(path: Path, name: str, upright: bool) -> np.ndarray:
    """The pixels' bytes `[h w c]`, unpacked as Pillow does with pixels of that name."""
    with opened(path) as picture:
        picture.tile = [  # pyright: ignore[reportAttributeAccessIssue] - of a picture from a file
            tile._replace(args=name if isinstance(tile.args, str) else (name, *tile.args[1:])) for tile in picture.tile
        ]
        return np.asarray(ImageOps.exif_transpose(picture) if upright else as_stored(picture))


def opened(path: Path) -> Any:
    """A picture file, not decoded yet; of its size nothing is said.

    Pillow maps uncompressed pixels of a file whose name it knows into memory, and takes those of a TIFF that lies on
    its side for as wide as the turned picture is: of a TIFF it is told no name.
    """
    with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
        picture = Image.open(path)
    if hasattr(picture, "tag_v2"):
        picture.filename = ""
    return picture


def as_stored(picture: Image.Image) -> Image.Image:
    """A picture file, decoded, whose pixels lie as they are stored: Pillow turns a TIFF, and forgets its orientation.

    Args:
        picture: opened, and not decoded yet.
    """
    orientation = getattr(picture, "tag_v2", {}).get(ExifTags.Base.Orientation)
    picture.load()
    if orientation not in TURNED_BACK or ExifTags.Base.Orientation in getattr(picture, "tag_v2", {}):
        return picture
    return picture.transpose(TURNED_BACK[orientation])


def _name(arguments: Any) -> str:
    """A tile's name of its pixels: Pillow's decoders take it alone, or first of several arguments."""
    return str(arguments if isinstance(arguments, str) else arguments[0] if arguments else "")
