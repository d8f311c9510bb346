"""Pictures and masks from files: PNG, JPG and whatever else Pillow knows, and linear OpenEXR."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageOps, UnidentifiedImageError

from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr

MAX_PIXELS = 100_000_000
DISPLAY_WHITE = 254.5 / 255  # a display value from which a channel is clipped


@dataclass(frozen=True)
class Picture:
    """A picture as a method sees it.

    Attributes:
        image_srgb: display values in [0, 1], not premultiplied.
        mask: coverage; None where the file has no alpha channel.
        name: what to call it in messages.
    """

    image_srgb: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"] | None
    name: str

    @property
    def clipped(self) -> float:
        """Share of the covered pixels with a channel at display white: of its radiance only a lower bound is known."""
        white = (self.image_srgb >= DISPLAY_WHITE).any(axis=-1)
        return float(np.average(white, weights=None if self.mask is None else self.mask[..., 0]))


def read_picture(path: str | Path) -> Picture:
    """Reads PNG, JPG and whatever else Pillow knows, or a linear OpenEXR image `R,G,B[,A]` (premultiplied).

    Raises:
        UnirenderError: the file is missing, no picture, broken, too large, or an EXR with NaN or infinite values.
    """
    path = Path(path)
    if not path.exists():
        raise UnirenderError(f"{path}: no such file, expected a PNG, JPG or EXR picture")
    if path.is_dir():
        raise UnirenderError(f"{path}: is a folder, expected a PNG, JPG or EXR picture")
    return _read_exr_picture(path) if path.suffix.lower() == ".exr" else _read_display_picture(path)


def read_mask(path: str | Path, size: tuple[int, int]) -> Float[np.ndarray, "h w 1"]:
    """Coverage from a picture file: its alpha channel if it varies, else its luminance.

    Raises:
        UnirenderError: as `read_picture`, or the size differs from `size` (height, width), or the mask is empty.
    """
    picture = read_picture(path)
    has_alpha = picture.mask is not None and picture.mask.min() < 1
    mask = picture.mask if has_alpha and picture.mask is not None else picture.image_srgb.mean(axis=-1, keepdims=True)
    if mask.shape[:2] != size:
        raise UnirenderError(
            f"{path}: the mask is {mask.shape[1]} x {mask.shape[0]} pixels, expected {size[1]} x {size[0]} "
            "like the picture"
        )
    return check_mask(mask, str(path))


def check_mask(mask: Float[np.ndarray, "h w 1"], name: str) -> Float[np.ndarray, "h w 1"]:
    """Returns the mask.

    Raises:
        UnirenderError: no pixel is covered by at least one half.
    """
    if not (mask >= 0.5).any():
        raise UnirenderError(f"{name}: the mask is empty, expected white (or opaque) pixels on the object")
    return np.clip(mask, 0, 1).astype(np.float32)


def _read_display_picture(path: Path) -> Picture:
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
                image = ImageOps.exif_transpose(file)
    except UnirenderError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise UnirenderError(f"{path}: not a readable picture ({error}), expected PNG, JPG or EXR") from error
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    if image.mode.startswith("I;16") or image.mode in ("I", "F"):  # 16-bit grey
        values = np.asarray(image, dtype=np.float32)
        if image.mode == "F" or values.max(initial=0) > 65535:
            raise UnirenderError(f"{path}: a {image.mode} picture has no display values; save linear radiance as EXR")
        rgb = np.repeat(values[..., None] / 65535, 3, axis=-1)
        return Picture(rgb.astype(np.float32), None, path.name)
    pixels = np.asarray(image.convert("RGBA" if has_alpha else "RGB"), dtype=np.float32) / 255
    mask = check_mask(pixels[..., 3:], f"{path} (alpha)") if has_alpha else None
    return Picture(np.ascontiguousarray(pixels[..., :3]), mask, path.name)


def _read_exr_picture(path: Path) -> Picture:
    channels, _ = read_exr(path)
    if not set("RGB") <= set(channels):
        raise UnirenderError(
            f"{path}: has the channels {', '.join(sorted(channels))}, expected a picture with R, G, B (and A)"
        )
    rgb = channels_rgb(channels)
    alpha = channels.get("A")
    bad = ~np.isfinite(rgb).all(axis=-1) | (~np.isfinite(alpha) if alpha is not None else False)
    if bad.any():
        raise UnirenderError(
            f"{path}: {int(bad.sum())} of {bad.size} pixels are NaN or infinite, expected finite radiance; "
            "repair them first"
        )
    mask = None
    if alpha is not None:
        mask = check_mask(alpha[..., None], f"{path} (A)")
        rgb = unpremultiply(rgb, mask)
    return Picture(image_srgb(rgb), mask, path.name)
