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
import scipy.sparse as sp
from jaxtyping import Bool, Float
from scipy.sparse.linalg import splu
from scipy.special import expit

from unirender.camera import Camera

ROUNDS = 12  # of weighting
SHARPNESS = 8.0  # k
GRAZING = 0.02  # the least N: a surface seen from the side has no slope that a pixel shows
TETHER = 1e-6  # weight of z = 0, by which parts that do not touch lie at one depth


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
    sides = [_differences(inside, step) for step in ((0, 1), (0, -1), (-1, 0), (1, 0))]  # right, left, up, down
    slopes = [sp.diags(facing) @ (d * sign) for (d, _), sign in zip(sides, (1, -1, 1, -1), strict=True)]
    there = [exists for _, exists in sides]
    expected = [n[:, 0] * pixel, n[:, 0] * pixel, n[:, 1] * pixel, n[:, 1] * pixel]
    weights = [0.5 * exists for exists in there]
    z = np.zeros(len(n))
    for _ in range(ROUNDS):
        system = TETHER * sp.identity(len(n))
        right = np.zeros(len(n))
        for slope, weight, value in zip(slopes, weights, expected, strict=True):
            system = system + slope.T @ sp.diags(weight) @ slope
            right += slope.T @ (weight * value)
        z = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(right)
        squared = [np.square(slope @ z / pixel) for slope in slopes]
        for one, other in ((0, 1), (2, 3)):
            share = expit(SHARPNESS * (squared[other] - squared[one]))
            share = np.where(there[other], share, 1.0)
            weights[one] = np.where(there[one], share, 0.0)
            weights[other] = np.where(there[other], np.where(there[one], 1 - share, 1.0), 0.0)
    depth[inside] = np.exp(z - np.median(z))
    return depth


def _differences(inside: Bool[np.ndarray, "h w"], step: tuple[int, int]) -> tuple[sp.csr_array, Bool[np.ndarray, " p"]]:
    """The matrix of z(pixel + step) - z(pixel) over the pixels inside, and which of them have that neighbour."""
    count = int(inside.sum())
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(count)
    rows, columns = step
    neighbour = np.roll(np.pad(number, 1, constant_values=-1), (-rows, -columns), axis=(0, 1))[1:-1, 1:-1][inside]
    exists = neighbour >= 0
    own = np.flatnonzero(exists)
    ones = np.ones(len(own))
    entries = (np.r_[ones, -ones], (np.r_[own, own], np.r_[neighbour[exists], own]))
    return sp.csr_array(entries, shape=(count, count)), exists
