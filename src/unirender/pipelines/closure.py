"""Closing a decomposition: the maps nearest to the predicted ones whose rendering is the picture.

A mean prediction is smooth, and its rendering misses detail that the picture shows. Whatever maps are right, their
rendering is the picture, so the ratio of the two is known at every pixel and only its cause is not. Its logarithm is
shared equally between albedo and light (the least change of both in log space that explains it):

    g = clip((I + e) / (R + e), 1 / G, G),    albedo *= sqrt(g),    s *= sqrt(g),    d *= sqrt(g)

Where a channel of the picture is clipped the ratio is only a lower bound, and the maps are never made darker.

Notation: I the picture, R the rendering of the maps; both linear and premultiplied.
"""

import numpy as np
from jaxtyping import Float

from unirender.blocks import by_rows
from unirender.intrinsics import Intrinsics

MAX_GAIN = 4.0  # G
FLOOR = 0.01  # e: radiance below which the ratio says nothing
CLIPPED = 0.99  # linear value from which a picture's channel counts as clipped


def close_decomposition(
    intrinsics: Intrinsics, image_linear: Float[np.ndarray, "h w 3"], rendered: Float[np.ndarray, "h w 3"]
) -> Intrinsics:
    """The intrinsics with albedo, specular and diffuse changed so that their rendering is the picture, within bounds.

    Args:
        intrinsics: with albedo, specular, diffuse and mask.
        image_linear: the picture, linear, premultiplied.
        rendered: the rendering of the intrinsics; linear, premultiplied.
    """
    maps = intrinsics.require("albedo", "specular", "diffuse", "mask")
    mask = maps.pop("mask")
    root = by_rows(_root_of_gain, image_linear, rendered, mask)
    closed = {name: value * root for name, value in maps.items()}
    np.clip(closed["albedo"], 0, 1, out=closed["albedo"])
    return intrinsics.replace(**closed)


def _root_of_gain(
    image_linear: Float[np.ndarray, "h w 3"], rendered: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 3"]:
    """sqrt(g); 1 outside the mask."""
    gain = np.clip((image_linear + FLOOR) / (rendered + FLOOR), 1 / MAX_GAIN, MAX_GAIN)
    gain = np.where(image_linear >= CLIPPED * mask, np.maximum(gain, 1), gain)
    return np.where(mask > 0, np.sqrt(gain), 1).astype(np.float32)
