"""Pictures and masks from files: PNG, JPG and whatever else Pillow knows, and linear OpenEXR."""

import contextlib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageOps, UnidentifiedImageError

from unirender.camera import Camera
from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import CAMERA_ATTRIBUTE, channels_rgb, read_exr
from unirender.icc import in_srgb

FORMATS = "PNG, JPG, TIFF, WebP, BMP or EXR"
MAX_PIXELS = 100_000_000
DISPLAY_WHITE = 254.5 / 255  # a display value from which a channel is clipped
DISPLAY_MAX_8_BIT, DISPLAY_MAX_16_BIT = 255, 65535  # display white of grey
NEGATIVE_MOST = 0.05  # share of all radiance up to which negative values pass, as a filter's ringing or a wider gamut

SIXTEEN_BITS = "its channels have 16 bits, of which 8 are read: save linear radiance as EXR to keep them"
ALPHA_TOLERANCE = 1e-3  # of an EXR: half precision and filters step over [0, 1]


@dataclass(frozen=True)
class Picture:
    """A picture as a method sees it.

    Attributes:
        image_srgb: display values in [0, 1], not premultiplied.
        mask: coverage; None where the file has no alpha channel.
        name: what to call it in messages.
        negative: share of the file's radiance that was negative, and is 0 here; display formats have none.
        camera: that took it, where the header of an EXR of ours says so.
        remarks: by kind, what was assumed of it, what was lost in reading it, and what it cannot show.
    """

    image_srgb: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"] | None
    name: str
    negative: float = 0.0
    camera: Camera | None = None
    remarks: Mapping[str, str] = field(default_factory=dict)

    @property
    def clipped(self) -> float:
        """Share of the covered pixels with a channel at display white: of its radiance only a lower bound is known."""
        white = (self.image_srgb >= DISPLAY_WHITE).any(axis=-1)
        return float(np.average(white, weights=None if self.mask is None else self.mask[..., 0]))


def read_picture(path: str | Path) -> Picture:
    """Reads PNG, JPG and whatever else Pillow knows, or a linear OpenEXR image `R,G,B[,A]` (premultiplied; `mask.Y`
    counts where there is no `A`).

    Colours come in sRGB's primaries, whatever the file's ICC profile or chromaticities say.

    Raises:
        UnirenderError: the file is missing, no picture, broken, too large, or an EXR with NaN or infinite values or
            with more negative radiance than `NEGATIVE_MOST`.
    """
    path = checked_file(path)
    return _read_exr_picture(path) if path.suffix.lower() == ".exr" else _read_display_picture(path)


def checked_file(path: str | Path) -> Path:
    """The path.

    Raises:
        UnirenderError: there is no such file.
    """
    path = Path(path)
    if not path.exists():
        raise UnirenderError(f"{path}: no such file, expected a picture: {FORMATS}")
    if path.is_dir():
        raise UnirenderError(f"{path}: is a folder, expected a picture: {FORMATS}")
    return path


def read_mask(path: str | Path, size: tuple[int, int]) -> Float[np.ndarray, "h w 1"]:
    """Coverage from a picture file: its alpha channel if it varies, else the mean of its colours, as they are stored.

    An EXR may have `mask.Y` or `Y` instead of colours, or `A` alone.

    Raises:
        UnirenderError: as `read_picture`, or the size differs from `size` (height, width), or the mask is empty.
    """
    path = checked_file(path)
    mask = (
        _read_exr_mask(path)
        if path.suffix.lower() == ".exr"
        else coverage(display_values(open_picture(path), str(path)))
    )
    if mask.shape[:2] != size:
        raise UnirenderError(
            f"{path}: the mask is {mask.shape[1]} x {mask.shape[0]} pixels, expected {size[1]} x {size[0]} "
            "like the picture"
        )
    return check_mask(mask, str(path))


def check_mask(mask: Float[np.ndarray, "h w 1"], name: str) -> Float[np.ndarray, "h w 1"]:
    """Returns the mask.

    Raises:
        UnirenderError: no pixel is covered by more than one half.
    """
    if not (mask > 0.5).any():
        raise UnirenderError(
            f"{name}: the mask is empty: no pixel is covered by more than half, and the most by {mask.max():.3g}, "
            "expected white (or opaque) pixels on the object"
        )
    return np.clip(mask, 0, 1).astype(np.float32)


def open_picture(path: str | Path) -> Image.Image:
    """A picture file in a format of Pillow's, decoded and turned as its EXIF orientation says.

    Raises:
        UnirenderError: no readable picture, or one of more than `MAX_PIXELS`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as file:
                width, height = file.size
                if width * height > MAX_PIXELS:
                    raise UnirenderError(
                        f"{path}: {width} x {height} pixels, expected at most {MAX_PIXELS:,}; scale it down first"
                    )
                file.load()
                return ImageOps.exif_transpose(file)
    except UnirenderError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise UnirenderError(f"{path}: not a readable picture ({error}), expected {FORMATS}") from error


def display_values(image: Image.Image, name: str) -> Float[np.ndarray, "h w c"]:
    """The pixels of a PIL picture of any mode as display values in [0, 1], not premultiplied: RGB, or RGBA where the
    picture has an alpha channel. 16-bit grey keeps its 16 bits (Pillow's own conversion saturates it).

    Args:
        image: the picture; its EXIF orientation is not looked at.
        name: what to call it in messages.

    Raises:
        UnirenderError: a floating-point or 32-bit picture, whose values have no display white or may have either; or
            one of L*a*b*.
    """
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
        return np.repeat(values[..., None] / np.float32(DISPLAY_MAX_16_BIT), 3, axis=-1)
    if image.mode == "LAB":
        raise UnirenderError(f"{name}: a picture of mode {image.mode}, expected RGB, grey or CMYK; convert it to sRGB")
    if image.mode in ("RGBa", "La"):  # premultiplied
        image = image.convert("RGBA" if image.mode == "RGBa" else "LA")
    mode = "RGBA" if image.has_transparency_data else "RGB"
    return np.asarray(image.convert(mode), dtype=np.float32) / 255


def display_colors(image: Image.Image, name: str) -> Float[np.ndarray, "h w c"]:
    """The same of a picture of colours and not of data: in sRGB, whatever its ICC profile says (`unirender.icc`)."""
    return display_values(in_srgb(image, name), name)


def coverage(values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w 1"]:
    """What RGB or RGBA values say as a mask: the alpha channel if it varies, else the mean of the colours."""
    if values.shape[-1] == 4 and values[..., 3].min() < 1:
        return values[..., 3:]
    return values[..., :3].mean(axis=-1, keepdims=True, dtype=np.float64).astype(np.float32)


def check_finite(pixels: Float[np.ndarray, "h w c"], name: str) -> None:
    """Looks for values that are no numbers.

    Raises:
        UnirenderError: there is one; the message has their number and the first one's place.
    """
    bad = ~np.isfinite(pixels).all(axis=-1)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise UnirenderError(
            f"{name}: {int(bad.sum())} of {bad.size} pixels are NaN or infinite (the first in row {row}, column "
            f"{column}, counted from 0), expected finite radiance; repair them first"
        )


def negative_share(radiance: Float[np.ndarray, "h w 3"], name: str) -> float:
    """Sum of the negative values over that of all absolute values: what is lost where they are set to 0.

    Raises:
        UnirenderError: it is above `NEGATIVE_MOST`.
    """
    total = np.abs(radiance).sum(dtype=np.float64)
    negative = float(-np.minimum(radiance, 0).sum(dtype=np.float64) / max(total, 1e-30))
    if negative > NEGATIVE_MOST:
        raise UnirenderError(
            f"{name}: {negative:.0%} of the radiance is negative, expected values >= 0 "
            f"(up to {NEGATIVE_MOST:.0%} pass as ringing of a filter); repair the file"
        )
    return negative


def _read_display_picture(path: Path) -> Picture:
    pixels = display_colors(open_picture(path), str(path))
    mask = check_mask(pixels[..., 3:], f"{path} (alpha)") if pixels.shape[-1] == 4 else None
    remarks = {"depth": SIXTEEN_BITS} if _has_sixteen_bit_colors(path) else {}
    return Picture(np.ascontiguousarray(pixels[..., :3]), mask, path.name, remarks=remarks)


def _has_sixteen_bit_colors(path: Path) -> bool:
    """Whether Pillow drops half of the bits of a picture's channels, by how it would decode them."""
    with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning), Image.open(path) as file:
        return not file.mode.startswith("I") and any(";16" in str(tile.args) for tile in file.tile)


def _read_exr_mask(path: Path) -> Float[np.ndarray, "h w 1"]:
    """Coverage is no radiance: the numbers as they are, however the colours beside them are."""
    channels, _ = read_exr(path)
    alpha, grey = channels.get("A"), channels.get("mask.Y", channels.get("Y"))
    if grey is None and set("RGB") <= set(channels):
        grey = channels_rgb(channels).mean(axis=-1)
    if alpha is not None and (grey is None or alpha.min() < 1):
        grey = alpha
    if grey is None:
        raise UnirenderError(
            f"{path}: has the channels {', '.join(sorted(channels))}, expected a mask: A, mask.Y, Y, or R, G and B"
        )
    check_finite(grey[..., None], str(path))
    return grey[..., None]


def _read_exr_picture(path: Path) -> Picture:
    channels, attributes = read_exr(path)
    if not set("RGB") <= set(channels):
        raise UnirenderError(
            f"{path}: has the channels {', '.join(sorted(channels))}, expected a picture with R, G, B (and A)"
        )
    rgb = channels_rgb(channels)
    name = "A" if "A" in channels else "mask.Y"
    alpha = channels.get(name)
    check_finite(rgb if alpha is None else np.dstack([rgb, alpha]), str(path))
    negative = negative_share(rgb, str(path))
    mask, remarks = None, {}
    if alpha is not None:
        mask = check_mask(alpha[..., None], f"{path} ({name})")
        if np.abs(alpha - mask[..., 0]).max() > ALPHA_TOLERANCE:
            remarks["alpha"] = f"{name} has values in [{alpha.min():.3g}, {alpha.max():.3g}], clipped to [0, 1]"
        rgb = unpremultiply(rgb, mask)
    camera = None
    with contextlib.suppress(UnirenderError):  # other programs may write what they call a camera
        camera = Camera.parse(attributes.get(CAMERA_ATTRIBUTE, ""))
    return Picture(image_srgb(rgb), mask, path.name, negative, camera, remarks)
