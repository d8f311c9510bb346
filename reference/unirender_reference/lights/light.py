"""`Light`: a distant light as a lat-long map, and the two things every light goes through.

Maps are linear Rec.709 radiance in camera axes, +y up, on the grid of `unirender.light.environment` (rows at theta =
pi i / (H - 1), columns at centres; the middle of the map is +z, behind the camera). A light has no exposure of its own:
its luminance, averaged over the sphere by solid angle, is 1 (but for files loaded with `normalise=False`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from unirender.color import luminance
from unirender.errors import UnirenderError
from unirender.intrinsics import check_radiance
from unirender.light.environment import check_shape, mean_radiance
from unirender.light.resampling import hat_weights, weighted_means
from unirender.shown import short_repr

if TYPE_CHECKING:
    from scipy.sparse import csr_array

SHAPE = (64, 128)
GAUSS_POINTS = 4  # a piece of a texel's hat: its energy to 1e-6 even where three rows span the sphere


@dataclass(frozen=True)
class Light:
    """A distant light.

    Attributes:
        name: without dots.
        environment: (h, w, 3) float32, >= 0, mean luminance 1 unless it was loaded as the file has it.
        provenance: how it was made, as text.
    """

    name: str
    environment: Float[np.ndarray, "h w 3"]
    provenance: Mapping[str, str] = field(default_factory=dict)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        e = self.environment
        if not isinstance(self.name, str) or not isinstance(e, np.ndarray):
            raise UnirenderError(
                f"light: got name {self.name!r:.40} and an environment of type {type(e).__name__}, expected a text and "
                "a numpy array; load_light reads a file"
            )
        if e.ndim != 3 or e.shape[2] != 3 or e.dtype != np.float32 or not np.isfinite(e).all() or e.min() < 0:
            raise UnirenderError(
                f"light {self.name}: environment must be finite float32 (h, w, 3) >= 0, got {e.dtype} {e.shape}; "
                "load_light makes one of a file; .astype(np.float32) converts an array"
            )
        if "." in self.name or "/" in self.name:
            raise UnirenderError(f"light name: got {self.name!r}, expected no '.' and no '/'; rename the light")


def normalized(environment: Float[np.ndarray, "h w 3"], name: str = "light") -> Float[np.ndarray, "h w 3"]:
    """The map scaled to mean luminance 1; errors as `mean_luminance`."""
    return (environment / mean_luminance(environment, name)).astype(np.float32)


def mean_luminance(environment: Float[np.ndarray, "h w 3"], name: str = "light") -> float:
    """Luminance of the map, averaged over the sphere by solid angle.

    Raises:
        UnirenderError: the map is black.
    """
    mean = float(luminance(mean_radiance(environment)[None])[0])
    if not mean > 1e-12:
        raise UnirenderError(f"{name}: mean luminance is {mean:g}, expected more than 0; give a map that is not black")
    return mean


def area_resampled(pixels: Float[np.ndarray, "h w 3"], shape: tuple[int, int]) -> Float[np.ndarray, "h2 w2 3"]:
    """A lat-long picture (pixels are areas: rows end at the poles) on the grid of `Light`, energy kept.

    Each texel is the mean of the picture under the texel's bilinear weight, so the total over the sphere stays.

    Raises:
        UnirenderError: the picture is none of finite radiance, or the shape none of a map.
    """
    check_shape(shape)
    check_radiance("light", pixels)
    pixels = np.asarray(pixels)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or not pixels.size or not np.isfinite(pixels).all():
        raise UnirenderError(
            f"light: got a picture of shape {pixels.shape}, expected finite radiance of shape [height, width, 3]"
        )
    (h, w), (h2, w2) = pixels.shape[:2], shape
    rows = _pixel_means(np.arange(h + 1) * (h2 - 1) / h, h2, lambda row: np.sin(row * np.pi / (h2 - 1)), wrap=False)
    columns = _pixel_means(np.arange(w + 1) * w2 / w - 0.5, w2, np.ones_like, wrap=True)
    out = np.empty((h2, w2, 3), np.float32)
    for k in range(3):
        out[..., k] = (columns @ (rows @ pixels[..., k].astype(np.float64)).T).T
    return out


def _pixel_means(
    borders: Float[np.ndarray, " b"], texels: int, measure: Callable[[np.ndarray], np.ndarray], wrap: bool
) -> "csr_array":
    """The matrix `[texels pixels]` of means over pixels under each texel's hat.

    Args:
        borders: of the pixels, in texel positions.
        texels: of the grid, at 0, 1, 2, ...
        measure: density at texel positions.
        wrap: whether the first texel follows the last.
    """
    from scipy.sparse import csr_array

    cuts = np.union1d(borders, np.arange(np.ceil(borders[0]), borders[-1]))  # smooth between these
    nodes, shares = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    step = np.diff(cuts)[:, None]
    points = (cuts[:-1, None] + step * (nodes + 1) / 2).ravel()
    means = weighted_means(hat_weights(points, texels, wrap), (step * shares).ravel() * measure(points))
    pixel = np.searchsorted(borders[1:-1], points)
    one = np.ones(len(points)), (np.arange(len(points)), pixel)
    return csr_array(means @ csr_array(one, shape=(len(points), len(borders) - 1)))
