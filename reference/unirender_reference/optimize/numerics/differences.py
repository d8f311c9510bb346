"""Differences of neighbours as sparse matrices: what priors of smoothness are made of."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int


def side_by_side(index: Int[np.ndarray, "h w"], around: bool = False) -> Int[np.ndarray, "2 k"]:
    """Pairs of a picture's entries: all that lie beside each other, row by row, then all that lie below each other.

    Args:
        index: a number for each place.
        around: whether the last column is a neighbour of the first.
    """
    beside = np.roll(index, -1, axis=1) if around else index[:, 1:]
    first = np.concatenate([index[:, : beside.shape[1]].ravel(), index[:-1].ravel()])
    return np.stack([first, np.concatenate([beside.ravel(), index[1:].ravel()])])


def difference_matrix(
    pairs: Int[np.ndarray, "2 k"], count: int, weight: Float[np.ndarray, " k"] | None = None
) -> sp.csr_matrix:
    """(k, count): times values x it is weight (x[first] - x[second]) for each pair; None: weights of 1."""
    lines = np.arange(pairs.shape[1])
    weight = np.ones(len(lines), np.float32) if weight is None else weight
    entries = np.concatenate([weight, -weight]), (np.tile(lines, 2), pairs.ravel())
    return sp.csr_matrix(entries, shape=(len(lines), count))
