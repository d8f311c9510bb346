"""The environment at the size the model predicts, under the four quarter turns about the view axis.

Turning a map and resampling it are linear, so both are one sparse matrix per (source size, target size, turns). A
target texel is the integral of the turned bilinear radiance against the texel's own bilinear weight, divided by the
integral of that weight, as in `unirender.lighting.resample_environment`: the energy of a sun smaller than a texel is
kept, where sampling the turned map at texel directions would lose or double it.
"""

import functools

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from unirender.lighting import resample_environment

QUADRATURE_TEXELS = 4  # integration points per texel along each axis, on the grid of the source
QUADRATURE_ROWS = 512  # no more than that, unless the source itself has more


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
    theta = (np.arange(height) + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)
    directions = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    from_source = _bilinear_matrix(directions, source)
    for _ in range(turns % 4):  # light from (x, y) comes from (-y, x) afterwards
        directions = directions[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0])
    solid_angle = np.sin(theta).reshape(-1)
    weighted = _bilinear_matrix(directions, target).multiply(solid_angle[:, None]).tocsr()
    mass = weighted.sum(axis=0)
    operator = weighted.T @ from_source
    return csr_array(operator.multiply((1 / mass)[:, None]), dtype=np.float32)


def _bilinear_matrix(directions: Float[np.ndarray, "n 3"], size: tuple[int, int]) -> csr_array:
    """Sparse `[n, h w]`: the bilinear weights of `unirender.lighting.sample_environment`."""
    height, width = size
    row = np.arccos(np.clip(directions[:, 1], -1, 1)) * ((height - 1) / np.pi)
    column = np.arctan2(directions[:, 0], -directions[:, 2]) * (width / (2 * np.pi)) - 0.5
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
