"""Pictures and result folders on disk.

A *result folder* holds `intrinsics.exr` (all image-aligned maps), `environment.exr` (float32), one PNG a map for the
eye and `meta.json`; it appears complete or not at all. `read_result` takes it back.
"""

import contextlib
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageOps, UnidentifiedImageError

from unirender.camera import Camera
from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.exr import (
    channels_rgb,
    image_channels,
    intrinsics_channels,
    intrinsics_from_channels,
    read_exr,
    write_exr,
)
from unirender.intrinsics import IMAGE_MAPS, Intrinsics

MAX_PIXELS = 100_000_000
INTRINSICS_FILE, ENVIRONMENT_FILE, IMAGE_FILE, META_FILE = "intrinsics.exr", "environment.exr", "image.exr", "meta.json"


@dataclass(frozen=True)
class Picture:
    """A picture as a method sees it.

    Attributes:
        image_srgb: display values in [0, 1], not premultiplied.
        mask: coverage from an alpha channel, or None where the file has none.
        clipped: share of the values that lay above display white (EXR only).
        name: what to call it in messages.
    """

    image_srgb: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"] | None
    clipped: float
    name: str


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
        return Picture(rgb.astype(np.float32), None, 0.0, path.name)
    pixels = np.asarray(image.convert("RGBA" if has_alpha else "RGB"), dtype=np.float32) / 255
    mask = check_mask(pixels[..., 3:], f"{path} (alpha)") if has_alpha else None
    return Picture(np.ascontiguousarray(pixels[..., :3]), mask, 0.0, path.name)


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
        rgb = np.where(mask > 0, rgb / np.maximum(mask, 1e-6), 0)
    return Picture(image_srgb(rgb), mask, float(np.mean(rgb > 1)), path.name)


@contextlib.contextmanager
def new_folder(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that becomes `path` when the block ends without an error, and vanishes otherwise.

    Only a result folder (one with `meta.json`) is ever replaced.

    Raises:
        UnirenderError: `path` exists and is not empty, and `overwrite` is not given or it is no result folder; or it
            cannot be made.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise UnirenderError(f"{path}: is a file, expected a folder to write to")
    if path.is_dir() and any(path.iterdir()):
        if not overwrite:
            raise UnirenderError(f"{path}: exists and is not empty; choose another --output or pass --overwrite")
        if not (path / META_FILE).is_file():
            raise UnirenderError(
                f"{path}: has no {META_FILE}, expected an earlier result to overwrite; choose another --output"
            )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise UnirenderError(f"{path}: cannot be written ({error.strerror}); choose another --output") from error
    try:
        yield temporary
        os.chmod(temporary, 0o755)
        if path.is_dir():
            old = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
            os.rename(path, old / "old")
            try:
                os.rename(temporary, path)
            except BaseException:
                os.rename(old / "old", path)
                raise
            finally:
                shutil.rmtree(old)
        else:
            os.rename(temporary, path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def write_png(path: str | Path, values: Float[np.ndarray, "h w c"]) -> None:
    """Display values in [0, 1], 1, 3 or 4 channels, as an 8-bit PNG."""
    pixels = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels).save(path, format="PNG")


def map_picture(name: str, value: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """A map as people look at it: colours and light through sRGB, normals as (n + 1) / 2, the others as they are."""
    if name == "normal":
        return np.where(np.any(value != 0, axis=-1, keepdims=True), value * 0.5 + 0.5, 0)
    return value if name in ("roughness", "metallic", "mask") else image_srgb(value)


def write_result(
    folder: Path,
    intrinsics: Intrinsics | None,
    meta: Mapping[str, Any],
    image_linear: Float[np.ndarray, "h w 3"] | None = None,
) -> None:
    """Writes maps, pictures and `meta.json` into an existing (temporary) folder; see `new_folder`.

    Args:
        folder: where.
        intrinsics: maps to write, or None.
        meta: JSON-serialisable facts: input, checkpoint, settings. The camera is added.
        image_linear: a rendered image, premultiplied; written as `image.exr` and `image.png` (with alpha if the mask is
            known).
    """
    attributes = {key: str(value) for key, value in meta.items() if isinstance(value, str | int | float)}
    record = dict(meta)
    if intrinsics is not None:
        camera = intrinsics.camera
        record |= {"fov_deg": camera.fov_deg, "principal": list(camera.principal)}
        if any(name in IMAGE_MAPS for name in intrinsics.present):
            write_exr(folder / INTRINSICS_FILE, intrinsics_channels(intrinsics), attributes=attributes)
        if intrinsics.environment is not None:
            environment = image_channels(intrinsics.environment)
            write_exr(folder / ENVIRONMENT_FILE, environment, half=False, attributes=attributes)
        for name in intrinsics.present:
            write_png(folder / f"{name}.png", map_picture(name, getattr(intrinsics, name)))
    if image_linear is not None:
        mask = None if intrinsics is None else intrinsics.mask
        rgba = image_linear if mask is None else np.concatenate([image_linear, mask], axis=-1)
        write_exr(folder / IMAGE_FILE, image_channels(rgba), attributes=attributes)
        straight = image_linear if mask is None else np.where(mask > 0, image_linear / np.maximum(mask, 1e-6), 0)
        picture = image_srgb(straight)
        write_png(folder / "image.png", picture if mask is None else np.concatenate([picture, mask], axis=-1))
    (folder / META_FILE).write_text(json.dumps(record, indent=2, sort_keys=True) + "\n")


def read_result(folder: str | Path) -> Intrinsics:
    """The maps of a result folder.

    Raises:
        UnirenderError: there is no such folder, or it lacks `intrinsics.exr`, or a file is broken.
    """
    folder = Path(folder)
    if not (folder / INTRINSICS_FILE).is_file():
        what = "has no intrinsics.exr" if folder.is_dir() else "is not a folder"
        raise UnirenderError(f"{folder}: {what}, expected the output folder of `unirender decompose`")
    channels, _ = read_exr(folder / INTRINSICS_FILE)
    environment = None
    if (folder / ENVIRONMENT_FILE).is_file():
        environment = channels_rgb(read_exr(folder / ENVIRONMENT_FILE)[0])
    camera = Camera()
    if (folder / META_FILE).is_file():
        try:
            meta = json.loads((folder / META_FILE).read_text())
            x, y = meta.get("principal", camera.principal)
            camera = Camera(fov_deg=float(meta.get("fov_deg", camera.fov_deg)), principal=(float(x), float(y)))
        except (ValueError, TypeError, AttributeError) as error:
            raise UnirenderError(
                f"{folder / META_FILE}: not readable ({error}); delete it to use the default camera"
            ) from error
    try:
        return intrinsics_from_channels(channels, environment, camera)
    except UnirenderError as error:
        raise UnirenderError(f"{folder}: {error}") from error
