"""GGX lobes of F = 1 integrated against an environment.

Notation: n normal, v view direction, l light direction, h half vector, alpha = roughness^2, D the GGX distribution of
normals, G1 Smith's shadowing; p = D G1(v) / (4 n.v) the density of l when visible normals are sampled, and
f cos = p G1(l). Arrays have the component of a vector first.

A lobe is integrated in one of two ways. Over the *grid* of the map's texels: exact where the lobe is wider than a few
of them. By *samples* of the lobe: exact where it is narrow. Wide lobes take the first alone; sharp ones both, each
direction shared out by the power heuristic between p and the density of the grid (Veach and Guibas 1995), so that the
samples have the core of the lobe and the grid its tail, where samples are few and a small sun falls between them.
"""

import functools
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender.light.environment import check_map, environment_directions, texel_solid_angles
from unirender.light.ggx import dot, facing_normal, halton, smith_g1, tangents, unit, visible_normals
from unirender.light.resampling import resample_environment
from unirender.light.subpixel import inside

TAIL_SHAPE = (64, 128)  # texels over which the tails of sharp lobes are integrated
GRID_DENSITY = 0.03 * (TAIL_SHAPE[0] - 1) * TAIL_SHAPE[1] / (2 * math.pi**2)  # q: 0.03 a texel at the equator
LOBE_SAMPLES = 64
LOBE_WIDTH = 4 * 0.6436  # radians by alpha: where D has fallen to half, to both sides; a reflection turns twice as far
_CHUNK = 1 << 16  # evaluations at a time: many passes go over them, so they stay in the processor's cache
_LEAST_TAIL_ALPHA = 2e-3  # below it float32 does not resolve 1 - (n.h)^2, nor has the grid a share where it matters
_MIN_COSINE = np.float32(1e-4)


def texels(
    environment: Float[np.ndarray, "h w 3"], shape: tuple[int, int]
) -> tuple[Float[np.ndarray, "3 m"], Float[np.ndarray, "m 3"]]:
    """Directions, and radiance times solid angle, of a light brought to `shape`."""
    check_map(environment)
    if environment.shape[:2] != shape:
        environment = resample_environment(environment, shape)
    return texel_directions(shape), (environment * texel_solid_angles(*shape)[..., None]).reshape(-1, 3)


def grid_lobes(
    n: Float[np.ndarray, "3 p"],
    v: Float[np.ndarray, "3 p"],
    alpha: Float[np.ndarray, " p"],
    environment: Float[np.ndarray, "h w 3"],
    shape: tuple[int, int],
    tails: bool,
) -> Float[np.ndarray, "p 3"]:
    """Lobes over all texels of the light.

    Args:
        n: unit normals that face v.
        v: unit directions towards the viewer.
        alpha: roughness squared.
        environment: lat-long radiance, any resolution.
        shape: to which it is brought.
        tails: only the grid's share of each direction, 1 / (1 + (p / q)^2).
    """
    directions, radiance = texels(environment, shape)
    out = np.empty((n.shape[1], 3), dtype=np.float32)
    for group in _alike(n):
        # half of all texels lie below the horizon; those that do for all of a group are left out
        axis = n[:, group].mean(axis=1)
        axis /= np.linalg.norm(axis)
        cosine = float(np.clip(np.min(axis @ n[:, group]), 0, 1))
        up = axis @ directions > -math.sqrt(1 - cosine**2) - 1e-3
        light, energy = np.ascontiguousarray(directions[:, up]), radiance[up]
        step = max(1, _CHUNK // len(energy))
        for part in (group[i : i + step] for i in range(0, len(group), step)):
            out[part] = _weights(n[:, part], v[:, part], alpha[part, None], light, tails=tails) @ energy
    return out


def lobe_matrix(
    n: Float[np.ndarray, "3 p"], v: Float[np.ndarray, "3 p"], alpha: Float[np.ndarray, " p"], shape: tuple[int, int]
) -> Float[np.ndarray, "p m"]:
    """What lobes take of the texels of any light of `shape`: times its radiance `[m 3]` it is `grid_lobes`.

    Args:
        n: unit normals that face v.
        v: unit directions towards the viewer.
        alpha: roughness squared; the lobe should be wider than a texel.
        shape: rows and columns of the light.
    """
    weights = _weights(n, v, alpha[:, None], texel_directions(shape), tails=False)
    return weights * texel_solid_angles(*shape).reshape(-1)


def cosine_matrix(n: Float[np.ndarray, "3 p"], shape: tuple[int, int]) -> Float[np.ndarray, "p m"]:
    """What irradiance / pi takes of the texels of any light of `shape`: times its radiance `[m 3]` it is d.

    Args:
        n: unit normals.
        shape: rows and columns of the light.
    """
    weights = np.maximum(n.T @ texel_directions(shape), 0) * texel_solid_angles(*shape).reshape(-1)
    return (weights / np.pi).astype(np.float32)


def _alike(n: Float[np.ndarray, "3 p"]) -> Iterator[Int[np.ndarray, " g"]]:
    """Groups of similar normals, by their position in the picture of a ball."""
    column, row = np.floor(2 * n[:2])
    key = 8 * row + column
    return (np.flatnonzero(key == value) for value in np.unique(key))


def _weights(
    n: Float[np.ndarray, "3 p"],
    v: Float[np.ndarray, "3 p"],
    alpha: Float[np.ndarray, "p 1"],
    light: Float[np.ndarray, "3 m"],
    *,
    tails: bool,
) -> Float[np.ndarray, "p m"]:
    """f cos in each direction, or the grid's share of it.

    With h = (v + l) / |v + l|: p = scale A / B, A = |v + l|^4, B = (|v + l|^2 - (n.l + n.v)^2 (1 - a2))^2. In place and
    with a single division, for speed.
    """
    a2 = np.square(alpha)
    n_v = np.maximum(dot(n, v), _MIN_COSINE)[:, None]
    scale = a2 * smith_g1(n_v, alpha) / (4 * np.pi * n_v)
    n_l, above = n.T @ light, v.T @ light
    above += np.float32(1 + 1e-6)  # not negative by rounding
    above *= 2
    below = n_l + n_v
    np.square(below, out=below)
    below *= 1 - (np.maximum(a2, np.float32(_LEAST_TAIL_ALPHA**2)) if tails else a2)
    np.subtract(above, below, out=below)
    np.square(below, out=below)
    np.square(above, out=above)
    np.maximum(n_l, 0, out=n_l)
    if tails:  # A / B / (1 + (scale A / B / q)^2) = A B / (B^2 + (scale A / q)^2)
        other = above * (scale / np.float32(GRID_DENSITY))
        np.square(other, out=other)
        above *= below
        np.square(below, out=below)
        below += other
        np.square(n_l, out=other)
    else:
        other = np.square(n_l)
    # G1(l) = 2 n.l / (n.l + sqrt(a2 + (1 - a2) (n.l)^2))
    other *= 1 - a2
    other += a2
    np.sqrt(other, out=other)
    other += n_l
    below *= other
    above *= n_l
    above *= 2 * scale
    return np.divide(above, below, out=above)


def sampled_cores(
    around: Float[np.ndarray, "6 p 9"],
    turn: Float[np.ndarray, "2 p"],
    left: Bool[np.ndarray, " p"],
    alpha: Float[np.ndarray, " p"],
    environment: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "p 3"]:
    """The samples' share of sharp lobes: visible normals at points spread over the pixel.

    Each sample reads the mip level of its own solid angle (Krivanek and Colbert 2008): that of its share of the lobe,
    widened by what the pixel's curvature adds.

    Args:
        around: surroundings of each pixel (`unirender.light.subpixel`), normal and view direction.
        turn: by how much (radians) the mirror direction turns over a pixel's width and height.
        left: pixels whose lobe is sampled as in a mirror, with left and right exchanged.
        alpha: roughness squared.
        environment: lat-long radiance, any resolution.
    """
    pyramid = MipPyramid(environment)
    texel = 4 * math.pi / (environment.shape[0] * environment.shape[1])
    out = np.empty((around.shape[1], 3), dtype=np.float32)
    u1, u2, x, y = halton(LOBE_SAMPLES)
    step = max(1, _CHUNK // (8 * LOBE_SAMPLES))
    for part in (slice(i, i + step) for i in range(0, len(out), step)):
        vectors = inside(around[:, part], x - np.float32(0.5), y - np.float32(0.5))
        v = unit(vectors[3:])
        n = facing_normal(unit(vectors[:3]), v)
        t, b = tangents(n)
        t = np.where(left[part, None], -t, t)  # the frame of a mirrored normal is then the mirrored frame
        a = alpha[part, None]
        view = np.stack([dot(t, v), dot(b, v), np.maximum(dot(n, v), _MIN_COSINE)])
        h = visible_normals(view, a, u1, u2)
        light = 2 * dot(h, view) * h - view
        # 1 - (n.h)^2 by the tangent components: the difference would be lost in float32
        p = np.square(a / (np.square(h[0]) + np.square(h[1]) + np.square(a * h[2])))
        p *= smith_g1(view[2], a) / (4 * np.pi * view[2])
        side = 1 / np.sqrt(np.maximum(p, np.float32(1e-9)))
        area = (side + turn[0, part, None]) * (side + turn[1, part, None])
        level = np.float32(0.5) * np.log2(np.maximum(area / np.float32(LOBE_SAMPLES * texel), 1))
        share = np.square(p / np.float32(GRID_DENSITY))
        weight = share / (1 + share) * smith_g1(light[2], a)
        radiance = pyramid.sample(light[0] * t + light[1] * b + light[2] * n, level)
        out[part] = np.einsum("ps,psc->pc", weight, radiance) / LOBE_SAMPLES
    return out


class MipPyramid:
    """An environment at halved resolutions, down to a few texels, in one table."""

    def __init__(self, environment: Float[np.ndarray, "h w 3"]) -> None:
        levels = [environment]
        while min(levels[-1].shape[:2]) >= 8:
            h, w = levels[-1].shape[:2]
            levels.append(resample_environment(levels[-1], (max(math.ceil(h / 2), 2), max(math.ceil(w / 2), 2))))
        self._heights, self._widths = (np.array([x.shape[i] for x in levels], np.int32) for i in (0, 1))
        self._starts = np.cumsum([0, *self._heights * self._widths])[:-1].astype(np.int32)
        self._texels = np.concatenate([x.reshape(-1, 3) for x in levels]).astype(np.float32)

    def sample(
        self, directions: Float[np.ndarray, "3 ..."], level: Float[np.ndarray, "..."]
    ) -> Float[np.ndarray, "... 3"]:
        """Radiance interpolated between texels, as `sample_environment` does, and between levels."""
        level = np.minimum(level, len(self._starts) - 1)
        lower = level.astype(np.int32)
        upper = np.minimum(lower + 1, len(self._starts) - 1)
        row = np.arccos(np.clip(directions[1], -1, 1)) * np.float32(1 / np.pi)
        column = np.arctan2(directions[0], -directions[2]) * np.float32(0.5 / np.pi)
        fraction = (level - lower)[..., None]
        return (1 - fraction) * self._bilinear(row, column, lower) + fraction * self._bilinear(row, column, upper)

    def _bilinear(
        self, row: Float[np.ndarray, "..."], column: Float[np.ndarray, "..."], level: Int[np.ndarray, "..."]
    ) -> Float[np.ndarray, "... 3"]:
        """Row in [0, 1] and column in [-1/2, 1/2] of the map's height and width."""
        height, width = self._heights[level], self._widths[level]
        row, column = row * (height - 1).astype(np.float32), column * width.astype(np.float32) - np.float32(0.5)
        row_0, column_0 = np.minimum(row.astype(np.int32), height - 2), np.floor(column).astype(np.int32)
        f_row, f_column = (row - row_0)[..., None], (column - column_0)[..., None]
        column_0 += np.where(column_0 < 0, width, 0)
        column_1 = np.where(column_0 + 1 >= width, 0, column_0 + 1)
        top = self._starts[level] + row_0 * width
        bottom = top + width
        t = self._texels
        upper = t[top + column_0] * (1 - f_column) + t[top + column_1] * f_column
        lower = t[bottom + column_0] * (1 - f_column) + t[bottom + column_1] * f_column
        return upper * (1 - f_row) + lower * f_row


@functools.lru_cache(maxsize=4)
def texel_directions(shape: tuple[int, int]) -> Float[np.ndarray, "3 m"]:
    """Unit directions of a lat-long map's texels, row by row.

    Args:
        shape: its rows and columns.
    """
    return np.ascontiguousarray(environment_directions(*shape).reshape(-1, 3).T)
