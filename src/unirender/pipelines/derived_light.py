"""s and d of a surface under a known light, at a cost that does not grow with the picture.

A lobe costs up to 0.1 ms a pixel, and light varies far more slowly over a surface than its colour does. Pictures whose
longer side exceeds `LIGHT_SIDE` are therefore lit at that size and the light is interpolated. It is derived at the
picture's own size

- where the surface has detail that the small size does not show: its normal or roughness is not the interpolated one;
- for s, on request, where a reflection is sharper than the small size shows: roughness below `MIRROR_ROUGHNESS`, under
  a light of more than `COARSE_ROWS` rows. It is worth its time for maps that somebody made, not for predicted ones: the
  normals of a small model have no such sharpness.
"""

import logging
from collections.abc import Callable, Collection

import numpy as np
from jaxtyping import Bool, Float

from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light, specular_light
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import unit_normal
from unirender.pipelines.shadowed_light import visible_shares
from unirender.vectors import lengths, nonzero

LIGHT_SIDE = 256  # pixels along the longer side up to which every pixel is lit by itself
NORMAL_DETAIL = 0.03  # distance of unit vectors, 1.7 degrees
ROUGHNESS_DETAIL = 0.02
MIRROR_ROUGHNESS = 0.15  # a lobe of 3 degrees; over a ball that fills `LIGHT_SIDE`, reflections step by 1 degree
COARSE_ROWS = 64  # texels of 3 degrees: no reflection of them is sharper
MANY_PIXELS = 500_000  # lit one by one they take about a minute

logger = logging.getLogger(__name__)

Light = Callable[[Intrinsics, Bool[np.ndarray, "h w"] | None], Float[np.ndarray, "h w 3"]]  # of pixels, None: all


def derived_diffuse(intrinsics: Intrinsics, environment: Float[np.ndarray, "eh ew 3"]) -> Float[np.ndarray, "h w 3"]:
    """d without shadows; 0 where the normal is 0.

    Args:
        intrinsics: with normal and mask.
        environment: lat-long radiance in camera axes, any resolution.
    """
    surface = Intrinsics(**intrinsics.require("normal", "mask"), camera=intrinsics.camera).with_unit_normals()

    def light(surface: Intrinsics, where: Bool[np.ndarray, "h w"] | None) -> Float[np.ndarray, "h w 3"]:
        normal = surface.require("normal")["normal"]
        return diffuse_light(normal if where is None else normal * where[..., None], environment)

    return _lit(surface, light)


def derived_specular(
    intrinsics: Intrinsics, environment: Float[np.ndarray, "eh ew 3"], mirrors: bool = True
) -> Float[np.ndarray, "h w 3"]:
    """s without shadows; 0 where the normal is 0.

    Args:
        intrinsics: with normal, roughness and mask; the camera gives the view directions.
        environment: lat-long radiance in camera axes, any resolution.
        mirrors: whether sharp reflections are derived at the picture's own size.
    """
    maps = intrinsics.require("normal", "roughness", "mask")
    surface = Intrinsics(**maps, camera=intrinsics.camera).with_unit_normals()

    def light(surface: Intrinsics, where: Bool[np.ndarray, "h w"] | None) -> Float[np.ndarray, "h w 3"]:
        maps = surface.require("normal", "roughness")
        return specular_light(maps["normal"], maps["roughness"], environment, surface.camera, where)

    sharp = (maps["roughness"][..., 0] < MIRROR_ROUGHNESS) & (mirrors and environment.shape[0] > COARSE_ROWS)
    return _lit(surface, light, sharp)


def derived_light(
    intrinsics: Intrinsics,
    environment: Float[np.ndarray, "eh ew 3"],
    names: Collection[str],
    *,
    mirrors: bool = True,
    shadows: bool = True,
) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """s and d by name.

    Args:
        intrinsics: with normal, roughness and mask; the camera gives the view directions.
        environment: lat-long radiance in camera axes, any resolution.
        names: of specular and diffuse, those that are wanted.
        mirrors: as for `derived_specular`.
        shadows: whether the picture's own surfaces hide the light (`unirender.pipelines.shadowed_light`).
    """
    light = {}
    if "specular" in names:
        light["specular"] = derived_specular(intrinsics, environment, mirrors)
    if "diffuse" in names:
        light["diffuse"] = derived_diffuse(intrinsics, environment)
    if not shadows or not light:
        return light
    shares = visible_shares(intrinsics, environment, light)
    return {name: value * shares[name] for name, value in light.items()}


def _lit(surface: Intrinsics, light: Light, sharp: Bool[np.ndarray, "h w"] | bool = False) -> np.ndarray:
    """`light` of a surface `[h w 3]`; `sharp`: pixels whose light the small size does not show."""
    if max(surface.height, surface.width) <= LIGHT_SIDE:
        return light(surface, None)
    normal, mask = surface.require("normal", "mask").values()
    frame = Frame.reduced(mask, LIGHT_SIDE)
    small = frame.enter_intrinsics(surface)
    maps = dict(frame.leave_maps({name: value for name, value in small.maps.items() if name != "mask"}, mask))
    distance = lengths(unit_normal(maps["normal"]) - normal)[..., 0]
    exact = sharp | (distance > NORMAL_DETAIL)
    if surface.roughness is not None:
        exact |= (np.abs(maps["roughness"] - surface.roughness) > ROUGHNESS_DETAIL)[..., 0]
    seen = (mask[..., 0] > 0) & nonzero(normal)
    exact &= seen
    interpolated = np.where(seen[..., None], frame.leave_map(light(small, None), mask), 0)
    if not exact.any():
        return interpolated
    if (count := int(exact.sum())) > MANY_PIXELS:
        logger.warning("the light of %d pixels with fine detail is derived one by one, which takes minutes", count)
    return np.where(exact[..., None], light(surface, exact), interpolated)
