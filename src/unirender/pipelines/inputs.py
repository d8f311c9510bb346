"""What a user hands to the pipeline, checked: pictures, masks, a light, a material, a decomposition.

Each error says what to do about it. Maps that are to be rendered: `unirender.pipelines.rendered_maps`.
"""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.errors import UnirenderError
from unirender.intrinsics import RANGE_TOLERANCE, as_numbers
from unirender.light.environment import as_light, check_sphere
from unirender.picture_files.display_files import display_colors, display_values, is_turned
from unirender.pictures import Picture, coverage
from unirender.pipelines.framing import thumbnail
from unirender.pipelines.masked_maps import constant_map
from unirender.pipelines.results import Decomposition
from unirender.pipelines.settings import TAKING_APART

MIN_SIDE = 8  # pixels
MASK_TOLERANCE = 1 / 255  # between masks that are the same but for the 8 bits of a file
PICTURE_TOLERANCE = 2 / 255  # between display values times such masks that are the same but for these 8 bits
RANGE_ADVICE = "divide 8 bits by 255 and 16 bits by 65535; tone-map or clip radiance"

logger = logging.getLogger(__name__)


def as_list(name: str, several: Any, channels: int) -> list[Any]:
    """What is handed in for several pictures, one by one.

    Args:
        name: of the argument.
        several: pictures or masks, or an array of them [n h w channels]; of masks [n h w], too.
        channels: of each of them.

    Raises:
        UnirenderError: a PIL picture, an array that is one picture or mask, or something else that is one.
    """
    if isinstance(several, np.ndarray) and several.dtype != object and not _is_batch(several, channels):
        shapes = f"[n, height, width, {channels}]" + (" or [n, height, width]" if channels == 1 else "")
        raise UnirenderError(
            f"{name}: got one array of shape {several.shape}, expected a list, one for each picture, or an array "
            f"{shapes}; one picture goes to `decompose`"
        )
    if isinstance(several, str) or not isinstance(several, Iterable):
        raise UnirenderError(f"{name}: got one {type(several).__name__}, expected a list, one for each picture")
    return list(several)


def as_picture(image: Any, mask: Any = None) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 1"]]:
    """Display values and coverage from arrays or PIL pictures; without a mask the alpha channel, else the whole frame.

    Raises:
        UnirenderError: wrong type, shape or range, NaN, or an empty mask.
    """
    if isinstance(image, Image.Image):
        image.load()  # a TIFF is turned by Pillow then
        if is_turned(image):
            logger.warning("image: its EXIF orientation is not applied; PIL.ImageOps.exif_transpose(image) turns it")
        values = display_colors(image, "image")
        picture, alpha = values[..., :3], values[..., 3:] if values.shape[-1] == 4 else None
    elif isinstance(image, np.ndarray):
        picture, alpha = image, None
    elif isinstance(image, Picture):
        raise UnirenderError("image: got a Picture, expected its image_srgb, and its mask as the mask")
    else:
        raise UnirenderError(
            f"image: got {type(image).__name__}, expected a numpy array [h w 3] or a PIL picture; a file is read by "
            "unirender.pictures.read_picture(path), a tensor [3 h w] becomes an array by .permute(1, 2, 0).numpy()"
        )
    if picture.ndim != 3 or picture.shape[-1] != 3:
        raise UnirenderError(
            f"image: got shape {picture.shape}, expected [height, width, 3]; {_shape_advice(picture.shape)}"
        )
    if picture.dtype.kind == "u":
        raise UnirenderError(
            f"image: got {picture.dtype} values, expected floats in [0, 1]; divide by {np.iinfo(picture.dtype).max}, "
            "or pass a PIL picture"
        )
    if min(picture.shape[:2]) < MIN_SIDE:
        raise UnirenderError(f"image: got {picture.shape[:2]} pixels, expected at least {MIN_SIDE} along each side")
    picture = _checked("image", picture, RANGE_ADVICE)
    if mask is None:
        mask = np.ones((*picture.shape[:2], 1), dtype=np.float32) if alpha is None else alpha
    return picture, as_mask(mask, (picture.shape[0], picture.shape[1]))


def as_mask(mask: Any, size: tuple[int, int]) -> Float[np.ndarray, "h w 1"]:
    """Coverage of the given size; of a PIL picture its alpha channel unless it is opaque, else the mean of its colours.

    Raises:
        UnirenderError: wrong type, shape or range, NaN, or nothing covered by more than one half.
    """
    if isinstance(mask, Image.Image):
        mask = coverage(display_values(mask, "mask"))
    if not isinstance(mask, np.ndarray):
        raise UnirenderError(f"mask: got {type(mask).__name__}, expected a numpy array [h w 1] or a PIL picture")
    mask = mask[..., None] if mask.ndim == 2 else mask
    if mask.shape != (*size, 1):
        raise UnirenderError(f"mask: got shape {mask.shape}, expected {(*size, 1)}, the size of the picture")
    mask = np.array(_checked("mask", mask, "divide an 8-bit mask by 255"))  # results keep it, and may not share it
    if not (mask > 0.5).any():  # as `unirender.light.exposure` asks
        raise UnirenderError(
            f"mask: no pixel is covered by more than one half, the most by {mask.max():.3g}, expected an object in view"
        )
    return mask


def as_environment(environment: Any) -> Float[np.ndarray, "eh ew 3"]:
    """Radiance of a lat-long map.

    Raises:
        UnirenderError: as `unirender.light.environment.as_light`; or it is the path of a file, black, or not twice as
            wide as high.
    """
    if isinstance(environment, str | Path):
        raise UnirenderError(
            f"environment: got the path {str(environment)!r:.60}, expected radiance [eh ew 3]; read a light file with "
            "unirender_reference.lights.load_light(path).environment"
        )
    light = as_light(environment)
    check_sphere(light)
    if light.max() <= 0:
        raise UnirenderError("environment: the light is black, expected some radiance")
    return light


def check_decomposition(
    found: Any, picture: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], settings: Mapping[str, Any]
) -> None:
    """Looks at a decomposition that is handed in beside a picture, instead of one being made of it.

    Args:
        found: that decomposition.
        picture: display values.
        mask: of the picture.
        settings: of the call; those of how a picture is taken apart have no effect here, and are refused unless they
            are the decomposition's own, or where these are not known, the defaults.

    Raises:
        UnirenderError: it is no `Decomposition`, of another size, mask or picture, or a setting would have no effect.
    """
    if not isinstance(found, Decomposition):
        raise UnirenderError(
            f"decomposition: got {type(found).__name__}, expected the Decomposition that `decompose` returns; maps "
            "alone are rendered by `render`"
        )
    own = found.intrinsics.require("mask")["mask"]
    if own.shape != mask.shape:
        raise UnirenderError(
            f"decomposition: is of a picture of {own.shape[:-1]} pixels, expected {mask.shape[:-1]} like this one; "
            "leave it out, or decompose this picture"
        )
    if (furthest := float(np.abs(own - mask).max())) > MASK_TOLERANCE:
        raise UnirenderError(
            f"decomposition: its mask differs from this one by up to {furthest:.2g}, expected the same; leave it out, "
            "or decompose the picture with this mask"
        )
    if found.thumbnail is not None:
        apart = float(np.abs(thumbnail(picture, mask) - found.thumbnail).max())
        if apart > PICTURE_TOLERANCE:
            raise UnirenderError(
                f"decomposition: is of another picture, whose display values differ from this one's by {apart:.2g} and "
                "more, expected the same picture; leave it out, or decompose this picture"
            )
    if (camera := settings.get("camera")) not in (None, found.intrinsics.camera):
        raise UnirenderError(
            f"camera: got {camera}, expected {found.intrinsics.camera}, with which the decomposition was made; leave "
            "one of them out"
        )
    for name, own in (found.made_with or TAKING_APART).items():
        if settings.get(name) not in (None, own):
            raise UnirenderError(
                f"{name}: got {settings[name]!r} beside a decomposition, which is taken as it is, expected {own!r}; "
                f"pass {name} to `decompose`, or leave the decomposition out"
            )


def as_material(name: str, value: Any, mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 1"]:
    """A number or a map in [0, 1] as a map, 0 outside the mask.

    Args:
        name: roughness or metallic.
        value: one number, or a map [h w 1] or [h w].
        mask: of the picture.

    Raises:
        UnirenderError: it is no number, outside [0, 1], or of another size.
    """
    if isinstance(value, bool | np.bool_):
        raise UnirenderError(f"{name}: got {value}, expected one number in [0, 1], or a map")
    given = as_numbers(name, value)
    if given.size != 1 and given.shape not in (mask.shape, mask.shape[:2]):
        raise UnirenderError(
            f"{name}: got shape {given.shape}, expected one number, or a map of shape {mask.shape}, the picture's size"
        )
    given = _checked(name, given, "roughness and metallic are fractions")
    return constant_map(given.reshape(mask.shape if given.size != 1 else ()), mask)


def _is_batch(array: np.ndarray, channels: int) -> bool:
    """Whether an array is several pictures or masks; [h, w, 1] is one mask, [n, h, w] are several."""
    return array.ndim >= 4 or (channels == 1 and array.ndim == 3 and array.shape[-1] != 1)


def _shape_advice(shape: tuple[int, ...]) -> str:
    if len(shape) == 4:
        return "several pictures go to `decompose_batch`"
    if len(shape) == 2 or shape[-1] == 1:
        return "repeat grey in three channels"
    if len(shape) == 3 and shape[0] in (1, 3, 4):
        return "channels come last: np.moveaxis(image, 0, -1)"
    return "pass alpha as the mask"


def _checked(name: str, value: np.ndarray, advice: str) -> Float[np.ndarray, "..."]:
    value = as_numbers(name, value)
    if not np.isfinite(value).all():
        bad = int(np.count_nonzero(~np.isfinite(value)))
        raise UnirenderError(f"{name}: {bad} of {value.size} values are NaN or infinite, expected values in [0, 1]")
    low, high = float(value.min()), float(value.max())
    if low < -RANGE_TOLERANCE or high > 1 + RANGE_TOLERANCE:
        raise UnirenderError(f"{name}: got values in [{low:.4g}, {high:.4g}], expected [0, 1]; {advice}")
    return value if low >= 0 and high <= 1 else np.asarray(np.clip(value, 0, 1))
