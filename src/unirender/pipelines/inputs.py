"""What a user hands to the pipeline, checked: pictures, masks and intrinsics. Each error says what to do about it."""

from collections.abc import Collection
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.pictures import coverage, display_colors, display_values
from unirender.pipelines.bounced_light import bounced_light
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.editing import constant_map

RENDER_NEEDS = ("normal", "roughness", "metallic")
DERIVABLE = ("specular", "diffuse")  # from a light
MIN_SIDE = 8  # pixels
RANGE_TOLERANCE = 1e-3


def as_picture(image: Any, mask: Any = None) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 1"]]:
    """Display values and coverage from arrays or PIL pictures; without a mask the alpha channel, else the whole frame.

    Raises:
        UnirenderError: wrong type, shape or range, NaN, or an empty mask.
    """
    if isinstance(image, Image.Image):
        values = display_colors(image, "image")
        picture, alpha = values[..., :3], values[..., 3:] if values.shape[-1] == 4 else None
    elif isinstance(image, np.ndarray):
        picture, alpha = image, None
    else:
        raise UnirenderError(f"image: got {type(image).__name__}, expected a numpy array [h w 3] or a PIL picture")
    if picture.ndim != 3 or picture.shape[-1] != 3:
        raise UnirenderError(f"image: got shape {picture.shape}, expected [height, width, 3]; pass alpha as the mask")
    if picture.dtype == np.uint8:
        raise UnirenderError("image: got uint8 values, expected floats in [0, 1]; divide by 255, or pass a PIL picture")
    if min(picture.shape[:2]) < MIN_SIDE:
        raise UnirenderError(f"image: got {picture.shape[:2]} pixels, expected at least {MIN_SIDE} along each side")
    picture = _checked("image", picture, "tone-map it to display values, or clip it")
    if mask is None:
        mask = np.ones((*picture.shape[:2], 1), dtype=np.float32) if alpha is None else alpha
    return picture, as_mask(mask, (picture.shape[0], picture.shape[1]))


def as_mask(mask: Any, size: tuple[int, int]) -> Float[np.ndarray, "h w 1"]:
    """Coverage of the given size; of a PIL picture its alpha channel if it varies, else the mean of its colours.

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
    mask = _checked("mask", mask, "divide an 8-bit mask by 255")
    if not (mask > 0.5).any():  # as `unirender.exposure` asks
        raise UnirenderError("mask: no pixel is covered by more than one half, expected an object in view")
    return mask


def as_environment(environment: Any) -> Float[np.ndarray, "eh ew 3"]:
    """Radiance of a lat-long map.

    Raises:
        UnirenderError: no array of numbers, wrong shape, NaN, negative, or black.
    """
    light = _numbers("environment", environment)
    if light.ndim != 3 or light.shape[-1] != 3 or min(light.shape[:2]) < 2:
        raise UnirenderError(f"environment: got shape {light.shape}, expected a lat-long map [height, width, 3]")
    if not np.isfinite(light).all() or light.min() < 0:
        raise UnirenderError("environment: got NaN, infinite or negative radiance, expected finite values >= 0")
    if light.max() <= 0:
        raise UnirenderError("environment: the light is black, expected some radiance")
    return light


def to_derive(intrinsics: Intrinsics) -> frozenset[str]:
    """Which of specular and diffuse follow from the light where intrinsics are rendered."""
    names = DERIVABLE if intrinsics.environment is not None else ()
    return frozenset(name for name in names if getattr(intrinsics, name) is None)


def told_derived(names: Collection[str], shadows: bool) -> frozenset[str]:
    """Which of the derived maps the network is told to be derived, as `derived`.

    Without shadows all. Of those that have the shadows that the picture shows d alone: chosen by what came out of
    models that never saw such maps, and so it is in training.
    """
    return frozenset(names) - {"specular"} if shadows else frozenset(names)


def ready_to_render(intrinsics: Intrinsics, shadows: bool = True, derived: Collection[str] = ()) -> Intrinsics:
    """Intrinsics that the renderer can use: with a mask, and with s and d derived where a light is given.

    What is derived is direct light, and what the object itself reflects where it hides that
    (`unirender.pipelines.bounced_light`), if its albedo is known. It is meant for this one rendering: with another
    material it is another.

    Args:
        intrinsics: to be rendered.
        shadows: whether what is derived has the shadows that the picture's own surfaces cast, and what they reflect.
        derived: which of its s and d were derived from its light as direct light, with shadows if `shadows`.

    Raises:
        UnirenderError: normal, roughness or metallic is missing; leading axes; a bad size.
    """
    intrinsics.require(*RENDER_NEEDS)
    if intrinsics.roughness is not None and intrinsics.roughness.ndim != 3:
        raise UnirenderError(
            f"render: got maps of shape {intrinsics.roughness.shape}, expected one picture [height, width, channels]"
        )
    intrinsics = with_mask(intrinsics)
    as_mask(intrinsics.mask, (intrinsics.height, intrinsics.width))
    if intrinsics.environment is None:
        return intrinsics
    light = as_environment(intrinsics.environment)
    names = to_derive(intrinsics)
    direct = intrinsics.replace(**derived_light(intrinsics, light, names, shadows=shadows))
    names = names.union(derived)
    if not shadows or not names or direct.albedo is None:
        return direct
    bounced = bounced_light(direct, names)
    return direct.replace(**{name: getattr(direct, name) + value for name, value in bounced.items()})


def check_rendered(intrinsics: Any, derived: Collection[str]) -> None:
    """Looks at what is to be rendered, and at the names of what was derived from its light.

    Raises:
        UnirenderError: no intrinsics, or a name of no map that can be derived.
    """
    if not isinstance(intrinsics, Intrinsics):
        raise UnirenderError(
            f"render: got {type(intrinsics).__name__}, expected unirender.intrinsics.Intrinsics; a Decomposition or an "
            "EditResult has them as its `intrinsics`"
        )
    if unknown := sorted(set(derived) - set(DERIVABLE)):
        raise UnirenderError(f"derived: got {', '.join(unknown)}, expected names out of {', '.join(DERIVABLE)}")


def with_mask(intrinsics: Intrinsics) -> Intrinsics:
    """The intrinsics with a mask: the whole frame where none is known."""
    if intrinsics.mask is not None:
        return intrinsics
    return intrinsics.replace(mask=np.ones((intrinsics.height, intrinsics.width, 1), dtype=np.float32))


def as_material(name: str, value: Any, mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 1"]:
    """A number or a map in [0, 1] as a map, 0 outside the mask.

    Args:
        name: roughness or metallic.
        value: one number, or a map [h w 1] or [h w].
        mask: of the picture.

    Raises:
        UnirenderError: it is no number, outside [0, 1], or of another size.
    """
    given = _numbers(name, value)
    if given.size != 1 and given.shape not in (mask.shape, mask.shape[:2]):
        raise UnirenderError(
            f"{name}: got shape {given.shape}, expected one number, or a map of shape {mask.shape}, the picture's size"
        )
    given = _checked(name, given, "roughness and metallic are fractions")
    return constant_map(given.reshape(mask.shape if given.size != 1 else ()), mask)


def _numbers(name: str, value: Any) -> Float[np.ndarray, "..."]:
    try:
        return np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:  # the last is torch's
        raise UnirenderError(f"{name}: got {type(value).__name__} {value!r:.60}, expected numbers") from error


def _checked(name: str, value: np.ndarray, advice: str) -> Float[np.ndarray, "..."]:
    value = _numbers(name, value)
    if not np.isfinite(value).all():
        bad = int(np.count_nonzero(~np.isfinite(value)))
        raise UnirenderError(f"{name}: {bad} of {value.size} values are NaN or infinite, expected values in [0, 1]")
    low, high = float(value.min()), float(value.max())
    if low < -RANGE_TOLERANCE or high > 1 + RANGE_TOLERANCE:
        raise UnirenderError(f"{name}: got values in [{low:.4g}, {high:.4g}], expected [0, 1]; {advice}")
    return np.asarray(np.clip(value, 0, 1))
