"""Textures from what the pixels see: sparse least squares over texels.

Notation: T (t, c) texels, F (n, t) the footprint: how much each texel counts in a pixel's mean (bilinear lookups of the
pixel's points), G differences of neighbouring texels.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Float

from unirender_reference.optimize.surface_points import SurfacePoints

ITERATIONS = 60
TIE = 1e-2  # weight of the texels' start values: decides where nothing else does


def footprint(points: SurfacePoints, size: int) -> sp.csr_matrix:
    """F for a texture of `size` x `size` texels, read like Mitsuba's `bitmap`: bilinear, repeated."""
    count, samples = points.hit.shape
    hit = points.hit.ravel()
    pixel = np.repeat(np.arange(count), samples)[hit]
    share = 1 / np.maximum(points.hit.sum(axis=1), 1)[pixel]
    x, y = (points.uv.reshape(-1, 2)[hit] * size - 0.5).T
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, down = x - left, y - top
    parts = [
        (((top + dy) % size) * size + (left + dx) % size, wx * wy * share)
        for dx, wx in ((0, 1 - right), (1, right))
        for dy, wy in ((0, 1 - down), (1, down))
    ]
    texels, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    return sp.csr_matrix((weights.astype(np.float32), (np.tile(pixel, 4), texels)), shape=(count, size**2))


def differences(size: int) -> sp.csr_matrix:
    """G: of texels beside and below each other."""
    index = np.arange(size**2).reshape(size, size)
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    line, ones = np.arange(len(first)), np.ones(len(first), np.float32)
    return sp.csr_matrix(
        (np.concatenate([ones, -ones]), (np.concatenate([line, line]), np.concatenate([first, second]))),
        shape=(len(first), size**2),
    )


def spread(
    values: Float[np.ndarray, "n c"], weight: Float[np.ndarray, " n"], seen: sp.csr_matrix
) -> Float[np.ndarray, "t c"]:
    """Texels as weighted means of the pixels that show them; the mean of all where none does."""
    amount = np.asarray(seen.T @ weight)
    total = np.asarray(seen.T @ (values * weight[:, None]))
    middle = (values * weight[:, None]).sum(axis=0) / max(float(weight.sum()), 1e-12)
    return np.where(amount[:, None] > 0, total / np.maximum(amount, 1e-12)[:, None], middle)


def fit_texels(
    seen: sp.csr_matrix,
    gain: Float[np.ndarray, "n c"],
    target: Float[np.ndarray, "n c"],
    weight: Float[np.ndarray, "n c"],
    start: Float[np.ndarray, "t c"],
    smooth: float,
) -> Float[np.ndarray, "t c"]:
    """Texels T in [0, 1] with the least |weight (gain F T - target)|^2 + |smooth G T|^2, clipped after the fit.

    Args:
        seen: F.
        gain, target, weight: of each pixel and channel.
        start: decides by `TIE` what the pixels leave open.
    """
    count = len(start)
    smoothness, tie = smooth * differences(round(count**0.5)), TIE * sp.identity(count)
    texels = np.empty(start.shape, np.float32)
    for c in range(start.shape[1]):
        system = sp.vstack([sp.diags(weight[:, c] * gain[:, c]) @ seen, smoothness, tie]).tocsr()
        right = np.concatenate([weight[:, c] * target[:, c], np.zeros(smoothness.get_shape()[0]), TIE * start[:, c]])
        texels[:, c] = scipy.sparse.linalg.lsmr(system, right, x0=start[:, c], maxiter=ITERATIONS)[0]
    return np.clip(texels, 0, 1)
