"""The priors of single-view optimisation as precision matrices of log albedo and log light.

Log albedo is beta_0 + g_k + u: a gain g for each channel k of the whole object, and u at each pixel, whose precision Q
ties neighbours together unless the picture's chroma says that the paint changes between them. Log light is that of
the start plus P e: e lives on a coarse grid, P interpolates it. A Gaussian whose mean over the object (or the sphere)
is nearly free is had by adding v^2 1 1^T to a covariance; `level_freed` does so to its inverse.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from unirender.light.resampling import hat_weights
from unirender_reference.optimize.numerics.differences import difference_matrix
from unirender_reference.optimize.single.config import Priors
from unirender_reference.optimize.transport.light_grid import LightGrid

LIGHT_GRID = (8, 16)  # rows and columns on which the light's change is sought
CHROMA = 0.2  # log ratio of channels over which neighbours count as of another paint
CROSSING = 0.1  # what is left of the tie between them
LEAST_SINE = 0.1  # texels at the poles cover little of the sphere, but not nothing


def albedo_precision(
    display: Float[np.ndarray, "n 3"],
    coverage: Float[np.ndarray, "n 1"],
    pairs: Int[np.ndarray, "2 k"],
    priors: Priors,
) -> sparse.csc_array:
    """Q (n, n) of the log albedo of one channel."""
    first, second = pairs
    ratio = np.log((display[first] + 0.05) / (display[second] + 0.05))
    chroma = np.square(ratio - ratio.mean(axis=1, keepdims=True)).sum(axis=1)
    tie = CROSSING + (1 - CROSSING) * np.exp(-chroma / CHROMA**2)
    tie *= np.minimum(coverage[first, 0], coverage[second, 0]) / priors.albedo_step**2
    steps = difference_matrix(pairs, len(display), np.sqrt(tie))
    own = sparse.diags_array(coverage[:, 0] / priors.albedo**2)
    return sparse.csc_array(steps.T @ steps) + own.tocsc()


def gain_precision(priors: Priors) -> Float[np.ndarray, "3 3"]:
    """Of the channels' gains g."""
    grey = np.full((3, 3), 1 / 3)
    return grey / 3 / priors.brightness**2 + (np.eye(3) - grey) / priors.tint**2


def light_precision(priors: Priors) -> Float[np.ndarray, "c c"]:
    """Of e, its three channels one after another."""
    rows, columns = LIGHT_GRID
    sine = np.sin(np.pi * np.arange(rows) / (rows - 1))
    area = np.repeat(np.maximum(sine, LEAST_SINE), columns)
    area /= area.mean()
    steps = LightGrid(rows, columns).differences
    ties = (steps.T @ steps).toarray() / priors.light_step**2
    grey = level_freed(np.diag(area / priors.light**2) + ties, priors.light_level)
    finer = 0.5 * priors.light / priors.light_chroma  # chroma varies as slowly, by less
    tint = level_freed(np.diag(area / priors.light_chroma**2) + ties * finer**2, priors.light_tint)
    mean = np.full((3, 3), 1 / 3)
    return np.kron(mean, grey / 3) + np.kron(np.eye(3) - mean, tint)


def level_freed(precision: Float[np.ndarray, "c c"], level: float) -> Float[np.ndarray, "c c"]:
    """The precision of x + level z 1, where x has the given one and z is a standard normal number."""
    ones = precision.sum(axis=1)
    total = ones.sum()
    return precision - np.outer(ones, ones) / total * (1 - 1 / (1 + level**2 * total))


def light_interpolation(grid: LightGrid) -> sparse.csr_array:
    """P (texels, LIGHT_GRID's texels): bilinear."""
    rows, columns = LIGHT_GRID
    vertical = hat_weights(np.arange(grid.rows) * (rows - 1) / (grid.rows - 1), rows)
    horizontal = hat_weights((np.arange(grid.columns) + 0.5) * columns / grid.columns - 0.5, columns, wrap=True)
    return sparse.csr_array(sparse.kron(vertical, horizontal))
