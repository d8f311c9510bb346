"""The environment at the size the model predicts, under turns about the view axis: quarters of one, and small ones.

Turning a map and resampling it are linear, so both are one sparse matrix per (source size, target size, turns). A
target texel is the integral of the turned bilinear radiance against the texel's own bilinear weight, divided by the
integral of that weight, as in `light.resampling.resample_environment`: the energy of a sun smaller than a texel is
kept, where sampling the turned map at texel directions would lose or double it.

A map that has that size already would be blurred by such an integral, of its own tent and of the target's.
`small_turn_operator` moves its energy instead, from where a texel is to where it comes to lie:

    flow_ji >= 0 from texel i to texel j,    sum over j: solid angle of i,    sum over i: solid angle of j

The first sum keeps the energy of every light, however small, the second a map of one radiance. The flow begins with the
overlap of the texels' areas, and is then balanced (Sinkhorn).
"""

import functools

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from unirender.light.environment import texel_solid_angles
from unirender.light.resampling import resample_environment

QUADRATURE_TEXELS = 4  # integration points per texel along each axis, on the grid of the source
QUADRATURE_ROWS = 512  # no more than that, unless the source itself has more
ANGLE_STEP = np.pi / 720  # a quarter of a degree, to which small turns are rounded; texels have 11
AREA_POINTS = 8  # per texel along each axis, of which overlaps are counted
BALANCING = 100  # rounds: one radiance then stays itself to a few per cent of a pole's texels, and energy to rounding


def turned_environments(
    environment: Float[np.ndarray, "eh ew 3"], size: tuple[int, int]
) -> Float[np.ndarray, "4 h w 3"]:
    """The environment under 0, 1, 2 and 3 quarter turns (counter-clockwise for the viewer), each at `size`.

    The four act on each colour channel alike and are linear, so they commute with mixtures and tints of lights.
    """
    source = environment.shape[:2]
    turned = [resample_environment(environment, size)]
    for turns in (1, 2, 3):
        flat = turn_operator(source, size, turns) @ environment.reshape(-1, 3)
        turned.append(flat.reshape(*size, 3))
    return np.stack(turned).astype(np.float32)


@functools.lru_cache(maxsize=32)
def turn_operator(source: tuple[int, int], target: tuple[int, int], turns: int) -> csr_array:
    """Sparse matrix `[h2 w2, h w]` that turns a map of size `source` and resamples it to `target`."""
    finest = max(source[0], target[0])
    points = max(1, min(QUADRATURE_TEXELS, QUADRATURE_ROWS // finest))
    height, width = points * finest, points * max(source[1], target[1])
    directions, solid_angle = _points(height, width)
    from_source = _bilinear_matrix(directions, source)
    for _ in range(turns % 4):  # light from (x, y) comes from (-y, x) afterwards
        directions = directions[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0])
    weighted = _bilinear_matrix(directions, target).multiply(solid_angle[:, None]).tocsr()
    mass = weighted.sum(axis=0)
    operator = weighted.T @ from_source
    return csr_array(operator.multiply((1 / mass)[:, None]), dtype=np.float32)


@functools.lru_cache(maxsize=512)
def small_turn_operator(size: tuple[int, int], steps: int) -> csr_array:
    """Sparse matrix `[h w, h w]` that turns a map of its own size by `steps` of `ANGLE_STEP`; energy is kept."""
    height, width = size
    directions, solid_angle = _points(AREA_POINTS * height, AREA_POINTS * width)
    cosine, sine = np.cos(steps * ANGLE_STEP), np.sin(steps * ANGLE_STEP)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    own, source, target = (_texels(d, size) for d in (directions, directions @ rotation, directions @ rotation.T))
    count = height * width
    pairs = np.concatenate([own * count + source, target * count + own])  # points of both maps: no texel is missed
    overlap = np.bincount(pairs, np.tile(solid_angle, 2), count**2)
    target, source = np.divmod(np.flatnonzero(overlap), count)
    flow, area = overlap[overlap > 0], texel_solid_angles(height, width).reshape(-1).astype(np.float64)
    for _ in range(BALANCING):
        flow = flow * (area / np.bincount(target, flow, count))[target]
        flow = flow * (area / np.bincount(source, flow, count))[source]
    return csr_array((flow / area[target], (target, source)), shape=(count, count), dtype=np.float32)


def _points(height: int, width: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Directions of a grid that leaves the poles out, and the solid angle of each, up to a factor."""
    theta = (np.arange(height) + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), np.sin(theta).reshape(-1)


def _position(
    directions: Float[np.ndarray, "n 3"], size: tuple[int, int]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Rows and columns, texels at whole numbers, on the grid of `unirender.light.environment`."""
    row = np.arccos(np.clip(directions[:, 1], -1, 1)) * ((size[0] - 1) / np.pi)
    return row, np.arctan2(directions[:, 0], -directions[:, 2]) * (size[1] / (2 * np.pi)) - 0.5


def _texels(directions: Float[np.ndarray, "n 3"], size: tuple[int, int]) -> Int[np.ndarray, " n"]:
    """Numbers of the texels nearest by row and column."""
    row, column = (np.rint(position).astype(np.int64) for position in _position(directions, size))
    return row * size[1] + column % size[1]


def _bilinear_matrix(directions: Float[np.ndarray, "n 3"], size: tuple[int, int]) -> csr_array:
    """Sparse `[n, h w]`: the bilinear weights of `unirender.light.environment.sample_environment`."""
    height, width = size
    row, column = _position(directions, size)
    row_0 = np.clip(np.floor(row).astype(np.int64), 0, height - 2)
    column_0 = np.floor(column).astype(np.int64)
    f_row, f_column = row - row_0, column - column_0
    index = np.arange(len(directions))
    entries = [
        ((1 - f_row) * (1 - f_column), row_0, column_0),
        ((1 - f_row) * f_column, row_0, column_0 + 1),
        (f_row * (1 - f_column), row_0 + 1, column_0),
        (f_row * f_column, row_0 + 1, column_0 + 1),
    ]
    values = np.concatenate([weight for weight, _, _ in entries])
    columns = np.concatenate([r * width + c % width for _, r, c in entries])
    return csr_array((values, (np.tile(index, 4), columns)), shape=(len(directions), height * width))
