"""The light that a surface receives from an environment, in closed form: d and s without shadows.

Both follow from normals, roughness and the map alone (`unirender.lighting` fixes its grid); what the ground truth
renders has shadows besides.

Notation: n normal, v view direction, l light direction, h half vector, alpha = roughness^2.
"""

import functools
import math

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.lighting import environment_directions, resample_environment, sample_environment, texel_solid_angles

QUADRATURE_SHAPE = (32, 64)  # resolution at which wide lobes are integrated
SHARP_ROUGHNESS = 0.35  # below it a lobe is narrower than a quadrature texel: lobe samples with filtered lookups
LOBE_SAMPLES = 64
MIN_ALPHA = 1e-3  # as Mitsuba's principled BSDF
_CHUNK = 1 << 21  # evaluations at a time


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

    Wide lobes are integrated over the map's texels; lobes of roughness below `SHARP_ROUGHNESS` are sampled (visible
    normals, a fixed low-discrepancy set) and looked up in a mip pyramid at the footprint of a sample.

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
    sharp = facing & (roughness_map < SHARP_ROUGHNESS)
    wide = facing & ~sharp
    out = np.zeros((height, width, 3), dtype=np.float32)
    alpha = np.maximum(np.square(roughness_map), MIN_ALPHA)
    if wide.any():
        n = _facing_normal(normal[wide], view[wide])
        out[wide] = _specular_quadrature(n, view[wide], alpha[wide], environment)
    if sharp.any():
        n = _facing_normal(normal[sharp], view[sharp])
        out[sharp] = _specular_samples(n, view[sharp], alpha[sharp], environment)
    return out


def _chunks(pixels: int, per_pixel: int) -> list[slice]:
    step = max(1, _CHUNK // per_pixel)
    return [slice(i, min(i + step, pixels)) for i in range(0, pixels, step)]


def _quadrature(environment: Float[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Directions `[m 3]` and radiance times solid angle `[m 3]`."""
    shape = QUADRATURE_SHAPE
    if environment.shape[:2] != shape:
        environment = resample_environment(environment, shape)
    radiance = environment * texel_solid_angles(*shape)[..., None]
    return environment_directions(*shape).reshape(-1, 3), radiance.reshape(-1, 3)


def _facing_normal(n: Float[np.ndarray, "p 3"], v: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Shading normals that point away from the viewer are bent to graze the view ray (predicted maps have them)."""
    cosine = np.sum(n * v, axis=-1, keepdims=True)
    bent = n + np.maximum(1e-2 - cosine, 0) * v
    return bent / np.linalg.norm(bent, axis=-1, keepdims=True)


def _smith_g1(cosine: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    squared = np.square(cosine)
    return 2 / (1 + np.sqrt(1 + np.square(alpha) * (1 - squared) / np.maximum(squared, 1e-8)))


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
        weight = ggx * _smith_g1(n_v, alpha[part][:, None]) * _smith_g1(n_l_up, alpha[part][:, None]) / (4 * n_v)
        out[part] = np.where(n_l > 0, weight, 0).astype(np.float32) @ radiance
    return out


def _specular_samples(
    n: Float[np.ndarray, "p 3"],
    v: Float[np.ndarray, "p 3"],
    alpha: Float[np.ndarray, " p"],
    environment: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "p 3"]:
    """Visible-normal sampling (Heitz 2018) with filtered lookups (Krivanek & Colbert 2008)."""
    pyramid = _mip_pyramid(environment)
    texel = 4 * np.pi / (environment.shape[0] * environment.shape[1])
    out = np.empty((len(n), 3), dtype=np.float32)
    u1, u2 = _hammersley(LOBE_SAMPLES)
    for part in _chunks(len(n), LOBE_SAMPLES * 8):
        a, frame = alpha[part][:, None], _frames(n[part])
        view = np.einsum("pij,pj->pi", frame, v[part])
        stretched = np.stack([a[:, 0] * view[:, 0], a[:, 0] * view[:, 1], view[:, 2]], axis=-1)
        stretched /= np.linalg.norm(stretched, axis=-1, keepdims=True)
        basis = _visible_disc(stretched)
        radius, angle = np.sqrt(u1), 2 * np.pi * u2
        t1 = np.broadcast_to(radius * np.cos(angle), (len(a), LOBE_SAMPLES))
        blend = (0.5 * (1 + stretched[:, 2]))[:, None]
        t2 = (1 - blend) * np.sqrt(np.maximum(1 - t1**2, 0)) + blend * (radius * np.sin(angle))
        t3 = np.sqrt(np.maximum(1 - t1**2 - t2**2, 0))
        h = np.einsum("psk,pki->psi", np.stack([t1, t2, t3], axis=-1), basis)
        h = np.concatenate([a[..., None] * h[..., :2], np.maximum(h[..., 2:], 1e-6)], axis=-1)
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        v_h = np.sum(h * view[:, None], axis=-1)
        light = 2 * v_h[..., None] * h - view[:, None]
        n_l, n_v = light[..., 2], np.maximum(view[:, 2:3], 1e-4)
        a2 = np.square(a)
        ggx = a2 / (np.pi * np.square(np.square(h[..., 2]) * (a2 - 1) + 1))
        pdf = ggx * _smith_g1(n_v, a) / (4 * n_v)
        level = 0.5 * np.log2(np.maximum(1 / (LOBE_SAMPLES * np.maximum(pdf, 1e-9)) / texel, 1.0))
        weight = np.where(n_l > 0, _smith_g1(np.maximum(n_l, 1e-4), a), 0)
        world = np.einsum("psi,pij->psj", light, frame)
        radiance = _sample_pyramid(pyramid, world.reshape(-1, 3), level.reshape(-1)).reshape(*weight.shape, 3)
        out[part] = np.mean(weight[..., None] * radiance, axis=1)
    return out


def _frames(z: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """Rotation matrices whose rows are x, y, z of a right-handed frame (Duff et al. 2017)."""
    sign = np.where(z[:, 2] >= 0, 1.0, -1.0)
    a = -1 / (sign + z[:, 2])
    b = z[:, 0] * z[:, 1] * a
    x = np.stack([1 + sign * np.square(z[:, 0]) * a, sign * b, -sign * z[:, 0]], axis=-1)
    y = np.stack([b, sign + np.square(z[:, 1]) * a, -z[:, 1]], axis=-1)
    return np.stack([x, y, z], axis=1)


def _visible_disc(v: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """Rows t1, t2, v of Heitz's frame around the stretched view direction; t1 lies in the surface."""
    t1 = np.stack([-v[:, 1], v[:, 0], np.zeros(len(v))], axis=-1)
    length = np.linalg.norm(t1, axis=-1, keepdims=True)
    t1 = np.where(length > 1e-6, t1 / np.maximum(length, 1e-6), np.array([1.0, 0.0, 0.0]))
    return np.stack([t1, np.cross(v, t1), v], axis=1)


@functools.lru_cache(maxsize=4)
def _hammersley(count: int) -> tuple[np.ndarray, np.ndarray]:
    bits = np.arange(count, dtype=np.uint64)
    reverse = np.zeros(count)
    scale = 0.5
    while bits.any():
        reverse += scale * (bits & 1)
        bits, scale = bits >> np.uint64(1), scale / 2
    return (np.arange(count) + 0.5) / count, reverse


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
