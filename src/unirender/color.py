"""Colour: linear Rec.709 <-> sRGB display values, coverage, and the tone curve that brings HDR maps into [0, 1].

Notation: names end in `_linear` for scene-referred linear Rec.709 and in `_srgb` for display values encoded with the
sRGB transfer function (IEC 61966-2-1). `colour-science` has the same functions; it takes 2 s to import, so these ten
lines stand here and a test holds them against it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from unirender.arguments import as_coverage, as_floats
from unirender.blocks import by_rows, by_values
from unirender.errors import UnirenderError

LUMINANCE_REC709 = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
MIN_MASK = 1e-6  # a coverage that is divided by; less than half precision stores


def srgb_encode(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Linear -> display value. Defined on [0, inf); negative input follows the linear toe.

    Raises:
        UnirenderError: no numbers, or those of 8 or 16 bits.
    """
    return by_values(_encode, np.asarray(as_floats(linear, "linear values"), dtype=np.float32))


def _encode(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    power = 1.055 * np.power(np.maximum(linear, 0.0031308), 1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, power).astype(np.float32)


def srgb_decode(srgb: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Display value -> linear; the inverse of `srgb_encode`, with the same errors."""
    return by_values(_decode, np.asarray(as_floats(srgb, "display values"), dtype=np.float32))


def _decode(srgb: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    power = np.power((np.maximum(srgb, 0.04045) + 0.055) / 1.055, 2.4)
    return np.where(srgb <= 0.04045, srgb / 12.92, power).astype(np.float32)


def image_srgb(image_linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """What a display shows at exposure 1: `srgb(clip(image_linear, 0, 1))`, in [0, 1]."""
    values = np.asarray(as_floats(image_linear, "image"), dtype=np.float32)
    return by_values(lambda linear: _encode(np.clip(linear, 0.0, 1.0)), values)


def eight_bits(display: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Display values as a file of 8 bits has them: [0, 1] as 0 to 255, rounded; what is outside is clipped."""
    return np.round(np.clip(display, 0, 1) * 255).astype(np.uint8)


def display_slope(
    linear: Float[np.ndarray, "..."], space: Literal["srgb", "linear"] = "srgb"
) -> Float[np.ndarray, "..."]:
    """Derivative (float64) of the display value with respect to linear light: 0 where the display clips.

    Args:
        linear: any range.
        space: "srgb": the display value is `image_srgb`; "linear": only the clip to [0, 1].

    Raises:
        UnirenderError: another space.
    """
    if space not in ("srgb", "linear"):
        raise UnirenderError(f"space: got {space!r:.60}, expected 'srgb' or 'linear'")
    x = np.asarray(linear, np.float64)
    if space == "srgb":
        slope = np.where(x <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(x, 0.0031308) ** (1 / 2.4 - 1))
    else:
        slope = np.ones_like(x)
    return np.where((x < 0) | (x > 1), 0.0, slope)


def unpremultiply(
    image_linear: Float[np.ndarray, "*batch h w c"], mask: Float[np.ndarray, "*batch h w 1"]
) -> Float[np.ndarray, "*batch h w c"]:
    """Radiance of the covered part of each pixel: a premultiplied image / its coverage; 0 where the mask is 0,
    and NaN where the mask is.

    Raises:
        UnirenderError: one of them is of whole numbers (a mask of 0 and 1 may be), or the mask has not one channel.
    """
    image_linear, mask = as_floats(image_linear, "image"), as_coverage(mask, "mask")
    if mask.shape[-1:] != (1,) or mask.ndim < min(image_linear.ndim, 3):  # one mask may be that of several pictures
        raise UnirenderError(
            f"mask: got shape {mask.shape} for an image of {image_linear.shape}, expected [height, width, 1]"
        )
    return by_rows(_straight, image_linear, mask)


def _straight(image_linear: Float[np.ndarray, "..."], mask: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.where(mask <= 0, 0, image_linear / np.maximum(mask, MIN_MASK)).astype(np.float32)


def luminance(rgb_linear: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Relative luminance Y of linear Rec.709."""
    return np.asarray(rgb_linear, dtype=np.float32) @ LUMINANCE_REC709


@dataclass(frozen=True)
class HdrCurve:
    """The curve through which HDR maps enter the network: `log1p(k x) / log1p(k x_max)`, [0, x_max] -> [0, 1].

    Attributes:
        k: in 1/radiance; a larger k gives dark radiance more of the range. The slope at 0 is k / log1p(k x_max).
        x_max: radiance that maps to 1. Larger values are not clipped: they map above 1 and `overflow` counts them.
    """

    k: float = 10.0
    x_max: float = 100.0

    def encode(self, x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Radiance (>= 0) -> curve value."""
        return (np.log1p(self.k * np.asarray(x, dtype=np.float32)) / np.log1p(self.k * self.x_max)).astype(np.float32)

    def decode(self, y: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Curve value -> radiance; the inverse of `encode`."""
        return (np.expm1(np.asarray(y, dtype=np.float32) * np.log1p(self.k * self.x_max)) / self.k).astype(np.float32)

    def overflow(self, x: Float[np.ndarray, "..."]) -> int:
        """How many values lie above `x_max`."""
        return int(np.count_nonzero(np.asarray(x) > self.x_max))
