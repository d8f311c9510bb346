"""Methods: what a benchmark row is made of.

A method is any object with a `name`, a JSON-able `config` (everything its results depend on; part of the cache key) and
any of the four capabilities below; the tables that it can fill follow from those that it has. It sees the 8-bit
picture, the mask and the camera, nothing else:

    decompose(image_srgb, mask, camera) -> Intrinsics                                  any subset of the maps
    edit(image_srgb, mask, camera, roughness=None, metallic=None) -> image_linear      with another material
    relight(image_srgb, mask, camera, environment=None, specular=None, diffuse=None) -> image_linear
    render(intrinsics) -> image_linear                                                 s and d may be unknown

`image_srgb` is float32 (h, w, 3) in {0, 1/255 .. 1}, straight as in a PNG with alpha (not premultiplied, 0 outside);
`mask` (h, w, 1) is the alpha. Results are linear and premultiplied by the mask, as everywhere. How other people's
methods come in: `plugins`. Rows that need no network: `trivial`, `composite`.
"""

import inspect
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from unirender.color import image_srgb as encode_srgb
from unirender.color import srgb_decode, unpremultiply
from unirender.errors import UnirenderError

CAPABILITIES = ("decompose", "edit", "relight", "render")
SEEN = ("image_srgb", "mask", "camera")
ALWAYS_PASSED = {"decompose": SEEN, "edit": SEEN, "relight": SEEN, "render": ("intrinsics",)}  # by these names
Image = Float[np.ndarray, "h w 3"]
Mask = Float[np.ndarray, "h w 1"]


class Method(Protocol):
    """A benchmark row; see the module for the four optional capabilities."""

    name: str

    @property
    def config(self) -> Mapping[str, Any]: ...


def capabilities(method: Any) -> tuple[str, ...]:
    """Which of `decompose`, `edit`, `relight`, `render` the method has. Its `config` is not read."""
    return tuple(name for name in CAPABILITIES if callable(getattr(method, name, None)))


def check_method(method: Any) -> None:
    """Looks whether an object is a `Method`, without reading its name and config.

    Raises:
        UnirenderError: it has none of the capabilities, or no name or config; or a function does not take what it is
            passed.
    """
    absent = [f"no `{name}`" for name in ("name", "config") if not _has(method, name)]
    absent += [] if capabilities(method) else ["none of the functions"]
    if absent:
        raise UnirenderError(
            f"{type(method).__name__} is not a method: it has {' and '.join(absent)}; expected a `name`, a `config` "
            f"and at least one of the functions {', '.join(CAPABILITIES)}"
        )
    for name in capabilities(method):
        try:
            taken = inspect.signature(getattr(method, name))
        except (TypeError, ValueError):  # compiled code may not say
            continue
        try:
            taken.bind_partial(**dict.fromkeys(ALWAYS_PASSED[name]))
        except TypeError as error:
            raise UnirenderError(
                f"{type(method).__name__}.{name} takes {taken} ({error}), expected the arguments "
                f"{', '.join(ALWAYS_PASSED[name])}, which are passed by name; rename its own"
            ) from error


def _has(method: Any, attribute: str) -> bool:
    """Whether it is there, be it a property that fails."""
    return inspect.getattr_static(method, attribute, None) is not None or hasattr(method, attribute)


def quantise(image_linear: Image, mask: Mask) -> Image:
    """The picture that a method is shown: display values of the covered part, straight, rounded to 8 bits, in [0,
    1]."""
    return (np.round(encode_srgb(unpremultiply(image_linear, mask)) * 255.0) / 255.0).astype(np.float32)


def seen_linear(image_srgb: Image, mask: Mask) -> Image:
    """The picture that a method was shown as a linear image, premultiplied."""
    return (srgb_decode(image_srgb) * mask).astype(np.float32)


def uniform_map(mask: Mask, value: Any) -> Float[np.ndarray, "h w c"]:
    """The same value in every covered pixel, 0 elsewhere."""
    return ((mask > 0) * np.asarray(value, np.float32)).astype(np.float32)
