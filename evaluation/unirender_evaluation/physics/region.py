"""The 90 % region of a posterior of which only samples are known, and its volume: whatever shape the posterior has.

Notation: z_1 .. z_N are samples, y is a candidate, all points of the unit cube. How odd a point is among these N + 1 is
its squared Mahalanobis distance from their mean, with their own covariance. The region is all y that are not among the
floor((N + 1) / 10) oddest (full conformal prediction).

If y and the samples are independent draws of one distribution, y is equally likely to have any of the N + 1 ranks: it
lies inside with probability 1 - floor((N + 1) / 10) / (N + 1), for every distribution and every N, which is 0.9 where
N + 1 is a multiple of 10.
"""

import numpy as np
from jaxtyping import Bool, Float

from unirender.errors import UnirenderError

OUT_OF = 10  # one of so many draws lies outside
RESOLUTION = 0.002  # smaller differences count as none, so that samples that are all the same have a region
CELLS = 64  # of the volume's grid, along an edge of the cube
CHUNK = 32768


def perfect_share(samples: int) -> float:
    """Probability that a draw of the samples' own distribution lies inside."""
    return 1 - (samples + 1) // OUT_OF / (samples + 1)


def inside(samples: Float[np.ndarray, "n d"], points: Float[np.ndarray, "p d"]) -> Bool[np.ndarray, " p"]:
    """Which points lie in the samples' region.

    Raises:
        UnirenderError: fewer than nine samples, of which nothing is odd enough.
    """
    if len(samples) < OUT_OF - 1:
        raise UnirenderError(f"region: got {len(samples)} samples, expected at least {OUT_OF - 1}")
    centre = samples.mean(axis=0)
    z = samples - centre
    chunks = [points[i : i + CHUNK] - centre for i in range(0, len(points), CHUNK)]
    return np.concatenate([_inside(z, y) for y in chunks])


def _inside(z: Float[np.ndarray, "n d"], y: Float[np.ndarray, "p d"]) -> Bool[np.ndarray, " p"]:
    """The same around 0, the samples' mean: the mean of all is then y / (N + 1)."""
    count = len(z) + 1
    mean = y / count
    moment = (z.T @ z + y[:, :, None] * y[:, None, :]) / count
    covariance = moment - mean[:, :, None] * mean[:, None, :] + RESOLUTION**2 * np.eye(z.shape[1])
    precision = np.linalg.inv(covariance)
    own = np.einsum("pi,pij,pj->p", y - mean, precision, y - mean)
    others = z - mean[:, None]
    odd = np.einsum("pni,pni->pn", others @ precision, others) >= own[:, None]
    return odd.sum(axis=1) >= count // OUT_OF


def volume(samples: Float[np.ndarray, "n 3"]) -> float:
    """Share of the unit cube that the region covers, on a grid of `CELLS` cells an edge."""
    axis = (np.arange(CELLS) + 0.5) / CELLS
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return float(inside(samples, grid).mean())
