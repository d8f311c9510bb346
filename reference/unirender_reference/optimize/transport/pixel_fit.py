"""The model that the transport matrices make of the pixels, and how far it is from what they show.

Notation: N pixels, J light cells, E (J, 3) their radiance; b base colour, m metallic, r roughness of each pixel. With
the matrices mixed for (r, m) (`material_mix`), a pixel's radiance is linear in b and in E:

    I = b * (U E) + V E

The surface is cut into patches of about a pixel's footprint. Base colour is `pattern` (of each pixel, known) times one
scale for each patch and channel, which is eliminated: for any light and material the best scale has a closed form.

Residuals are differences of display values in units of `SIGMA`, to first order, under a robust loss; a pixel that shows
255 only says that the radiance is at least that.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from unirender_reference.optimize.numerics.robust import HUBER, Loss
from unirender_reference.optimize.numerics.tone import tone_slope
from unirender_reference.optimize.transport.material_mix import Mixed, lobes_at, material_slopes, mixed
from unirender_reference.optimize.transport.matrices import Transport

SIGMA = 0.01  # display values: rounding to 8 bits, and what the matrices leave out
SCALE_SPREAD = 0.5  # standard deviation of the patches' scales around their prior
LEAST_ALBEDO = 0.002

Pixels = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Observations:
    """What N pixels show.

    Attributes:
        radiance: premultiplied linear radiance.
        weight: residual per unit of radiance: d(display value) / d(radiance) / SIGMA.
        clipped: the pixel shows the largest value.
        coverage: of the mask.
        patch: which patch each pixel shows, 0 .. P-1.
    """

    radiance: Pixels
    weight: Pixels
    clipped: Bool[np.ndarray, "n 3"]
    coverage: Float[np.ndarray, " n"]
    patch: Int[np.ndarray, " n"]

    def __post_init__(self) -> None:
        count = len(self.patch)
        ones = np.ones(count, np.float32)
        incidence = sp.csr_matrix((ones, (self.patch, np.arange(count))), shape=(int(self.patch.max()) + 1, count))
        object.__setattr__(self, "_incidence", incidence)

    @property
    def sums(self) -> sp.csr_matrix:
        """(P, N): sums over patches."""
        return self._incidence  # pyright: ignore[reportAttributeAccessIssue] - set in __post_init__


def observe(
    radiance: Pixels, coverage: Float[np.ndarray, " n"], patch: Int[np.ndarray, " n"], clipped: Bool[np.ndarray, "n 3"]
) -> Observations:
    """Observations of premultiplied radiance.

    Args:
        radiance, coverage, patch, clipped: see `Observations`.
    """
    straight = radiance / np.maximum(coverage, 1e-3)[:, None]
    slope = tone_slope(straight)  # linear pictures: the curve goes on above what a display shows
    return Observations(
        radiance.astype(np.float32), (slope / SIGMA).astype(np.float32), clipped, coverage.astype(np.float32), patch
    )


def patches(position: Float[np.ndarray, "n 3"], size: float) -> Int[np.ndarray, " n"]:
    """A patch for each surface position: cubes of edge `size` that hold some."""
    cube = np.floor(position / size).astype(np.int64)
    return np.unique(cube, axis=0, return_inverse=True)[1].ravel()


@dataclass(frozen=True)
class Appearance:
    """An estimate of light and materials.

    Attributes:
        light: (J, 3) natural logarithm of the cells' radiance.
        roughness, metallic: of each pixel.
    """

    light: Float[np.ndarray, "j 3"]
    roughness: Float[np.ndarray, " n"]
    metallic: Float[np.ndarray, " n"]

    @property
    def radiance(self) -> Float[np.ndarray, "j 3"]:
        """E."""
        return np.exp(self.light).astype(np.float32)


@dataclass(frozen=True)
class Prediction:
    """What the model says, with the best scales.

    Attributes:
        base: b.
        gain: U E pattern: derivative of the radiance by the scale.
        radiance: I.
        residual: in units of SIGMA, before the robust loss.
        robust: the loss's weights of the squared residuals; 0 for a clipped pixel that the model is above of.
        scale: (P, 3) of the patches.
        free: (P, 3) where the scale lies inside its bounds.
        cost: robust squares of the residuals and of the scales' prior.
    """

    base: Pixels
    gain: Pixels
    radiance: Pixels
    residual: Pixels
    robust: Pixels
    scale: Float[np.ndarray, "p 3"]
    free: Bool[np.ndarray, "p 3"]
    cost: float


@dataclass(frozen=True)
class PixelFit:
    """Transport matrices and what the pixels show.

    Attributes:
        pattern: known variation of the base colour; ones where nothing is known.
        scale_prior: what the scales are drawn to: a grey where the pattern is ones, 1 for a known base colour.
        loss: of the residuals.
    """

    transport: Transport
    seen: Observations
    pattern: Pixels
    scale_prior: float
    loss: Loss = HUBER

    def coarse(self) -> "PixelFit":
        """The same for a light of half the rows and columns."""
        return replace(self, transport=self.transport.coarse())

    def mixed(self, appearance: Appearance) -> Mixed:
        """U and V for the pixels' materials."""
        return mixed(lobes_at(self.transport, appearance.roughness), appearance.metallic)

    def predict(self, mixed: Mixed, light: Float[np.ndarray, "j 3"], robust: Pixels | None = None) -> Prediction:
        """The model under a light (E), with the patches' best scales.

        Args:
            robust: weights of the squared residuals that the scales are chosen by; None: ones.
        """
        seen, tie = self.seen, SCALE_SPREAD**-2
        gain, rest = (mixed.u @ light) * self.pattern, mixed.v @ light
        weight = seen.weight if robust is None else seen.weight * np.sqrt(robust)
        slope = weight * gain
        down = seen.sums @ (slope * slope) + tie
        scale = (seen.sums @ (slope * weight * (seen.radiance - rest)) + tie * self.scale_prior) / down
        most = 1 / np.maximum(self._largest_pattern(), LEAST_ALBEDO)
        free = (scale > LEAST_ALBEDO) & (scale < most)
        scale = np.clip(scale, LEAST_ALBEDO, most)
        at_pixel = scale[seen.patch]
        radiance = at_pixel * gain + rest
        above = seen.clipped & (radiance > seen.radiance)
        residual = np.where(above, 0, seen.weight * (radiance - seen.radiance))
        size = np.abs(residual)
        return Prediction(
            base=(at_pixel * self.pattern).astype(np.float32),
            gain=gain,
            radiance=radiance,
            residual=residual,
            robust=np.where(above, 0, self.loss.weight(size)),
            scale=scale,
            free=free,
            cost=float(self.loss.cost(size).sum() + tie * ((scale - self.scale_prior) ** 2).sum()),
        )

    def material_slopes(
        self, appearance: Appearance, base: Pixels
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Derivatives of the radiance by roughness and by metallic."""
        return material_slopes(self.transport, appearance.roughness, appearance.metallic, base, appearance.radiance)

    def _largest_pattern(self) -> Float[np.ndarray, "p 3"]:
        largest = np.zeros((int(self.seen.patch.max()) + 1, 3), np.float32)
        np.maximum.at(largest, self.seen.patch, self.pattern)
        return largest
