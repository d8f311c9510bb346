"""SSIM (Wang et al. 2004): an 11 x 11 Gaussian window, of each channel, averaged over them."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import pair, weighted_mean

SSIM_SIGMA, SSIM_TRUNCATE = 1.5, 3.5  # Wang et al. 2004: an 11 x 11 Gaussian window
DENSE_SIDE = 256  # pixels up to which the window is a product with a dense matrix, of all pictures at once
SSIM_K1, SSIM_K2 = 0.01, 0.03


def ssim_map(p: Float[np.ndarray, "*n h w c"], t: Float[np.ndarray, "*m h w c"]) -> Float[np.ndarray, "*n h w"]:
    """Structural similarity at every pixel, averaged over channels; images in [0, 1].

    The same numbers as `skimage.metrics.structural_similarity(gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, data_range=1, full=True)`, and many images at once: the variants of a sample share a
    call (a test holds the two together). Leading axes of the truth broadcast against the prediction's.
    """
    if max(p.shape[-3:-1]) <= DENSE_SIDE:
        return _similarity(p, t).mean(axis=-1)
    p, t = np.broadcast_arrays(p, t)
    found = np.empty(p.shape[:-1])
    for at in np.ndindex(p.shape[:-3]):  # of large pictures one channel after the other, to the same bytes
        planes = [_similarity(p[at][..., k : k + 1], t[at][..., k : k + 1]) for k in range(p.shape[-1])]
        found[at] = np.concatenate(planes, axis=-1).mean(axis=-1)
    return found


def _similarity(p: Float[np.ndarray, "*n h w c"], t: Float[np.ndarray, "*m h w c"]) -> Float[np.ndarray, "*n h w c"]:
    """`ssim_map` of each channel."""
    p, t = p.astype(np.float64), t.astype(np.float64)
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    mean_p, mean_t = _blur(p), _blur(t)
    var_p, var_t = _blur(p * p) - mean_p**2, _blur(t * t) - mean_t**2
    covariance = _blur(p * t) - mean_p * mean_t
    numerator = (2 * mean_p * mean_t + c1) * (2 * covariance + c2)
    return numerator / ((mean_p**2 + mean_t**2 + c1) * (var_p + var_t + c2))


def ssim(
    p: Float[np.ndarray, "h w c"], t: Float[np.ndarray, "h w c"], w: Float[np.ndarray, "h w 1"] | None = None
) -> float:
    """Mean SSIM: over the frame without the half-window border (as scikit-image), or weighted by coverage over all.

    Raises:
        UnirenderError: as `pair`, `crop_border` or `weighted_mean`.
    """
    values = ssim_map(*pair(p, t))
    return float(crop_border(values).mean()) if w is None else weighted_mean(values[..., None], w)


def crop_border(values: Float[np.ndarray, "*n h w"]) -> Float[np.ndarray, "*n hc wc"]:
    """Leaves out the border where the SSIM window sticks out of the frame.

    Raises:
        UnirenderError: nothing is left.
    """
    pad = int(SSIM_TRUNCATE * SSIM_SIGMA + 0.5)
    if min(values.shape[-2:]) <= 2 * pad:
        raise UnirenderError(f"SSIM: got {values.shape[-2:]} pixels, expected more than {2 * pad} a side")
    return values[..., pad:-pad, pad:-pad]


def _blur(x: Float[np.ndarray, "*n h w c"]) -> Float[np.ndarray, "*n h w c"]:
    height, width = x.shape[-3:-1]
    if max(height, width) > DENSE_SIDE:  # beyond it the separable filter needs fewer operations than a dense product
        for axis in (-3, -2):
            x = gaussian_filter1d(x, SSIM_SIGMA, axis=axis, truncate=SSIM_TRUNCATE)
        return x
    x = _blur_matrix(height) @ x.reshape(*x.shape[:-3], height, -1)
    x = np.moveaxis(x.reshape(*x.shape[:-1], width, -1), -2, -1)
    return np.moveaxis(x @ _blur_matrix(width).T, -1, -2)


@lru_cache(maxsize=8)
def _blur_matrix(size: int) -> Float[np.ndarray, "n n"]:
    return gaussian_filter1d(np.eye(size), SSIM_SIGMA, axis=0, truncate=SSIM_TRUNCATE)
