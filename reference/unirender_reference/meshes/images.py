"""Pictures of a model: refused by their header when too large, reduced in linear light while they are decoded."""

import io
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError

from unirender.color import eight_bits
from unirender.errors import UnirenderError
from unirender.picture_files.sixteen_bits import (
    BITS_PER_SAMPLE,
    SAMPLE_FORMAT,
    SIGNED,
    as_stored,
    misread,
    white_is_zero,
)
from unirender_reference.meshes.limits import MAX_IMAGE_PIXELS, MAX_IMAGE_SIDE, MAX_MODEL_PIXELS

# No format whose reader starts another program (EPS) or draws (WMF, SVG).
FORMATS = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "TGA", "TIFF", "GIF", "DDS")
_LIMIT = f"expected at most {MAX_IMAGE_PIXELS:,} (8,192 x 8,192); reduce it"
STRIP = 500_000  # stored pixels made float at a time
SLACK = 1e-3  # by which floats may miss [0, 1]: rounding, resampling
Decode = Callable[[Float[np.ndarray, "h w c"]], Float[np.ndarray, "h w k"]]


class ImageBudget:
    """Opens the images of one model and counts their pixels."""

    def __init__(self) -> None:
        self._pixels = 0

    def open(self, data: bytes, name: str) -> Image.Image:
        """An image whose header has been read and whose pixels have not.

        Raises:
            UnirenderError: no image in a format we read, or one of too many pixels, alone or with the others.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit below is lower
            try:
                image = Image.open(io.BytesIO(data), formats=FORMATS)
            except Image.DecompressionBombError as error:  # its message holds the number of pixels
                count = float((re.findall(r"\d+", str(error)) or ["inf"])[0])
                raise UnirenderError(f"texture {name}: {count:,.0f} pixels, {_LIMIT}") from error
            except UnidentifiedImageError as error:
                raise UnirenderError(
                    f"texture {name}: no image that can be read, expected one of {', '.join(FORMATS)}; export it as PNG"
                ) from error
            except Exception as error:  # Pillow's readers raise whatever a broken header makes them raise
                raise UnirenderError(
                    f"texture {name}: no image that can be read ({error}); export it as PNG"
                ) from error
        pixels = image.width * image.height
        self._pixels += pixels
        if pixels > MAX_IMAGE_PIXELS:
            raise UnirenderError(f"texture {name}: {image.width:,} x {image.height:,} pixels, {_LIMIT}")
        if max(image.size) > MAX_IMAGE_SIDE:
            raise UnirenderError(
                f"texture {name}: {image.width:,} x {image.height:,} pixels, expected sides of at most "
                f"{MAX_IMAGE_SIDE:,}; reduce it"
            )
        if self._pixels > MAX_MODEL_PIXELS:
            raise UnirenderError(
                f"texture {name}: brings the textures to {self._pixels / 1e6:.0f} megapixels, expected at most "
                f"{MAX_MODEL_PIXELS / 1e6:.0f}; reduce them"
            )
        return image


def texels_of(image: Image.Image, name: str, side: int, mode: str, curve: Decode) -> Float[np.ndarray, "i j k"]:
    """Decodes an image and reduces what it means (light, vectors, roughness) to at most `side` on a side.

    The means are taken after `curve`, strip by strip: whatever the image's size, the float texels under way stay few.

    Args:
        image: from `ImageBudget.open`.
        name: for messages.
        side: pixels.
        mode: Pillow's mode: "RGB" or "RGBA".
        curve: stored values in [0, 1] -> linear ones, each channel by itself.

    Raises:
        UnirenderError: the image is cut off or damaged, a TIFF that Pillow makes noise of, or its numbers are no
            brightness (negative, floats above 1).
    """
    if what := misread(image):
        raise UnirenderError(f"texture {name}: {what}; export it as PNG")
    try:
        tags = getattr(image, "tag_v2", {})  # of a TIFF
        image = _eight_bits(as_stored(image), tags, name)
        image = image if image.mode == mode else image.convert(mode)
    except (MemoryError, UnirenderError):
        raise
    except Exception as error:  # Pillow's readers raise whatever a damaged file makes them raise
        raise UnirenderError(f"texture {name}: damaged ({error}); export it again") from error
    levels = np.repeat(np.arange(256, dtype=np.float32)[:, None] / 255, len(image.getbands()), axis=1)
    table = np.ascontiguousarray(curve(levels[None])[0], np.float32)  # (256, c)
    scale = min(1.0, side / max(image.size))
    width, height = (max(1, round(n * scale)) for n in image.size)
    texels = np.empty((height, width, table.shape[1]), np.float32)
    strip = max(1, STRIP * height // (image.width * image.height))  # rows of the result at a time
    for top in range(0, height, strip):
        stop = min(top + strip, height)
        low, high = top * image.height / height, stop * image.height / height
        first, last = int(low), min(int(np.ceil(high)), image.height)
        stored = np.asarray(image.crop((0, first, image.width, last)))
        linear = np.stack([table[:, k][stored[..., k]] for k in range(table.shape[1])], axis=-1)
        texels[top:stop] = area_means(area_means(linear, width, 1), stop - top, 0, low - first, high - first)
    return texels


def _eight_bits(image: Image.Image, tags: Mapping[int, Any], name: str) -> Image.Image:
    """Grey of more bits: the upper 8 of whole numbers, 255 times floats in [0, 1]. Pillow would clip both, and leaves
    those of a TIFF whose 0 is white inverted."""
    if image.mode[0] not in "IF":
        return image
    upper = _upper_bits(image, tags, name)
    return Image.fromarray(255 - upper if white_is_zero(tags) else upper)


def _upper_bits(image: Image.Image, tags: Mapping[int, Any], name: str) -> UInt8[np.ndarray, "h w"]:
    """8 bits of each value of a grey picture with more, or of floats in [0, 1]."""
    values = np.asarray(image)
    if image.mode == "F":
        if not (values.min() >= -SLACK and values.max() <= 1 + SLACK):  # NaN is neither
            raise UnirenderError(
                f"texture {name}: got floats from {values.min():.9g} to {values.max():.9g}, expected [0, 1]; export it "
                "as PNG"
            )
        return eight_bits(values)
    # Formats without tags have 16 bits.
    bits, signed = tags.get(BITS_PER_SAMPLE, (16,))[0], tags.get(SAMPLE_FORMAT, (1,))[0] == SIGNED
    if image.mode != "I":
        return (values >> (bits - 8)).astype(np.uint8)
    if bits == 32 and not signed:
        values = values.view(np.uint32)
    if values.min() < 0:
        raise UnirenderError(
            f"texture {name}: got numbers from {values.min():,}, expected 0 and more; export it as PNG"
        )
    used = 16 if bits == 32 and values.max() < 1 << 16 else bits - int(signed)  # 16 bits are often kept in 32
    return (values >> (used - 8)).astype(np.uint8)


def area_means(
    texels: Float[np.ndarray, "h w c"], count: int, axis: int, low: float = 0.0, high: float | None = None
) -> Float[np.ndarray, "i j c"]:
    """Means over `count` equal parts of one axis, from `low` to `high` in texels (the whole axis)."""
    length = texels.shape[axis]
    high = float(length) if high is None else high
    if count == length == high - low:
        return texels
    edges = np.linspace(low, high, count + 1)
    whole = np.minimum(edges.astype(np.int64), length - 1)
    share = (edges - whole).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
    sums = np.cumsum(texels, axis=axis, dtype=np.float64)  # up to and with each texel
    own = texels.take(whole, axis)
    parts = np.diff(sums.take(whole, axis) - own * (1 - share), axis=axis)
    return (parts * (count / (high - low))).astype(np.float32)


def resized(texels: Float[np.ndarray, "h w c"], height: int, width: int) -> Float[np.ndarray, "{height} {width} c"]:
    """Area means over a grid that is not finer."""
    return area_means(area_means(texels, width, 1), height, 0)


def linear(stored: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """The curve of data that are stored as they are: roughness, metallic, vectors."""
    return stored


def nearest(texels: Float[np.ndarray, "h w c"], height: int, width: int) -> Float[np.ndarray, "{height} {width} c"]:
    """The nearest texels of a grid that is not coarser."""
    rows = np.arange(height) * texels.shape[0] // height
    columns = np.arange(width) * texels.shape[1] // width
    return texels[rows][:, columns]
