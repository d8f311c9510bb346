"""Depth from normals: bilateral normal integration (Cao et al., "Bilateral Normal Integration", ECCV 2022).

Along the surface the logarithm of the depth Z changes with the image coordinates x (right) and y (up), at distance 1:

    N dz/dx = n_x,    N dz/dy = n_y,    z = ln Z,    N = -n.r > 0,    r = (x, y, -1) the ray

Every pixel has two differences along each axis, one to either side. Where a surface ends in front of another, one of
the two is wrong; that with the larger N dz is the likelier, so that it is weighted down and the system solved again:

    minimise  sum w+ (N dz+ - n_x h)^2 + w- (N dz- - n_x h)^2 + ...,    w+ = sigmoid(k ((N dz-)^2 - (N dz+)^2) / h^2),
                                                                      w- = 1 - w+,    h the width of a pixel

What normals cannot say stays open: how far parts are from one another that do not touch in the picture.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from scipy.special import expit

from unirender.camera import Camera

ROUNDS = 12  # of weighting
SHARPNESS = 8.0  # k
GRAZING = 0.02  # the least N: a surface seen from the side has no slope that a pixel shows
TETHER = 1e-6  # weight of z = 0, by which parts that do not touch lie at one depth
RIGHT, LEFT, UP, DOWN = range(4)
OPPOSITE = (LEFT, RIGHT, DOWN, UP)


def integrate_normals(
    normal: Float[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"], camera: Camera
) -> Float[np.ndarray, "h w"]:
    """Depth along the view axis, up to one factor: its median is 1. NaN outside.

    Args:
        normal: camera axes, unit.
        inside: where there is a surface.
        camera: whose rays the pixels are.
    """
    depth = np.full(inside.shape, np.nan)
    if not inside.any():
        return depth
    rays = camera.rays(*inside.shape).astype(np.float64)
    n = normal[inside].astype(np.float64)
    facing = np.maximum(-(n * (rays / -rays[..., 2:])[inside]).sum(axis=-1), GRAZING)
    pixel = 2 * math.tan(math.radians(camera.fov_deg) / 2) / inside.shape[0]
    sides = _neighbours(inside)
    there = sides < len(n)
    slopes = np.stack([n[:, 0], -n[:, 0], n[:, 1], -n[:, 1]]) * pixel  # N dz towards each side
    weights = 0.5 * there
    z = np.zeros(len(n))
    for _ in range(ROUNDS):
        system, right = _system(sides, facing, weights, slopes)
        z = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(right)
        rise = np.where(there, facing * np.append(z, 0).take(sides) - facing * z, 0)
        squared = np.square(rise / pixel)
        for one, other in ((RIGHT, LEFT), (UP, DOWN)):
            share = expit(SHARPNESS * (squared[other] - squared[one]))
            share = np.where(there[other], share, 1.0)
            weights[one] = np.where(there[one], share, 0.0)
            weights[other] = np.where(there[other], np.where(there[one], 1 - share, 1.0), 0.0)
    depth[inside] = np.exp(z - np.median(z))
    return depth


def _neighbours(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "4 p"]:
    """The numbers of the pixels beside each of p pixels inside; p where there is none."""
    padded = np.pad(inside, 1)
    at = np.flatnonzero(padded)
    number = np.full(padded.size, len(at), np.int32)
    number[at] = np.arange(len(at))
    down = padded.shape[1]
    return np.stack([number[at + step] for step in (1, -1, -down, down)])


def _system(
    sides: Int[np.ndarray, "4 p"],
    facing: Float[np.ndarray, " p"],
    weights: Float[np.ndarray, "4 p"],
    slopes: Float[np.ndarray, "4 p"],
) -> tuple[csc_array, Float[np.ndarray, " p"]]:
    """Matrix and right side of the normal equations.

    Args:
        sides: numbers of the pixels on each side.
        facing: N.
        weights: of the differences to each side; 0 where there is no pixel.
        slopes: N dz towards each side, as the normals have it.
    """
    squares, falls = facing * weights * facing, facing * (weights * slopes)
    # what the pixel on a side says of this one, beside what this one says of it
    square_of, fall_of = (
        np.stack([np.append(values[OPPOSITE[side]], 0).take(sides[side]) for side in range(4)])
        for values in (squares, falls)
    )
    own, right = np.full(len(facing), TETHER), np.zeros(len(facing))
    for side in range(4):
        own = own + (squares[side] + square_of[OPPOSITE[side]])
        right = right + (fall_of[OPPOSITE[side]] - falls[side])
    beside = -(squares + square_of)
    # the entries of each row in the order of their columns, which are those of each column: the matrix is symmetric
    values = np.stack([*beside[[UP, LEFT]], own, *beside[[RIGHT, DOWN]]], axis=1)
    rows = np.stack([*sides[[UP, LEFT]], np.arange(len(facing), dtype=np.int32), *sides[[RIGHT, DOWN]]], axis=1)
    known = values != 0
    ends = np.concatenate([[0], np.cumsum(known.sum(axis=1))])
    return csc_array((values[known], rows[known], ends.astype(np.int32)), shape=(len(facing), len(facing))), right
