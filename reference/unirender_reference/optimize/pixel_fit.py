"""The model that the transport matrices make of the pixels, and how far it is from what they show.

Notation: N pixels, J light cells, E (J, 3) their radiance; b base colour, m metallic, r roughness of each pixel. With
the matrices mixed for (r, m), a pixel's radiance is linear in b and in E:

    I = b * (U E) + V E,     U = (1-m) D + m (G - W),     V = (1-m) (F0 G + (1-F0) W) + m W

The surface is cut into patches of about a pixel's footprint. Base colour is `pattern` (of each pixel, known) times one
scale for each patch and channel, which is eliminated: for any light and material the best scale has a closed form.

Residuals are differences of display values in units of `SIGMA`, to first order, under Huber's loss; a pixel that shows
255 only says that the radiance is at least that.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from unirender.color import display_slope
from unirender_reference.optimize.roughness_nodes import node_weights
from unirender_reference.optimize.transport import F0, Transport

SIGMA = 0.01  # display values: rounding to 8 bits, and what the matrices leave out
HUBER = 4.0
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
        return self._incidence  # type: ignore[attr-defined]  - set in __post_init__


def observe(
    radiance: Pixels, coverage: Float[np.ndarray, " n"], patch: Int[np.ndarray, " n"], display: bool
) -> Observations:
    """Observations of premultiplied radiance.

    Args:
        display: it was decoded from display values, which end at 1; False: linear pictures.
    """
    straight = radiance / np.maximum(coverage, 1e-3)[:, None]
    clipped = (straight >= 1 - 1e-3) if display else np.zeros(straight.shape, bool)
    beyond = np.maximum(straight, 1) ** (1 / 2.4 - 1)  # linear pictures: the curve goes on above what a display shows
    slope = display_slope(np.minimum(straight, 1)) * beyond
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


class Mixed(NamedTuple):
    """The matrices of a material: I = b (U E) + V E."""

    u: Float[np.ndarray, "n j"]
    v: Float[np.ndarray, "n j"]


@dataclass(frozen=True)
class Prediction:
    """What the model says, with the best scales.

    Attributes:
        base: b.
        gain: U E pattern: derivative of the radiance by the scale.
        radiance: I.
        residual: in units of SIGMA, before the robust loss.
        robust: Huber's weights of the squared residuals, (0, 1]; 0 for a clipped pixel that the model is above of.
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
    """

    transport: Transport
    seen: Observations
    pattern: Pixels
    scale_prior: float

    def coarse(self) -> "PixelFit":
        """The same for a light of half the rows and columns."""
        return replace(self, transport=self.transport.coarse())

    def mixed(self, appearance: Appearance) -> Mixed:
        """U and V for the pixels' materials."""
        t = self.transport
        r, m = (a.astype(np.float32)[:, None] for a in (appearance.roughness, appearance.metallic))
        weights = node_weights(appearance.roughness)[0].astype(np.float32)
        gloss, schlick = _weighted(weights, t.gloss), _weighted(weights, t.schlick)
        u = t.diffuse[1] * r
        u += t.diffuse[2] * r**2
        u += t.diffuse[0]
        u *= 1 - m
        u += m * (gloss - schlick)
        gloss *= (1 - m) * F0
        schlick *= (1 - m) * (1 - F0) + m
        gloss += schlick
        return Mixed(u, gloss)

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
        huber = np.where(size > HUBER, 2 * HUBER * size - HUBER**2, size**2)
        return Prediction(
            base=(at_pixel * self.pattern).astype(np.float32),
            gain=gain,
            radiance=radiance,
            residual=residual,
            robust=np.where(above, 0, HUBER / np.maximum(size, HUBER)),
            scale=scale,
            free=free,
            cost=float(huber.sum() + tie * ((scale - self.scale_prior) ** 2).sum()),
        )

    def material_slopes(
        self, appearance: Appearance, base: Pixels
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Derivatives of the radiance by roughness and by metallic."""
        t, light = self.transport, appearance.radiance
        r, m = appearance.roughness[:, None], appearance.metallic[:, None]
        value, slope = node_weights(appearance.roughness)
        lit = [np.stack([matrix @ light for matrix in part]) for part in (t.gloss, t.schlick, t.diffuse)]
        gloss, schlick = (np.einsum("nk,knc->nc", value, part) for part in lit[:2])
        d_gloss, d_schlick = (np.einsum("nk,knc->nc", slope, part) for part in lit[:2])
        diffuse, d_diffuse = lit[2][0] + r * lit[2][1] + r**2 * lit[2][2], lit[2][1] + 2 * r * lit[2][2]
        fresnel, d_fresnel = F0 * gloss + (1 - F0) * schlick, F0 * d_gloss + (1 - F0) * d_schlick
        by_roughness = base * ((1 - m) * d_diffuse + m * (d_gloss - d_schlick)) + (1 - m) * d_fresnel + m * d_schlick
        by_metallic = base * (gloss - schlick - diffuse) + schlick - fresnel
        return by_roughness, by_metallic

    def _largest_pattern(self) -> Float[np.ndarray, "p 3"]:
        largest = np.zeros((int(self.seen.patch.max()) + 1, 3), np.float32)
        np.maximum.at(largest, self.seen.patch, self.pattern)
        return largest


def _weighted(weights: Float[np.ndarray, "n nodes"], matrices: tuple[Float[np.ndarray, "n j"], ...]) -> np.ndarray:
    used = [k for k in range(len(matrices)) if weights[:, k].any()]
    total = weights[:, used[0], None] * matrices[used[0]]
    for k in used[1:]:
        total += weights[:, k, None] * matrices[k]
    return total
