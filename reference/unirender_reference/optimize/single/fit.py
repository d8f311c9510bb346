"""The solver of single-view optimisation: Levenberg-Marquardt over log albedo, log light and two material offsets.

Unknown are u (n, 3), the change of log albedo at each pixel, and theta = (e, g, delta_m, delta_r): the coarse log light
of each channel, the channels' gains, and what is added to metallic and roughness of all pixels. The picture is

    I = b (U E) + V E,    E = exp(log E_0 + P e)

with the matrices of the material (`transport.material_mix`), and the cost

    sum of Huber(w (I - I_seen))  +  u^T Q u  +  e^T K e  +  g^T K_g g  +  (delta_m / s_m)^2  +  (delta_r / s_r)^2

with w = d display / d linear over the expected misfit; light beyond a saturated value costs nothing. The u are
eliminated from each step channel by channel: their block of the Hessian is sparse, Q plus a diagonal.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu

from unirender_reference.optimize.numerics.robust import HUBER
from unirender_reference.optimize.numerics.tone import tone_slope
from unirender_reference.optimize.single.config import Priors
from unirender_reference.optimize.single.pixels import PicturePixels
from unirender_reference.optimize.single.priors import (
    LIGHT_GRID,
    albedo_precision,
    gain_precision,
    light_interpolation,
    light_precision,
)
from unirender_reference.optimize.transport.material_mix import Lobes, Mixed, lobes_at, material_slopes, mixed
from unirender_reference.optimize.transport.roughness_nodes import NODES

DARKEST = 0.02  # log albedo is log(albedo + DARKEST)
TOP = 400.0  # precision that holds log albedo below that of 1
LOG_RADIANCE = (-8.0, 9.0)
FINISHED = 2e-3  # relative gain of a step below which the search ends


@dataclass(frozen=True)
class Eliminated:
    """How one channel of u follows from a move of theta, `scale` of a full step: du = -(scale still + slope move)."""

    index: Int[np.ndarray, " t"]  # the entries of theta that the channel depends on, of which `move` is taken
    slope: Float[np.ndarray, "n t"]
    still: Float[np.ndarray, " n"]  # -du of a full step where theta stays


@dataclass(frozen=True)
class Unknowns:
    """A point of the search: u (n, 3), e (3 c,), g (3,), and the offsets of metallic and roughness."""

    pixel: Float[np.ndarray, "n 3"]
    light: Float[np.ndarray, " c"]
    gain: Float[np.ndarray, "3"]
    metallic: float = 0.0
    roughness: float = 0.0


@dataclass(frozen=True)
class Model:
    """The picture b (U E) + V E at a point, and what its derivatives need.

    Attributes:
        metallic, roughness: of each pixel.
        lobes: matrices at that roughness.
        mixed: U and V.
        environment: E.
        exponent: exp of log albedo, below that of 1.
        albedo: b.
        above: by how much log albedo is above that of 1.
        image: premultiplied.
    """

    metallic: Float[np.ndarray, "n 1"]
    roughness: Float[np.ndarray, "n 1"]
    lobes: Lobes
    mixed: Mixed
    environment: Float[np.ndarray, "j 3"]
    exponent: Float[np.ndarray, "n 3"]
    albedo: Float[np.ndarray, "n 3"]
    above: Float[np.ndarray, "n 3"]
    image: Float[np.ndarray, "n 3"]


class Fit:
    """One picture, its start and its priors.

    Args:
        picture: with start maps albedo, roughness and metallic.
        log_light: (j, 3) log radiance of the start.
        priors: widths about the start.
        noise: expected misfit in display values.
    """

    def __init__(
        self, picture: PicturePixels, log_light: Float[np.ndarray, "j 3"], priors: Priors, noise: float
    ) -> None:
        self.picture, self.priors = picture, priors
        self.log_albedo = np.log(picture.maps["albedo"] + DARKEST)
        self.log_light = log_light
        self.interpolation = light_interpolation(picture.transport.grid)
        self.coarse = LIGHT_GRID[0] * LIGHT_GRID[1]
        self.slope = tone_slope(picture.radiance / picture.coverage)
        self.noise = noise
        self.q = albedo_precision(picture.display, picture.coverage, picture.pairs, priors)
        self.k_light, self.k_gain = light_precision(priors), gain_precision(priors)
        self._lobes: tuple[float, Lobes] | None = None

    def start(self) -> Unknowns:
        return Unknowns(np.zeros_like(self.log_albedo), np.zeros(3 * self.coarse), np.zeros(3))

    def level(self) -> float:
        """Log of the factor by which the start's light must change for the start's picture to be as bright as seen."""
        image = self.model(self.start()).image
        return float(np.log(max(self.picture.radiance.sum(), 1e-6) / max(image.sum(), 1e-9)))

    def brightness(
        self, at: Unknowns, albedo: Float[np.ndarray, "n 3"], light: Float[np.ndarray, "j 3"]
    ) -> Float[np.ndarray, "3"]:
        """The factor of each channel of a light under which maps are as bright as the picture: least squares of display
        values to first order, without those that are saturated.

        Args:
            at: the materials.
            albedo: of the pixels.
            light: radiance of the texels.
        """
        u, v = self.model(at).mixed
        image = albedo * (u @ light.astype(np.float32)) + v @ light.astype(np.float32)
        weight = np.where(self.picture.saturated, 0, np.square(self.slope)) * image
        seen, shown = ((weight * values).sum(axis=0) for values in (self.picture.radiance, image))
        return np.where(shown > 0, seen / np.maximum(shown, 1e-12), 1)

    def materials(self, at: Unknowns) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1"]]:
        maps = self.picture.maps
        metallic = np.clip(maps["metallic"] + at.metallic, 0, 1)
        return metallic, np.clip(maps["roughness"] + at.roughness, NODES[0], NODES[-1])

    def _lobes_at(self, offset: float, roughness: Float[np.ndarray, "n 1"]) -> Lobes:
        """Kept until the offset of roughness changes."""
        if self._lobes is None or self._lobes[0] != offset:
            self._lobes = offset, lobes_at(self.picture.transport, roughness[:, 0])
        return self._lobes[1]

    def environment(self, at: Unknowns) -> Float[np.ndarray, "j 3"]:
        change = self.interpolation @ at.light.reshape(3, self.coarse).T
        return np.exp(np.clip(self.log_light + change, *LOG_RADIANCE))

    def model(self, at: Unknowns) -> Model:
        metallic, roughness = self.materials(at)
        lobes = self._lobes_at(at.roughness, roughness)
        u, v = matrices = mixed(lobes, metallic[:, 0])
        log_albedo, top = self.log_albedo + at.gain + at.pixel, np.log(1 + DARKEST)
        exponent = np.exp(np.minimum(log_albedo, top))
        albedo, above = np.maximum(exponent - DARKEST, 0), np.maximum(log_albedo - top, 0)
        environment = self.environment(at)
        light = environment.astype(np.float32)
        image = albedo * (u @ light) + v @ light
        return Model(metallic, roughness, lobes, matrices, environment, exponent, albedo, above, image)

    def residuals(self, model: Model) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """w (I - I_seen), and the weight of each under Huber's loss (0 beyond saturated values)."""
        residual = self.slope / self.noise * (model.image - self.picture.radiance)
        beyond = self.picture.saturated & (residual > 0)
        residual = np.where(beyond, 0, residual)
        share = np.where(beyond, 0, HUBER.weight(np.abs(residual)))
        return residual, share

    def misfit(self, model: Model) -> float:
        """Root mean square of display values, by coverage."""
        residual = np.minimum(np.abs(self.residuals(model)[0]) * self.noise, 0.3)
        return float(np.sqrt(np.square(residual).mean() / np.mean(self.picture.coverage)))

    def cost(self, at: Unknowns, model: Model) -> float:
        data = HUBER.cost(np.abs(self.residuals(model)[0])).sum()
        pixels = np.sum(at.pixel * (self.q @ at.pixel)) + TOP * np.square(model.above).sum()
        light, gain = at.light @ self.k_light @ at.light, at.gain @ self.k_gain @ at.gain
        return float(data + pixels + light + gain + self._material_cost(at))

    def _material_cost(self, at: Unknowns) -> float:
        return (at.metallic / self.priors.metallic) ** 2 + (at.roughness / self.priors.roughness) ** 2

    def normal_equations(
        self, at: Unknowns, model: Model, damping: float
    ) -> tuple[Float[np.ndarray, "t t"], Float[np.ndarray, " t"], list[Eliminated]]:
        """Hessian and half gradient of theta with u eliminated; per channel how u follows from theta."""
        c, light = self.coarse, model.environment.astype(np.float32)
        hessian, gradient = np.zeros((3 * c + 5, 3 * c + 5)), np.zeros(3 * c + 5)
        hessian[: 3 * c, : 3 * c], gradient[: 3 * c] = self.k_light, self.k_light @ at.light
        gains = slice(3 * c, 3 * c + 3)
        hessian[gains, gains], gradient[gains] = self.k_gain, self.k_gain @ at.gain
        for place, offset, width in (
            (-2, at.metallic, self.priors.metallic),
            (-1, at.roughness, self.priors.roughness),
        ):
            hessian[place, place], gradient[place] = width**-2, offset * width**-2
        residual, share = self.residuals(model)
        materials = model.roughness[:, 0], model.metallic[:, 0]
        by_roughness, by_metallic = material_slopes(self.picture.transport, *materials, model.albedo, light)
        u, v = model.mixed
        lit, eliminated = u @ light, []
        for k in range(3):
            root = np.sqrt(share[:, k])
            weight = self.slope[:, k] / self.noise * root
            jacobian = np.empty((len(weight), c + 3))
            rows = model.albedo[:, k : k + 1].astype(np.float32) * u + v
            jacobian[:, :c] = (rows * light[:, k] * weight[:, None].astype(np.float32)) @ self.interpolation
            free, held = model.above[:, k] == 0, TOP * (model.above[:, k] > 0)
            own = weight * lit[:, k] * model.exponent[:, k] * free
            jacobian[:, c] = own
            jacobian[:, c + 1], jacobian[:, c + 2] = weight * by_metallic[:, k], weight * by_roughness[:, k]
            seen = root * residual[:, k]
            block = sparse.csc_array(self.q + sparse.diags_array(own**2 * (1 + damping) + held))
            factor = splu(block, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
            cross = own[:, None] * jacobian
            cross[:, c] += held
            pull = own * seen + self.q @ at.pixel[:, k] + TOP * model.above[:, k]
            solved = factor.solve(np.column_stack([cross, pull]))
            index = np.concatenate([np.arange(k * c, (k + 1) * c), [3 * c + k, 3 * c + 3, 3 * c + 4]])
            added = jacobian.T @ jacobian
            added[c, c] += held.sum()
            hessian[np.ix_(index, index)] += added - cross.T @ solved[:, :-1]
            gradient[index] += jacobian.T @ seen - cross.T @ solved[:, -1]
            gradient[3 * c + k] += TOP * model.above[:, k].sum()
            eliminated.append(Eliminated(index, solved[:, :-1], solved[:, -1]))
        return hessian, gradient, eliminated

    def step(
        self, at: Unknowns, model: Model, cost: float, damping: float, fixed: tuple[str, ...]
    ) -> tuple[Unknowns, Model, float, float, bool] | None:
        """One step: the new point, its model and cost, the next damping, whether the first try was taken. None: no
        step found that costs less."""
        hessian, gradient, eliminated = self.normal_equations(at, model, damping)
        for place, name in ((-2, "metallic"), (-1, "roughness")):
            if name in fixed:
                hessian[place], hessian[:, place], gradient[place] = 0, 0, 0
                hessian[place, place] = 1
        for trial in range(5):
            damped = hessian + damping * np.diag(np.diag(hessian))
            move = -scipy.linalg.solve(damped, gradient, assume_a="pos", check_finite=False)
            scale = min(1.0, 1.5 / np.abs(move[:-2]).max()) if np.abs(move[:-2]).max() > 0 else 1.0
            new = self._moved(at, move * scale, scale, eliminated)
            made = self.model(new)
            found = self.cost(new, made)
            if found < cost:
                return new, made, found, max(damping / 4, 1e-5), trial == 0
            damping *= 8
        return None

    def _moved(
        self,
        at: Unknowns,
        move: Float[np.ndarray, " t"],
        scale: float,
        eliminated: list[Eliminated],
    ) -> Unknowns:
        """The unknowns after a step of the solver, bounded; the eliminated ones follow."""
        maps, c = self.picture.maps, 3 * self.coarse
        metallic = at.metallic + float(np.clip(move[-2], -0.25, 0.25))
        roughness = at.roughness + float(np.clip(move[-1], -0.2, 0.2))
        metallic = float(np.clip(metallic, -maps["metallic"].max(), 1 - maps["metallic"].min()))
        low, high = NODES[0] - maps["roughness"].max(), NODES[-1] - maps["roughness"].min()
        roughness = float(np.clip(roughness, low, high))
        move = np.concatenate([move[:-2], [metallic - at.metallic, roughness - at.roughness]])
        follow = [-(of.still * scale + of.slope @ move[of.index]) for of in eliminated]
        pixel = at.pixel + np.clip(np.stack(follow, axis=1), -1, 1)
        return Unknowns(pixel, at.light + move[:c], at.gain + move[c : c + 3], metallic, roughness)
