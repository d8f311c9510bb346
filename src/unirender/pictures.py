"""Pictures and masks from files: PNG, JPG and whatever else Pillow knows, and linear OpenEXR."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender import exr
from unirender.arguments import as_path
from unirender.camera import Camera
from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, header_camera, read_exr
from unirender.picture_files import display_files
from unirender.picture_files.display_files import FORMATS, picture_count, srgb_values_and_remarks, stored_values
from unirender.shown import short_repr

DISPLAY_WHITE = 254.5 / 255  # a display value from which a channel is clipped
OPAQUE = DISPLAY_WHITE  # a coverage from which it is whole: no alpha of 8 bits lies between
NEGATIVE_MOST = 0.05  # share of all radiance up to which negative values pass, as a filter's ringing or a wider gamut
ALPHA_TOLERANCE = 1e-3  # of an EXR: half precision and filters step over [0, 1]
MASK_BEYOND = 0.1  # how far an EXR's mask may step over [0, 1]: more is no filter's ringing

logger = logging.getLogger(__name__)


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

    __repr__ = short_repr

    @property
    def clipped(self) -> float:
        """Share of the covered pixels with a channel at display white: of its radiance only a lower bound is known."""
        white = (self.image_srgb >= DISPLAY_WHITE).any(axis=-1)
        return float(np.average(white, weights=None if self.mask is None else self.mask[..., 0]))


def read_picture(path: str | Path, *, upright: bool = True) -> Picture:
    """Reads PNG, JPG and whatever else Pillow knows, or a linear OpenEXR image `R,G,B[,A]` (premultiplied; `mask.Y`
    counts where there is no `A`).

    Colours come in sRGB's primaries, whatever the file's ICC profile or chromaticities say.

    Args:
        path: of the file.
        upright: turn it as its EXIF orientation says; False: pixels as they are stored, in which cameras that were
            found from them count.

    Raises:
        UnirenderError: the file is missing, no picture, broken, too large, or an EXR with NaN or infinite values or
            with more negative radiance than `NEGATIVE_MOST`.
    """
    path = checked_file(path)
    return _read_exr_picture(path) if path.suffix.lower() == ".exr" else _read_display_picture(path, upright)


def header_pixels(path: str | Path) -> int:
    """Width times height by the header of a picture; 0 where it cannot be read, which `read_picture` tells of.

    Raises:
        UnirenderError: as `checked_file`.
    """
    path = checked_file(path)
    return exr.pixel_count(path) if path.suffix.lower() == ".exr" else display_files.pixel_count(path)


def checked_file(path: str | Path) -> Path:
    """The path.

    Raises:
        UnirenderError: there is no such file, or it is none.
    """
    path = as_path(path)
    if not path.exists():
        raise UnirenderError(f"{path}: no such file, expected a picture: {FORMATS}")
    if path.is_dir():
        raise UnirenderError(f"{path}: is a folder, expected a picture: {FORMATS}")
    if not path.is_file():  # which would wait for who writes to it, and cannot be read twice
        raise UnirenderError(f"{path}: is a pipe or a device, expected a picture: {FORMATS}; save it as a file first")
    return path


def read_mask(path: str | Path, size: tuple[int, int], *, upright: bool = True) -> Float[np.ndarray, "h w 1"]:
    """Coverage from a picture file: its alpha channel unless it is opaque, else the mean of its colours as stored.

    An EXR may have `mask.Y` or `Y` instead of colours, or `A` alone. What is lost in reading it is logged. `upright` as
    of `read_picture`.

    Raises:
        UnirenderError: as `read_picture`, or the size differs from `size` (height, width), or the mask is empty, or
            values are more than `MASK_BEYOND` outside [0, 1].
    """
    mask, remarks = read_mask_file(path, size, upright=upright)
    for remark in remarks.values():
        logger.warning("%s: %s", path, remark)
    return mask


def read_mask_file(
    path: str | Path, size: tuple[int, int], *, upright: bool = True
) -> tuple[Float[np.ndarray, "h w 1"], dict[str, str]]:
    """The same, and by kind what is lost, of which nothing is logged.

    Raises:
        UnirenderError: as `read_mask`.
    """
    path = checked_file(path)
    exr = path.suffix.lower() == ".exr"
    mask = mask_values(path, upright=upright)
    if mask.shape[:2] != size:
        on_its_side = upright and mask.shape[1::-1] == size
        advice = " as its EXIF orientation turns it; turn the mask likewise" if on_its_side else ""
        raise UnirenderError(
            f"{path}: the mask is {mask.shape[1]} x {mask.shape[0]} pixels, expected {size[1]} x {size[0]} "
            f"like the picture{advice}"
        )
    low, high = float(mask.min()), float(mask.max())
    if low < -MASK_BEYOND or high > 1 + MASK_BEYOND:
        raise UnirenderError(
            f"{path}: the mask has values in [{low:.3g}, {high:.3g}], expected coverage in [0, 1]; divide it by its "
            "white, or write 1 on the object alone"
        )
    remarks = {}
    if not exr and (count := picture_count(path)) > 1:
        remarks["mask_frames"] = f"the mask's file holds {count} pictures, of which the first is taken"
    if low < -ALPHA_TOLERANCE or high > 1 + ALPHA_TOLERANCE:
        remarks["mask_range"] = f"the mask has values in [{low:.3g}, {high:.3g}], clipped to [0, 1]"
    return check_mask(mask, str(path)), remarks


def mask_values(path: Path, *, upright: bool = True) -> Float[np.ndarray, "h w 1"]:
    """Coverage as a file has it, empty or beyond [0, 1] as it may be.

    Raises:
        UnirenderError: the file is broken.
    """
    return _read_exr_mask(path) if path.suffix.lower() == ".exr" else coverage(stored_values(path, upright=upright))


def check_mask(mask: Float[np.ndarray, "h w 1"], name: str) -> Float[np.ndarray, "h w 1"]:
    """Returns the mask.

    Raises:
        UnirenderError: no pixel is covered by more than one half.
    """
    if not (mask > 0.5).any():
        raise UnirenderError(
            f"{name}: the mask is empty: no pixel is covered by more than half, and the most by {mask.max():.3g}, "
            "expected white (255 of 8 bits) or opaque pixels on the object"
        )
    return np.clip(mask, 0, 1).astype(np.float32)


def coverage(values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w 1"]:
    """What RGB or RGBA values say as a mask: the alpha channel unless it is opaque, else the mean of the colours."""
    if values.shape[-1] == 4 and values[..., 3].min() < OPAQUE:
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


def _read_display_picture(path: Path, upright: bool) -> Picture:
    pixels, remarks = srgb_values_and_remarks(path, str(path), upright=upright)
    mask = check_mask(pixels[..., 3:], f"{path} (alpha)") if pixels.shape[-1] == 4 else None
    if (count := picture_count(path)) > 1:
        remarks["frames"] = f"the file holds {count} pictures, of which the first is taken"
    return Picture(np.ascontiguousarray(pixels[..., :3]), mask, path.name, remarks=remarks)


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
            f"{path}: has the channels {', '.join(sorted(channels))}, expected a mask: A, mask.Y, Y, or R, G and B; "
            "rename its channel"
        )
    check_finite(grey[..., None], str(path))
    return grey[..., None]


def _read_exr_picture(path: Path) -> Picture:
    """A linear, premultiplied EXR as straight display values; `A`, or else `mask.Y`, is its mask."""
    channels, attributes = read_exr(path)
    if not set("RGB") <= set(channels):
        raise UnirenderError(
            f"{path}: has the channels {', '.join(sorted(channels))}, expected a picture with R, G, B (and A); "
            "rename those of the layer, or copy grey to all three"
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
    return Picture(image_srgb(rgb), mask, path.name, negative, header_camera(attributes), remarks)
