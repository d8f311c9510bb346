"""Do two maps show the same place? Their likeness at the best yaw and mirroring, from local contrast alone.

Outdoor maps all have a bright sky over a dark ground, and suns dominate every plain correlation. So the log luminance
is high-passed (`SIGMA` texels), divided by its local strength, and freed of the mean of each row: what is left are
edges and textures. Likeness is the correlation of two such maps, weighted by solid angle, at the best whole-column yaw,
mirrored or not. A map has 1 with its own turned or mirrored copy. A *tilted* copy is not recognised.

(Measured on the 26 bundled maps: 0.99 for `sunrise`, the same capture in both packages; at most 0.26 for every other
pair. `unirender lights` prints the largest across the two splits: 0.20.)
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.color import luminance
from unirender.light.environment import texel_solid_angles
from unirender.light.resampling import resample_environment
from unirender_reference.lights.light import SHAPE, Light, normalized

SAME_PLACE = 0.5  # likeness from which two maps are taken for one place
SIGMA = 3.0  # texels of the high pass
DARK = 1e-3  # luminance, of a mean of 1, below which there is no contrast
FAINT = 0.02  # local strength of the log luminance, below which it is noise


@dataclass(frozen=True)
class Likeness:
    """A pair of lights and how alike they are, [-1, 1]."""

    first: str
    second: str
    value: float


def likeness(first: Float[np.ndarray, "h w 3"], second: Float[np.ndarray, "h2 w2 3"]) -> float:
    """Correlation of the local contrast of two environments at the best yaw, mirrored or not; 0 for an even one."""
    return _best(_spectrum(first), _spectrum(second))


def most_alike(first: Iterable[Light], second: Iterable[Light]) -> Iterator[Likeness]:
    """For each light of `first` the one of `second` that is most like it; the lights themselves are not kept."""
    others: Sequence[tuple[str, np.ndarray]] = [(light.name, _spectrum(light.environment)) for light in second]
    for light in first:
        spectrum = _spectrum(light.environment)
        value, name = max(((_best(spectrum, other), name) for name, other in others), default=(0.0, ""))
        if name:
            yield Likeness(light.name, name, value)


def _spectrum(environment: Float[np.ndarray, "h w 3"]) -> np.ndarray:
    """Fourier coefficients `[h w/2+1]` of the rows of the local contrast, of unit norm; zeros for an even map."""
    if environment.shape[:2] != SHAPE:
        environment = resample_environment(environment, SHAPE)
    log = np.log(luminance(normalized(environment)).astype(np.float64) + DARK)
    local = log - _blurred(log, SIGMA)
    local /= np.sqrt(_blurred(np.square(local), 2 * SIGMA) + FAINT**2)
    local -= local.mean(axis=1, keepdims=True)
    weighted = local * np.sqrt(texel_solid_angles(*SHAPE))
    norm = np.linalg.norm(weighted)
    return np.fft.rfft(weighted / norm if norm > FAINT else 0 * weighted, axis=1)


def _blurred(values: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur that wraps around the columns."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(gaussian_filter1d(values, sigma, axis=0, mode="nearest"), sigma, axis=1, mode="wrap")


def _best(first: np.ndarray, second: np.ndarray) -> float:
    """The largest circular cross-correlation of two maps; the conjugate of a row's spectrum is the row mirrored."""
    products = [(first * other).sum(axis=0) for other in (second.conj(), second)]
    return float(max(np.fft.irfft(product, n=SHAPE[1]).max() for product in products))
