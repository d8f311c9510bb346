"""Rendering in dim light, in which the network's error does not shrink as the radiance does.

Radiance is linear in the light, R(x, k L) = k R(x, L). Light far dimmer than any that was taught is made as bright as
the dimmest that was, and the picture dark again:

    out = (R(x, k L) + max(C(x, k L) - 1, 0)) / k,    k = dimmest / P_99(Y(d))

R ends at display white; C, the closed form, says what lies above it. Over a stop k rises from 1, so that a light that
fades does not flicker.
"""

import numpy as np
from jaxtyping import Float

from unirender.color import luminance
from unirender.intrinsics import Intrinsics
from unirender.light.exposure import MASK_THRESHOLD, TARGET_RANGE

DIMMEST = TARGET_RANGE[0]  # radiance of a bright white surface
DIM = DIMMEST / 4  # below which light is made brighter: two stops; a stop further down it is brought there whole
MOST = 1024.0  # of k: of what is darker nothing is seen in 8 bits
LIGHT = ("specular", "diffuse", "environment")
PERCENTILE = 99.0  # of the object, so that a lamp on a small part of it is not dim


def gain_of_dim(intrinsics: Intrinsics) -> float:
    """k; 1 where the light is not dim, and where d is unknown or black.

    Args:
        intrinsics: with a mask.
    """
    if intrinsics.diffuse is None:
        return 1.0
    inside = intrinsics.require("mask")["mask"][..., 0] > MASK_THRESHOLD
    if not inside.any():
        return 1.0
    level = float(np.percentile(luminance(intrinsics.diffuse[inside]), PERCENTILE))
    if not 0 < level < DIM:
        return 1.0
    return float(min((DIMMEST / level) ** min(np.log2(DIM / level), 1.0), MOST))


def brightened(intrinsics: Intrinsics, gain: float) -> Intrinsics:
    """The intrinsics under k times their light: s, d and the environment, those that are known."""
    if gain == 1:
        return intrinsics
    light = {name: intrinsics.maps.get(name) for name in LIGHT}
    return intrinsics.replace(**{n: v * np.float32(gain) for n, v in light.items() if v is not None})


def darkened(
    rendered: Float[np.ndarray, "h w 3"],
    closed_form: Float[np.ndarray, "h w 3"] | None,
    mask: Float[np.ndarray, "h w 1"],
    gain: float,
) -> Float[np.ndarray, "h w 3"]:
    """The image of the light itself, in [0, 1]; all premultiplied.

    Args:
        rendered: R.
        closed_form: C; None: some of its maps are unknown, and nothing is taken to lie above white.
        mask: coverage.
        gain: k.
    """
    above = 0 if closed_form is None else np.maximum(closed_form - mask, 0)
    return np.clip((rendered + above) / np.float32(gain), 0, 1)
