"""Bilinear texture lookups as a sparse matrix."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from unirender.light.environment import hat_weights


def texel_weights(uv: Float[np.ndarray, "n 2"], size: int) -> sp.csr_matrix:
    """(n, size^2): what each texel counts in each lookup, as Mitsuba's `bitmap` reads a texture: bilinear, repeated."""
    across, down = (hat_weights(place * size - 0.5, size, wrap=True) for place in uv.T.astype(np.float64))
    x, y = (weights.indices.reshape(-1, 2) for weights in (across, down))
    u, v = (weights.data.reshape(-1, 2) for weights in (across, down))
    texels, weights = y[:, :, None] * size + x[:, None], v[:, :, None] * u[:, None]
    starts = 4 * np.arange(len(uv) + 1)
    shape = (len(uv), size**2)
    return sp.csr_matrix((weights.ravel().astype(np.float32), texels.ravel(), starts), shape=shape)
