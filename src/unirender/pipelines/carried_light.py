"""What a decomposition's s and d have beyond the light that they reveal, carried over to another light.

Under another light, s and d are derived from the predicted normals and roughness alone. The decomposition's own s and d
have more: shadows, what surfaces reflect onto one another, shape that the normals miss. All of it is in the ratio of
them to what the same normals receive from the decomposition's own light. A part of it belongs to that light, so that it
is carried over as far as the two lights do the same to the object: for d, and for s alike,

    d_1 = D(L_1) exp(r K log clip((d_0 + e) / (D(L_0) + e), 1/3, 3)),    r = max(corr(log D(L_1), log D(L_0)), 0)

D is what normals receive of a light without shadows (or with, where d_1 has them), and corr is taken over the object
and the channels, each about its own mean. K is a smoothing, the wider the less the lights agree: fine detail of the
ratio is what `unirender.pipelines.closure` put there, and holds for its own light alone. Under its own light an object
gets its own s and d back; under one that has nothing to do with it, nothing is carried.
"""

import math
from collections.abc import Collection
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from unirender.blocks import by_rows
from unirender.intrinsics import Intrinsics
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.remembered import MapsKey, remembered
from unirender.pipelines.revealed_light import agreeing_light

MOST_RATIO = 3.0  # either way
FLOOR = 0.02  # radiance added to both sides of each ratio: e
EVEN = 0.05  # spread of log light over the object that all lights are taken to share: two even ones agree
SMOOTHING = 0.13  # standard deviation of K where lights do not agree, of the side of a square as large as the object


def with_carried_light(
    before: Intrinsics,
    after: Intrinsics,
    names: Collection[str],
    light: Float[np.ndarray, "eh ew 3"] | None = None,
    *,
    shadows: bool = False,
) -> Intrinsics:
    """The maps under another light, with what their own s and d have beyond their own light; where that light, s or d
    is unknown, as they are.

    Args:
        before: with normal, roughness and mask.
        after: the same maps, with s and d derived from another environment.
        names: of specular and diffuse, those that were derived.
        light: that agrees with s and d of `before`, L_0; None: found from them and from its environment.
        shadows: whether they were derived with the shadows that the picture's own surfaces cast.

    Raises:
        UnirenderError: normal, roughness or mask is missing.
    """
    known = set(before.present)
    names = [name for name in names if name in known]
    if not names or (light is None and not known.issuperset(("specular", "diffuse", "environment"))):
        return after
    old, mask = before.require(*names), before.require("mask")["mask"]
    new = after.require(*names)
    surface = Intrinsics(
        **before.require("normal", "roughness", "mask"),
        environment=agreeing_light(before) if light is None else light,
        camera=before.camera,
    )
    explained = _explained(MapsKey(surface), tuple(names), shadows)
    return after.replace(**{name: _carried(old[name], new[name], explained[name], mask) for name in names})


def _carried(
    old: Float[np.ndarray, "h w 3"],
    new: Float[np.ndarray, "h w 3"],
    explained: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
) -> Float[np.ndarray, "h w 3"]:
    """d_1 of d_0, D(L_1) and D(L_0)."""
    trust = agreement(new, explained, mask)
    sigma = SMOOTHING * (1 - trust) * math.sqrt(mask.sum())
    smooth = _smoothed(by_rows(_bounded_log_ratio, old, explained), mask, sigma)
    return by_rows(partial(_scaled, trust), new, smooth)


def _bounded_log_ratio(
    light: Float[np.ndarray, "h w 3"], explained: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    log_ratio = np.log((light + FLOOR) / (explained + FLOOR))
    return np.clip(log_ratio, -math.log(MOST_RATIO), math.log(MOST_RATIO))


def _scaled(
    trust: float, light: Float[np.ndarray, "h w 3"], log_ratio: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    return (light * np.exp(trust * log_ratio)).astype(np.float32)


@remembered(most=1)
def _explained(surface: MapsKey, names: tuple[str, ...], shadows: bool) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """D(L_0), of the last picture: one is mostly put under several lights."""
    light = surface.intrinsics.require("environment")["environment"]
    return derived_light(surface.intrinsics, light, names, mirrors=False, shadows=shadows)


def agreement(
    one: Float[np.ndarray, "h w 3"], other: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]
) -> float:
    """r: how far two lights do the same to an object, in [0, 1].

    Args:
        one: s or d under the first light.
        other: the same under the second; an own factor for each channel makes no difference.
        mask: coverage.
    """
    if not mask.any():
        return 0.0
    first, second = (_log_about_mean(light, mask) for light in (one, other))

    def product(a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"]) -> float:
        weighted = mask * a
        weighted *= b
        return float(weighted.sum(dtype=np.float64) / (3 * mask.sum(dtype=np.float64))) + EVEN**2

    alike = product(first, second) / math.sqrt(product(first, first) * product(second, second))
    return min(max(alike, 0.0), 1.0)


def _log_about_mean(light: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    """log(light + e), each channel about its mean over the mask."""
    log = by_rows(_log, light)
    mean = np.average(log, axis=(0, 1), weights=np.broadcast_to(mask, log.shape))
    return np.subtract(log, mean, out=log)


def _log(light: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.log(light + FLOOR)


def _smoothed(
    values: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], sigma: float
) -> Float[np.ndarray, "h w 3"]:
    """The values, averaged over the object alone: twice over a square, which has the standard deviation `sigma`."""
    side = 1 + 2 * round((math.sqrt(6 * sigma**2 + 1) - 1) / 2)  # odd, so that nothing moves
    if side <= 1:
        return values
    weighted = by_rows(_with_weight, values, mask)
    for axis in (0, 1, 0, 1):
        uniform_filter1d(weighted, side, axis=axis, mode="constant", output=weighted)
    return by_rows(_weighted_mean, weighted, mask)


def _with_weight(values: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 4"]:
    return np.concatenate([values * mask, mask], axis=-1).astype(np.float32)


def _weighted_mean(
    weighted: Float[np.ndarray, "h w 4"], mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 3"]:
    return np.where(mask > 0, weighted[..., :3] / np.maximum(weighted[..., 3:], 1e-6), 0)
