"""The light that a surface receives from an environment, in closed form: d and s without shadows.

    L(v) = integral of f(l, v) E(l) max(n . l, 0) dl                                   (Eq. 1)
    d = L of f = 1 / pi,    s = L of f the GGX lobe of a reflector of F = 1

with E the map: the paper's rendering equation, of two fixed surfaces.
Both follow from normals, roughness and the map alone (`light.environment` fixes its grid); what the ground truth
renders has shadows besides. `unirender bench derived-light` measures how near they come.

s is averaged over the pixel, as a renderer averages it: a curved surface reflects, within one, more than a sharp lobe
is wide. How the normal varies in there is taken from the pixels around it (`unirender.light.subpixel`); how lobes are
integrated is in `unirender.light.lobes`.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import RANGE_TOLERANCE, as_numbers, unit_normals
from unirender.light.ggx import facing_normal, halton, mirror_direction, unit
from unirender.light.lobes import TAIL_SHAPE, grid_lobes, sampled_cores, texels
from unirender.light.subpixel import MEAN_WEIGHTS, MIRRORED, Surroundings, inside
from unirender.vectors import nonzero

QUADRATURE_SHAPE = (32, 64)  # resolution at which d and wide lobes are integrated
SHARP_ROUGHNESS = 0.45  # below it a grazing lobe is too narrow for `QUADRATURE_SHAPE`: energy would be made of nothing
MIN_ALPHA = 1e-3  # as Mitsuba's principled BSDF
MOST_POINTS = 8  # of a pixel, at which a wide lobe or a tail is integrated
LOBE_STEP = 1.5  # times alpha: by so much (radians) the mirror direction may turn between two of these points
TAIL_STEP = 0.4  # the least for tails, which are as wide as the grid's texels
_CHUNK = 1 << 21  # evaluations at a time


def diffuse_light(
    normal: Float[np.ndarray, "h w 3"], environment: Float[np.ndarray, "eh ew 3"]
) -> Float[np.ndarray, "h w 3"]:
    """d without shadows: irradiance / pi at each normal, whose direction counts; 0 where the normal is 0."""
    normal = unit_normals(normal)
    directions, radiance = texels(environment, QUADRATURE_SHAPE)
    there = nonzero(normal)
    n = normal[there]
    out = np.zeros((*normal.shape[:-1], 3), dtype=np.float32)
    lit = np.empty((len(n), 3), dtype=np.float32)
    step = max(1, _CHUNK // len(radiance))
    cosines = np.empty((min(step, len(n)), len(radiance)), dtype=np.float32)  # one memory for all parts
    for part in (slice(i, i + step) for i in range(0, len(n), step)):
        cosine = np.matmul(n[part], directions, out=cosines[: len(n[part])])
        lit[part] = np.maximum(cosine, 0, out=cosine) @ radiance
    out[there] = lit / np.pi
    return out


def specular_light(
    normal: Float[np.ndarray, "h w 3"],
    roughness: Float[np.ndarray, "h w 1"] | float,
    environment: Float[np.ndarray, "eh ew 3"],
    camera: Camera | None = None,
    where: Bool[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """s without shadows: the GGX lobe of a reflector with F = 1, along the true view rays, averaged over the pixel.

    Args:
        normal: camera axes; its direction counts, and 0 gives 0.
        roughness: perceptual, [0, 1], a map or one number.
        environment: lat-long radiance, any resolution.
        camera: gives the view direction of each pixel; the contract's default if None.
        where: pixels to light, the others are 0; all if None.

    Raises:
        UnirenderError: roughness is out of range, normals are not finite, or an argument has another shape.
    """
    normal = unit_normals(normal)
    if normal.ndim != 3 or not np.isfinite(normal).all():
        raise UnirenderError(f"normal: got shape {normal.shape}, expected finite normals of one picture [h, w, 3]")
    height, width = normal.shape[:2]
    if where is not None and where.shape != (height, width):
        raise UnirenderError(f"where: got shape {where.shape}, expected {(height, width)}, the normals' size")
    view = (camera or Camera()).view_directions(height, width)
    there = nonzero(normal)
    lit = there if where is None else there & where
    rough = _checked_roughness(roughness, (height, width, 1))[lit, 0]
    surroundings = Surroundings(normal, there, lit)
    light = np.empty((len(rough), 3), dtype=np.float32)
    for part in surroundings.parts():
        around = np.concatenate([surroundings.of(part), surroundings.of_smooth(view, part)])
        light[part] = _pixel_light(around, rough[part], environment)
    out = np.zeros((height, width, 3), dtype=np.float32)
    out[lit] = light
    return out


def lobe_light(
    n: Float[np.ndarray, "p 3"],
    v: Float[np.ndarray, "p 3"],
    roughness: Float[np.ndarray, " p"] | float,
    environment: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "p 3"]:
    """The light that GGX lobes of F = 1 reflect at points, for any normals and view directions.

    Args:
        n: unit normals; those that point away from the viewer are bent to graze the view ray.
        v: unit directions towards the viewer.
        roughness: perceptual, [0, 1], of each point or one number.
        environment: lat-long radiance, any resolution.

    Raises:
        UnirenderError: as `specular_light`.
    """
    roughness = _checked_roughness(roughness, (len(n),))
    around = np.repeat(np.concatenate([n.T, v.T])[..., None].astype(np.float32), 9, axis=-1)
    return _pixel_light(around, roughness, environment)


def _checked_roughness(roughness: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    rough = as_numbers("roughness", roughness)
    rough = rough.reshape(()) if rough.size == 1 else rough
    if rough.ndim and rough.shape != shape:
        raise UnirenderError(f"roughness: got shape {rough.shape}, expected one number or {shape}")
    if not ((rough >= -RANGE_TOLERANCE) & (rough <= 1 + RANGE_TOLERANCE)).all():
        raise UnirenderError(f"roughness: got values in [{rough.min():.4g}, {rough.max():.4g}], expected [0, 1]")
    return np.broadcast_to(rough, shape)


def _pixel_light(
    around: Float[np.ndarray, "6 p 9"], roughness: Float[np.ndarray, " p"], environment: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "p 3"]:
    """Means over pixels, given the surroundings of each: normal and view direction.

    The points of a pixel whose mirror direction leads to the left are those of the others, seen in a mirror: a scene's
    mirror image has the mirrored light.
    """
    left = mirror_direction(around[:3, :, 4], around[3:, :, 4])[0] < 0
    around = np.where(left[:, None], around[..., MIRRORED], around)
    alpha = np.maximum(np.square(roughness), np.float32(MIN_ALPHA))
    sharp = roughness < SHARP_ROUGHNESS
    turn = _turn(around)
    points = turn.sum(axis=0) / np.maximum(LOBE_STEP * alpha, np.where(sharp, TAIL_STEP, 0))
    out = np.zeros((len(alpha), 3), dtype=np.float32)
    for these, tails in ((~sharp, False), (sharp, True)):
        # the next power of two, since pixels of equal count are done together
        count = 2 ** np.ceil(np.log2(np.clip(points, 1, MOST_POINTS))).astype(np.int64)
        for k in np.unique(count[these]):
            now = these & (count == k)
            out[now] = _at_points(around[:, now], alpha[now], int(k), environment, tails)
    if sharp.any():
        out[sharp] += sampled_cores(around[:, sharp], turn[:, sharp], left[sharp], alpha[sharp], environment)
    return out


def _at_points(
    around: Float[np.ndarray, "6 p 9"],
    alpha: Float[np.ndarray, " p"],
    count: int,
    environment: Float[np.ndarray, "h w 3"],
    tails: bool,
) -> Float[np.ndarray, "p 3"]:
    """Means over `count` points of each pixel; a single one has the pixel's mean normal."""
    x, y = halton(count)[:2]
    if count == 1:
        vectors = (around @ MEAN_WEIGHTS)[..., None]
    else:
        vectors = inside(around, x - np.float32(0.5), y + np.float32(0.5 / count - 0.5))
    v = unit(vectors[3:].reshape(3, -1))
    n = facing_normal(unit(vectors[:3].reshape(3, -1)), v)
    shape = TAIL_SHAPE if tails else QUADRATURE_SHAPE
    return grid_lobes(n, v, np.repeat(alpha, count), environment, shape, tails).reshape(-1, count, 3).mean(axis=1)


def _turn(around: Float[np.ndarray, "6 p 9"]) -> Float[np.ndarray, "2 p"]:
    """By how much (radians) the mirror direction turns over a pixel's width and height."""
    half, zero = np.float32(0.5), np.float32(0)
    ends = inside(around, np.array([-half, half, zero, zero]), np.array([zero, zero, -half, half]))
    mirrored = mirror_direction(unit(ends[:3]), unit(ends[3:]))
    return np.stack([np.linalg.norm(mirrored[..., i + 1] - mirrored[..., i], axis=0) for i in (0, 2)])
