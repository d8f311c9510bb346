"""A flat albedo: paint is even between its edges, so what changes gradually over a surface is light.

The network says an albedo for each pixel, and much of the shading's fine detail stays in it. The albedo nearest to it
whose total variation is small (Rudin, Osher & Fatemi 1992; here by Chambolle's projection, 2004) has its edges and is
even between them:

    u' = argmin_u  |u - u0|^2 / 2 + w TV(u),    u0 the albedo in display values

Patterns are paint, too. Shading changes brightness more than colour (the rule of Retinex), so where the picture's
colours vary the albedo keeps its detail:

    u' + v^2 / (v^2 + c^2) (u0 - u'),    v the local standard deviation of the picture's chroma

All of it happens in the network's square: what is finer than its pixels stays. The detail that leaves the albedo goes
into s and d, so that the closed form of the maps (`unirender.composite`) stays what it was, within bounds:

    k = clip((I(a) + e) / (I(a') + e), 1 / G, G),    s *= k,    d *= k
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, gaussian_filter
from skimage.restoration import denoise_tv_chambolle

from unirender.blocks import by_rows
from unirender.color import srgb_decode, srgb_encode
from unirender.composite import composite
from unirender.intrinsics import Intrinsics
from unirender.pipelines.closure import FLOOR, MAX_GAIN
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import divide

WEIGHT = 0.08 / 128  # w for each pixel along the square
NEIGHBOURHOOD = 2 / 128  # of v: standard deviation of its Gaussian, in sides of the square
CHROMA = 0.1  # c
DARK = 0.1  # display value below which colours say little
MAPS_OF_GAIN = ("albedo", "metallic", "specular", "diffuse")
ITERATIONS, TOLERANCE = 200, 1e-4  # of Chambolle's projection


def with_flat_albedo(intrinsics: Intrinsics, image_linear: Float[np.ndarray, "h w 3"], frame: Frame) -> Intrinsics:
    """The intrinsics with an albedo that is even between edges, and what it loses in s and d.

    Args:
        intrinsics: with albedo, metallic, specular, diffuse and mask, at the picture's size.
        image_linear: the picture, linear, premultiplied.
        frame: how it sits in the network's square.
    """
    maps = intrinsics.require("albedo", "metallic", "specular", "diffuse", "mask")
    mask, albedo = maps.pop("mask"), maps["albedo"]
    inside = frame.enter(mask)
    if not (inside > 0).any():
        return intrinsics
    small, picture = frame.enter_map(albedo, mask), divide(frame.enter(image_linear), inside)
    change = frame.leave_map(flattened(small, np.clip(picture, 0, 1), inside) - small, mask)
    flat = by_rows(_changed, albedo, change)
    gain = by_rows(_gain, flat, mask, *(maps[name] for name in MAPS_OF_GAIN))
    light = {name: by_rows(np.multiply, maps[name], gain) for name in ("specular", "diffuse")}
    return intrinsics.replace(albedo=flat, **light)


def _changed(albedo: Float[np.ndarray, "h w 3"], change: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.clip(albedo + change, 0, 1)


def _gain(
    flat: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], *maps: Float[np.ndarray, "h w _"]
) -> Float[np.ndarray, "h w 3"]:
    """k of s and d for an albedo that became `flat`; `maps`: those of `MAPS_OF_GAIN`. 1 outside the mask."""
    known = dict(zip(MAPS_OF_GAIN, maps, strict=True))
    before, after = composite(**known), composite(**known | {"albedo": flat})
    return np.where(mask > 0, np.clip((before + FLOOR) / (after + FLOOR), 1 / MAX_GAIN, MAX_GAIN), 1)


def flattened(
    albedo: Float[np.ndarray, "s s 3"], picture: Float[np.ndarray, "s s 3"], mask: Float[np.ndarray, "s s 1"]
) -> Float[np.ndarray, "s s 3"]:
    """The albedo, even between its edges where the picture's colours are even; linear, 0 outside the mask.

    Args:
        albedo: linear, [0, 1].
        picture: linear, [0, 1], not premultiplied.
        mask: coverage, somewhere above 0. Outside it the nearest pixel of the object stands in, so that its outline is
            no edge.
    """
    covered = mask[..., 0] >= mask.max() / 2
    row, column = np.asarray(distance_transform_edt(~covered, return_distances=False, return_indices=True))
    display = srgb_encode(albedo)[row, column]
    even = denoise_tv_chambolle(display, WEIGHT * len(mask), eps=TOLERANCE, max_num_iter=ITERATIONS, channel_axis=-1)
    kept = patterned(srgb_encode(picture)[row, column], NEIGHBOURHOOD * len(mask))
    flat = np.clip(even + kept * (display - even), 0, 1).astype(np.float32)
    return np.where(mask > 0, srgb_decode(flat), 0).astype(np.float32)


def patterned(display: Float[np.ndarray, "s s 3"], radius: float) -> Float[np.ndarray, "s s 1"]:
    """How much of the detail is paint, [0, 1]: v^2 / (v^2 + c^2).

    Args:
        display: the picture, display values.
        radius: standard deviation of the neighbourhood, pixels.
    """
    level = display.mean(axis=-1, keepdims=True)
    chroma = (display - level) / (level + DARK)
    mean, square = (gaussian_filter(x, (radius, radius, 0)) for x in (chroma, np.square(chroma)))
    variance = np.maximum(square - np.square(mean), 0).sum(axis=-1, keepdims=True)
    return gaussian_filter(variance / (variance + CHROMA**2), (radius, radius, 0))
