"""The light that a surface receives from an environment, in closed form: d and s without shadows.

Both follow from normals, roughness and the map alone (`unirender.lighting` fixes its grid); what the ground truth
renders has shadows besides. `unirender bench derived-light` measures how near they come.

Notation: n normal, v view direction, l light direction, h half vector, alpha = roughness^2, D the GGX distribution of
normals, G1 Smith's shadowing; p = D G1(v) / (4 n.v) the density of l when visible normals are sampled.

A lobe is integrated in one of two ways. Over the *grid* of the map's texels: exact where the lobe is wider than a few
of them. By *samples* of the lobe: exact where it is narrow. Wide lobes take the first alone; sharp ones both, each
direction shared out by the power heuristic between p and the density of the grid (Veach and Guibas 1995), so that the
samples have the core of the lobe and the grid its tail, where samples are few and a small sun falls between them.
"""

import math

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender.ggx import facing_normal, frames, halton, smith_g1, unit, visible_normals
from unirender.lighting import environment_directions, resample_environment, sample_environment, texel_solid_angles

QUADRATURE_SHAPE = (32, 64)  # resolution at which wide lobes are integrated
TAIL_SHAPE = (64, 128)  # and the tails of sharp ones
SHARP_ROUGHNESS = 0.35  # below it a lobe is too narrow for `QUADRATURE_SHAPE`
LOBE_SAMPLES = 48
GRID_SHARE = 0.03  # samples take over where p times the solid angle of a texel exceeds this
EDGE = 0.5  # distance of two unit vectors, 29 degrees: neighbours that differ by more are of different surfaces
MIN_ALPHA = 1e-3  # as Mitsuba's principled BSDF
_CHUNK = 1 << 21  # evaluations at a time
_CACHED_CHUNK = 1 << 17  # the same where many passes go over them: they stay in the processor's cache


def diffuse_light(
    normal: Float[np.ndarray, "h w 3"], environment: Float[np.ndarray, "eh ew 3"]
) -> Float[np.ndarray, "h w 3"]:
    """d without shadows: irradiance / pi at each normal; 0 where the normal is 0."""
    directions, radiance = _quadrature(environment)
    inside = np.any(normal != 0, axis=-1)
    n = normal[inside]
    out = np.zeros((*normal.shape[:-1], 3), dtype=np.float32)
    lit = np.empty((len(n), 3), dtype=np.float32)
    for part in _chunks(len(n), len(directions)):
        lit[part] = np.maximum(n[part] @ directions.T, 0) @ radiance
    out[inside] = lit / np.pi
    return out


def specular_light(
    normal: Float[np.ndarray, "h w 3"],
    roughness: Float[np.ndarray, "h w 1"] | float,
    environment: Float[np.ndarray, "eh ew 3"],
    camera: Camera | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """s without shadows: the GGX lobe of a reflector with F = 1, along the true view rays of the camera.

    A sharp lobe is averaged over the pixel: a curved surface reflects, within one, more than the lobe is wide. How
    normals vary inside a pixel is taken from its neighbours.

    Args:
        normal: camera axes, unit; 0 gives 0.
        roughness: perceptual, [0, 1], a map or one number.
        environment: lat-long radiance, any resolution.
        camera: gives the view direction of each pixel; the contract's default if None.
    """
    height, width = normal.shape[:2]
    view = (camera or Camera()).view_directions(height, width)
    roughness_map = np.broadcast_to(np.asarray(roughness, dtype=np.float32), (height, width, 1))[..., 0]
    facing = np.any(normal != 0, axis=-1)
    steps = [_steps(normal, facing, axis) for axis in (1, 0)]
    view_steps = [_steps(view, np.ones_like(facing), axis) for axis in (1, 0)]
    footprint = np.stack([np.stack(steps, axis=-2), np.stack(view_steps, axis=-2)], axis=-3)[facing]
    out = np.zeros((height, width, 3), dtype=np.float32)
    out[facing] = lobe_light(normal[facing], view[facing], roughness_map[facing], environment, footprint)
    return out


def lobe_light(
    n: Float[np.ndarray, "p 3"],
    v: Float[np.ndarray, "p 3"],
    roughness: Float[np.ndarray, " p"],
    environment: Float[np.ndarray, "h w 3"],
    footprint: Float[np.ndarray, "p 2 2 3"] | None = None,
) -> Float[np.ndarray, "p 3"]:
    """The light that GGX lobes of F = 1 reflect, for any normals and view directions.

    Args:
        n: unit normals; those that point away from the viewer are bent to graze the view ray.
        v: unit directions towards the viewer.
        roughness: perceptual, [0, 1].
        environment: lat-long radiance, any resolution.
        footprint: change of (normal, view) over a pixel's width and height, over which sharp lobes are averaged; None:
            points.
    """
    alpha = np.maximum(np.square(roughness), MIN_ALPHA)
    sharp = roughness < SHARP_ROUGHNESS
    out = np.zeros((len(n), 3), dtype=np.float32)
    if not sharp.all():
        wide = ~sharp
        out[wide] = _specular_quadrature(facing_normal(n[wide], v[wide]), v[wide], alpha[wide], environment)
    if sharp.any():
        over = np.zeros((len(n), 2, 2, 3), dtype=np.float32) if footprint is None else footprint
        n, v, alpha = n[sharp], v[sharp], alpha[sharp]
        out[sharp] = _tails(facing_normal(n, v), v, alpha, environment)
        out[sharp] += _cores(n, v, alpha, over[sharp], environment)
    return out


def _chunks(pixels: int, per_pixel: int) -> list[slice]:
    step = max(1, _CHUNK // per_pixel)
    return [slice(i, min(i + step, pixels)) for i in range(0, pixels, step)]


def _quadrature(
    environment: Float[np.ndarray, "h w 3"], shape: tuple[int, int] = QUADRATURE_SHAPE
) -> tuple[np.ndarray, np.ndarray]:
    """Directions `[m 3]` and radiance times solid angle `[m 3]`."""
    if environment.shape[:2] != shape:
        environment = resample_environment(environment, shape)
    radiance = environment * texel_solid_angles(*shape)[..., None]
    return environment_directions(*shape).reshape(-1, 3), radiance.reshape(-1, 3)


def _steps(
    vectors: Float[np.ndarray, "h w 3"], there: Bool[np.ndarray, "h w"], axis: int
) -> Float[np.ndarray, "h w 3"]:
    """Change of unit vectors over a pixel's width (axis 1) or height (axis 0).

    The smaller of the differences to the two neighbours, since the larger one may lead across an edge; 0 where neither
    is there, or both are beyond one.
    """
    onward = np.roll(vectors, -1, axis) - vectors
    size = np.where(there & np.roll(there, -1, axis), np.linalg.norm(onward, axis=-1), np.inf)
    size[(slice(None), -1) if axis else -1] = np.inf  # the frame ends here
    back, back_size = np.roll(onward, 1, axis), np.roll(size, 1, axis)
    nearer = np.where((size < back_size)[..., None], onward, back)
    return np.where((np.minimum(size, back_size) < EDGE)[..., None], nearer, 0).astype(np.float32)


def _specular_quadrature(
    n: Float[np.ndarray, "p 3"],
    v: Float[np.ndarray, "p 3"],
    alpha: Float[np.ndarray, " p"],
    environment: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "p 3"]:
    directions, radiance = _quadrature(environment)
    out = np.empty((len(n), 3), dtype=np.float32)
    for part in _chunks(len(n), len(directions)):
        a2 = np.square(alpha[part])[:, None]
        n_l, v_l = n[part] @ directions.T, v[part] @ directions.T
        n_v = np.maximum(np.sum(n[part] * v[part], axis=-1, keepdims=True), 1e-4)
        # h = (v + l) / |v + l|, so n.h follows from the three cosines
        n_h2 = np.square(n_l + n_v) / np.maximum(2 + 2 * v_l, 1e-6)
        ggx = a2 / (np.pi * np.square(n_h2 * (a2 - 1) + 1))
        n_l_up = np.maximum(n_l, 1e-4)
        # f cos = D G1(v) G1(l) / (4 n.v)
        weight = ggx * smith_g1(n_v, alpha[part][:, None]) * smith_g1(n_l_up, alpha[part][:, None]) / (4 * n_v)
        out[part] = np.where(n_l > 0, weight, 0).astype(np.float32) @ radiance
    return out


def _grid_solid_angle() -> float:
    """Mean solid angle of a texel of `TAIL_SHAPE` at the equator, over `GRID_SHARE`: 1 / the density of the grid."""
    return 2 * math.pi**2 / ((TAIL_SHAPE[0] - 1) * TAIL_SHAPE[1]) / GRID_SHARE


def _tails(
    n: Float[np.ndarray, "p 3"],
    v: Float[np.ndarray, "p 3"],
    alpha: Float[np.ndarray, " p"],
    environment: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "p 3"]:
    """The grid's share of sharp lobes: f cos / (1 + (p / q)^2) over all texels, q the density of the grid."""
    directions, radiance = _quadrature(environment, TAIL_SHAPE)
    out = np.empty((len(n), 3), dtype=np.float32)
    step = max(1, _CACHED_CHUNK // len(directions))
    for part in (slice(i, i + step) for i in range(0, len(n), step)):
        a = alpha[part][:, None]
        a2 = np.square(a)
        n_v = np.maximum(np.sum(n[part] * v[part], axis=-1, keepdims=True), np.float32(1e-4))
        n_l = n[part] @ directions.T
        # p = D G1(v) / (4 n.v), with (n.h)^2 from the three cosines as in `_specular_quadrature`; in place, for speed
        p = np.square(n_l + n_v)
        p /= np.maximum(2 + 2 * (v[part] @ directions.T), np.float32(1e-6))
        p *= a2 - 1
        p += 1
        np.divide(a2 * smith_g1(n_v, a) / (4 * np.pi * n_v), np.square(p, out=p), out=p)
        weight = p * smith_g1(np.maximum(n_l, np.float32(1e-4)), a)
        p *= np.float32(_grid_solid_angle())
        weight /= 1 + np.square(p, out=p)
        weight[n_l <= 0] = 0
        out[part] = weight @ radiance
    return out


def _cores(
    n: Float[np.ndarray, "p 3"],
    v: Float[np.ndarray, "p 3"],
    alpha: Float[np.ndarray, " p"],
    footprint: Float[np.ndarray, "p 2 2 3"],
    environment: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "p 3"]:
    """The samples' share of sharp lobes: visible normals (Heitz 2018) at points spread over the pixel.

    Each sample reads the mip level of its own solid angle (Krivanek and Colbert 2008): that of its share of the lobe,
    widened by what the pixel's curvature adds.
    """
    pyramid = _mip_pyramid(environment)
    texel = 4 * np.pi / (environment.shape[0] * environment.shape[1])
    out = np.empty((len(n), 3), dtype=np.float32)
    across = _reflected_width(n, v, footprint)
    u1, u2, *offset = halton(LOBE_SAMPLES)
    offset = np.stack(offset, axis=-1) - np.float32(0.5)
    step = max(1, _CACHED_CHUNK // (4 * LOBE_SAMPLES))
    for part in (slice(i, i + step) for i in range(0, len(n), step)):
        spread = np.einsum("so,pkoc->kpsc", offset, footprint[part])
        normal, view = (unit((x[part][:, None] + d).reshape(-1, 3)) for x, d in zip((n, v), spread, strict=True))
        frame = frames(facing_normal(normal, view))
        view = np.einsum("pij,pj->pi", frame, view)
        a = np.repeat(alpha[part], LOBE_SAMPLES)
        h = visible_normals(view, a, np.tile(u1, len(spread[0])), np.tile(u2, len(spread[0])))
        light = 2 * np.sum(h * view, axis=-1, keepdims=True) * h - view
        n_l, n_v = light[:, 2], np.maximum(view[:, 2], np.float32(1e-4))
        # 1 - (n.h)^2 by the tangent components: the difference would be lost in float32
        slope = np.square(h[:, 0]) + np.square(h[:, 1]) + np.square(a * h[:, 2])
        p = np.square(a / slope) * smith_g1(n_v, a) / (4 * np.pi * n_v)
        side = np.sqrt(1 / np.maximum(p, np.float32(1e-9))).reshape(-1, LOBE_SAMPLES, 1) + across[part][:, None]
        level = 0.5 * np.log2(np.maximum(np.prod(side, axis=-1) / (LOBE_SAMPLES * texel), 1.0)).reshape(-1)
        share = np.square(p * np.float32(_grid_solid_angle()))
        weight = np.where(n_l > 0, smith_g1(np.maximum(n_l, np.float32(1e-4)), a), 0) * share / (1 + share)
        radiance = _sample_pyramid(pyramid, np.einsum("pi,pij->pj", light, frame), level)
        out[part] = np.mean((weight[:, None] * radiance).reshape(-1, LOBE_SAMPLES, 3), axis=1)
    return out


def _reflected_width(
    n: Float[np.ndarray, "p 3"], v: Float[np.ndarray, "p 3"], footprint: Float[np.ndarray, "p 2 2 3"]
) -> Float[np.ndarray, "p 2"]:
    """By how much (radians) the mirror direction turns over a pixel's width and height."""
    n, v, n_step, v_step = n[:, None], v[:, None], footprint[:, 0], footprint[:, 1]
    cosine = np.sum(n * v, axis=-1, keepdims=True)
    cosine_step = np.sum(n_step * v + n * v_step, axis=-1, keepdims=True)
    return np.linalg.norm(2 * (cosine_step * n + cosine * n_step) - v_step, axis=-1)


def _mip_pyramid(environment: Float[np.ndarray, "h w 3"]) -> list[np.ndarray]:
    levels = [environment]
    while min(levels[-1].shape[:2]) >= 8:
        h, w = levels[-1].shape[:2]
        levels.append(resample_environment(levels[-1], (max(math.ceil(h / 2), 2), max(math.ceil(w / 2), 2))))
    return levels


def _sample_pyramid(
    pyramid: list[np.ndarray], directions: Float[np.ndarray, "n 3"], level: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    level = np.clip(level, 0, len(pyramid) - 1)
    base = np.minimum(np.floor(level).astype(np.int64), len(pyramid) - 1)
    fraction = (level - base)[:, None]
    out = np.zeros((len(directions), 3), dtype=np.float32)
    for i, image in enumerate(pyramid):
        lower, upper = base == i, (base == i - 1) & (fraction[:, 0] > 0)
        if lower.any():
            out[lower] += (1 - fraction[lower]) * sample_environment(image, directions[lower])
        if upper.any():
            out[upper] += fraction[upper] * sample_environment(image, directions[upper])
    return out
