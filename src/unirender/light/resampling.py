"""Environment maps at another resolution, or read on another grid, whose light stays the same.

Between texels radiance is bilinear (`unirender.light.environment`). Both directions of a map are resampled by a sparse
matrix: `new = rows @ old @ columns.T` for each channel.
"""

import functools
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from unirender.light.environment import check_map, check_shape

if TYPE_CHECKING:
    from scipy.sparse import csr_array

AREA_POINTS = 16  # of a pixel's rows: a pole's light to 0.2 %
MOST_ALIASING = 0.005  # share of a texel's energy, away from the poles, that may come of how two grids lie together


def resample_environment(
    environment: Float[np.ndarray, "h w 3"], shape: tuple[int, int]
) -> Float[np.ndarray, "h2 w2 3"]:
    """The environment at another resolution; energy-preserving where it shrinks, bilinear where it grows.

    Where it grows by a factor that is no whole number, texels of the old map would be met by more or fewer of the new
    one's as they happen to lie: where that matters (`MOST_ALIASING`), it is energy-preserving there as well.
    Beside the poles, where texels are small, samples say more: of 16 rows that become 32 (the network's light, where s
    and d are derived from it), up to 5 % too much of a lamp on the first or the last row, 1.2 % on the next.
    """
    check_map(environment)
    check_shape(shape)
    height, width = environment.shape[:2]
    return _mixed(environment, *resampling_operators((height, width), tuple(shape)), shape)


def area_pixels(environment: Float[np.ndarray, "h w 3"], finer: int) -> Float[np.ndarray, "h2 w2 3"]:
    """The light as most programs read a map: its rows are areas between the poles. Bilinear, `finer` times as fine.

    A pixel is the mean over its rows by solid angle: beside a bright pole its centre alone would say up to half more.
    """
    check_map(environment)
    height, width = environment.shape[:2]
    shape = finer * height, finer * width
    count = AREA_POINTS * shape[0]
    theta = (np.arange(count) + 0.5) * np.pi / count
    pixels = hat_weights(np.arange(count) // AREA_POINTS * 1.0, shape[0])  # each point lies in one
    rows = weighted_means(pixels, np.sin(theta)) @ hat_weights(theta * (height - 1) / np.pi, height)
    columns = hat_weights((np.arange(shape[1]) + 0.5) / finer - 0.5, width, wrap=True)
    return _mixed(environment, rows, columns, shape)


def _mixed(
    environment: Float[np.ndarray, "h w 3"], rows: "csr_array", columns: "csr_array", shape: tuple[int, int]
) -> Float[np.ndarray, "h2 w2 3"]:
    """`rows @ environment @ columns.T` for each channel, which has that shape."""
    height, width = environment.shape[:2]
    mixed = (rows @ environment.reshape(height, -1)).reshape(shape[0], width, 3).transpose(1, 0, 2)
    new = (columns @ mixed.reshape(width, -1)).reshape(shape[1], shape[0], 3).transpose(1, 0, 2)
    return np.ascontiguousarray(new, dtype=np.float32)


@functools.lru_cache(maxsize=64)
def resampling_operators(source: tuple[int, int], target: tuple[int, int]) -> tuple["csr_array", "csr_array"]:
    """Sparse matrices `[h2 h]`, `[w2 w]` of `resample_environment`: `new = rows @ old @ columns.T` for each channel.

    A target texel of a smaller map is the integral of the bilinear radiance against the texel's own bilinear weight,
    divided by the integral of that weight; the weights are a partition of unity, so the total is kept.
    """
    from scipy.sparse import csr_array

    (h, w), (h2, w2) = source, target
    check_shape(source)
    check_shape(target)
    if _is_integrated((h2 - 1) / (h - 1)):
        count = 64 * max(h, h2)
        theta = (np.arange(count) + 0.5) * np.pi / count  # midpoint rule over the polar angle
        old, new = hat_weights(theta * (h - 1) / np.pi, h), hat_weights(theta * (h2 - 1) / np.pi, h2)
        rows = weighted_means(new, np.sin(theta)) @ old
    else:
        rows = hat_weights(np.arange(h2) * (h - 1) / (h2 - 1), h)
    if _is_integrated(w2 / w):
        count = 64 * max(w, w2)
        u = (np.arange(count) + 0.5) / count
        old, new = hat_weights(u * w - 0.5, w, wrap=True), hat_weights(u * w2 - 0.5, w2, wrap=True)
        columns = weighted_means(new, np.ones(count)) @ old
    else:
        columns = hat_weights((np.arange(w2) + 0.5) * w / w2 - 0.5, w, wrap=True)
    return csr_array(rows, dtype=np.float32), csr_array(columns, dtype=np.float32)


def _is_integrated(growth: float) -> bool:
    """Whether a map whose steps become `growth` times finer is integrated instead of sampled.

    Samples of a hat at `growth` points a step sum to what it holds but for a part that moves with where they fall, up
    to 2 sinc(growth)^2 (Poisson's sum): none for whole numbers. Below 2 that part moves slowly and adds up.
    """
    return growth != 1 and (growth < 2 or 2 * float(np.sinc(growth)) ** 2 > MOST_ALIASING)


def hat_weights(position: Float[np.ndarray, " m"], n: int, wrap: bool = False) -> "csr_array":
    """Weights `[m n]` of the n texels in the linear interpolant at fractional texel positions; two in a row."""
    from scipy.sparse import csr_array

    first = np.floor(position).astype(np.int64)
    if not wrap:
        first = np.clip(first, 0, n - 2)
    fraction = position - first
    columns = np.stack([first % n, (first + 1) % n], axis=1)
    weights = np.stack([1 - fraction, fraction], axis=1)
    return csr_array((weights.ravel(), columns.ravel(), 2 * np.arange(len(position) + 1)), shape=(len(position), n))


def weighted_means(weights: "csr_array", measure: Float[np.ndarray, " m"]) -> "csr_array":
    """The matrix `[n m]` that averages values at m points under each of n weights `[m n]`, points by their measure."""
    from scipy.sparse import csr_array, diags_array

    total = weights.T @ measure
    return csr_array(diags_array(1 / total) @ weights.T @ diags_array(measure))
