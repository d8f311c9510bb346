"""Textures from what the pixels see: sparse least squares over texels.

Notation: T (t, c) texels, F (n, t) the footprint: how much each texel counts in a pixel's mean (bilinear lookups of the
pixel's points), G differences of neighbouring texels.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Float

from unirender.light.resampling import hat_weights
from unirender_reference.optimize.numerics.differences import difference_matrix, side_by_side
from unirender_reference.optimize.numerics.robust import HUBER
from unirender_reference.optimize.surface.points import SurfacePoints

ITERATIONS = 60
SMOOTHNESS = (8.0, 15.0, 30.0, 60.0, 120.0, 240.0)
HELD_OUT = 0.15  # of the pixels
TIE = 1e-2  # weight of the texels' start values: decides where nothing else does


def texel_weights(uv: Float[np.ndarray, "n 2"], size: int) -> sp.csr_matrix:
    """(n, size^2): what each texel counts in each lookup, as Mitsuba's `bitmap` reads a texture: bilinear, repeated."""
    across, down = (hat_weights(place * size - 0.5, size, wrap=True) for place in uv.T.astype(np.float64))
    x, y = (weights.indices.reshape(-1, 2) for weights in (across, down))
    u, v = (weights.data.reshape(-1, 2) for weights in (across, down))
    texels, weights = y[:, :, None] * size + x[:, None], v[:, :, None] * u[:, None]
    starts = 4 * np.arange(len(uv) + 1)
    shape = (len(uv), size**2)
    return sp.csr_matrix((weights.ravel().astype(np.float32), texels.ravel(), starts), shape=shape)


def footprint(points: SurfacePoints, size: int) -> sp.csr_matrix:
    """F for a texture of `size` x `size` texels, read like Mitsuba's `bitmap`: bilinear, repeated."""
    count, samples = points.hit.shape
    hit = points.hit.ravel()
    pixel = np.repeat(np.arange(count), samples)[hit]
    share = 1 / np.maximum(points.hit.sum(axis=1), 1)[pixel]
    entries = sp.csr_matrix((share, (pixel, np.arange(len(pixel)))), shape=(count, len(pixel)))
    return sp.csr_matrix(entries @ texel_weights(points.uv.reshape(-1, 2)[hit], size), dtype=np.float32)


def spread(
    values: Float[np.ndarray, "n c"], weight: Float[np.ndarray, " n"], seen: sp.csr_matrix
) -> Float[np.ndarray, "t c"]:
    """Texels as weighted means of the pixels that show them; the mean of all where none does."""
    amount = np.asarray(seen.T @ weight)
    total = np.asarray(seen.T @ (values * weight[:, None]))
    middle = (values * weight[:, None]).sum(axis=0) / max(float(weight.sum()), 1e-12)
    return np.where(amount[:, None] > 0, total / np.maximum(amount, 1e-12)[:, None], middle)


def best_smoothness(
    seen: sp.csr_matrix,
    gain: Float[np.ndarray, "n c"],
    target: Float[np.ndarray, "n c"],
    weight: Float[np.ndarray, "n c"],
    start: Float[np.ndarray, "t c"],
    seed: int = 0,
) -> float:
    """Of `SMOOTHNESS`, the first under which pixels that are held out are explained better than under the next one.

    The error of a texel that several views show has two parts, its own (wrong light, noise) and blur; how they compare
    depends on the object. Arguments as those of `fit_texels`.
    """
    held = np.random.default_rng(seed).random(len(target)) < HELD_OUT
    best, least = SMOOTHNESS[0], np.inf
    for smooth in SMOOTHNESS:
        texels = fit_texels(seen[~held], gain[~held], target[~held], weight[~held], start, smooth)
        residual = weight[held] * (gain[held] * (seen[held] @ texels) - target[held])
        cost = float(HUBER.cost(np.abs(residual)).sum())
        if cost >= least:
            break
        best, least = smooth, cost
    return best


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
    side = round(count**0.5)
    smoothness = smooth * difference_matrix(side_by_side(np.arange(count).reshape(side, side)), count)
    tie = TIE * sp.identity(count)
    texels = np.empty(start.shape, np.float32)
    for c in range(start.shape[1]):
        system = sp.vstack([sp.diags(weight[:, c] * gain[:, c]) @ seen, smoothness, tie]).tocsr()
        right = np.concatenate([weight[:, c] * target[:, c], np.zeros(smoothness.get_shape()[0]), TIE * start[:, c]])
        texels[:, c] = scipy.sparse.linalg.lsmr(system, right, x0=start[:, c], maxiter=ITERATIONS)[0]
    return np.clip(texels, 0, 1)
