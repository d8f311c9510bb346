"""Light, roughness and metallic by Levenberg-Marquardt; base colour is eliminated (variable projection).

Unknowns are the logarithm of every light cell and channel and two numbers that are added to the pixels' roughness and
metallic. For these the best base colour is known in closed form (`pixel_fit`), so the ambiguity between light and
albedo, on which descent by gradients stalls, is solved for in every step (Golub and Pereyra 1973, in Kaufman's
approximation: the derivative of the eliminated scales is projected out). Priors: the light is smooth in log space, and
nearly neutral in colour.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from jaxtyping import Float
from scipy.linalg import get_blas_funcs

from unirender_reference.optimize.transport.material_mix import Mixed
from unirender_reference.optimize.transport.pixel_fit import SCALE_SPREAD, Appearance, PixelFit, Prediction
from unirender_reference.optimize.transport.roughness_nodes import NODES

LOG_RANGE = (-12.0, 9.0)
MOST_STEP = {"light": 1.5, "roughness": 0.25, "metallic": 0.3}
MOST_TRIALS = 5


@dataclass(frozen=True)
class LightPrior:
    """Strength of the priors, in units of the squared residuals.

    Attributes:
        smooth: weight of a difference of 1 in log radiance between neighbouring cells.
        neutral: weight of a difference of 1 in log radiance between a channel and the mean of the three.
    """

    smooth: float = 2.0
    neutral: float = 1.0

    def cost(self, fit: PixelFit, light: Float[np.ndarray, "j 3"]) -> float:
        steps = fit.transport.grid.differences @ light
        tint = light - light.mean(axis=1, keepdims=True)
        return float(self.smooth**2 * (steps**2).sum() + self.neutral**2 * (tint**2).sum())


@dataclass(frozen=True)
class Solved:
    """An appearance, what it predicts, and its cost with the priors."""

    appearance: Appearance
    mixed: Mixed
    prediction: Prediction
    cost: float


def evaluate(fit: PixelFit, appearance: Appearance, prior: LightPrior, robust: np.ndarray | None = None) -> Solved:
    """The cost of an appearance; without weights from before, scales are chosen twice."""
    mixed, light = fit.mixed(appearance), appearance.radiance
    if robust is None:
        robust = fit.predict(mixed, light).robust
    prediction = fit.predict(mixed, light, robust)
    return Solved(appearance, mixed, prediction, prediction.cost + prior.cost(fit, appearance.light))


def solve_light(
    fit: PixelFit,
    start: Appearance,
    prior: LightPrior,
    iterations: int,
    tolerance: float = 2e-3,
) -> Solved:
    """The least cost that Levenberg-Marquardt finds from `start`.

    Args:
        iterations: at most.
        tolerance: ends where a step lowers the cost by less than this share.
    """
    present, damping = evaluate(fit, start, prior), 1e-2
    for _ in range(iterations):
        hessian, gradient = _normal_equations(fit, present, prior)
        for _ in range(MOST_TRIALS):
            stepped = _stepped(present.appearance, hessian, gradient, damping)
            if stepped is not None:
                trial = evaluate(fit, stepped, prior, present.prediction.robust)
                if trial.cost < present.cost:
                    break
            damping = max(damping, 1e-3) * 6
        else:
            return present
        gain = 1 - trial.cost / present.cost
        present, damping = trial, max(damping / 4, 1e-6)
        if gain < tolerance:
            return present
    return present


def _normal_equations(fit: PixelFit, solved: Solved, prior: LightPrior) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton Hessian (its upper triangle) and gradient, the scales projected out.

    Unknowns: light of R, of G, of B, roughness, metallic.
    """
    appearance, prediction, seen = solved.appearance, solved.prediction, fit.seen
    cells, light, tie = fit.transport.grid.count, appearance.radiance, SCALE_SPREAD**-2
    slopes = fit.material_slopes(appearance, prediction.base)
    weights = seen.weight * np.sqrt(prediction.robust)
    hessian, gradient = np.zeros((3 * cells + 2,) * 2, np.float32), np.zeros(3 * cells + 2)
    jacobian = np.empty((len(seen.patch), cells + 2), np.float32)
    (syrk,) = get_blas_funcs(("syrk",), dtype=np.float32)  # half a matrix product
    for c in range(3):
        weight = weights[:, c].astype(np.float32)
        inner = jacobian[:, :cells]
        np.multiply(solved.mixed.u, (prediction.base[:, c] * weight)[:, None], out=inner)
        inner += solved.mixed.v * weight[:, None]
        inner *= light[:, c]
        jacobian[:, cells], jacobian[:, cells + 1] = (weight * slope[:, c] for slope in slopes)
        by_scale = weight * prediction.gain[:, c].astype(np.float32)
        share = prediction.free[:, c] / np.sqrt(seen.sums @ (by_scale * by_scale) + tie)
        projected = (seen.sums @ (jacobian * by_scale[:, None])) * share[:, None].astype(np.float32)
        residual = weight * (prediction.radiance[:, c] - seen.radiance[:, c]).astype(np.float32)
        of_scale = share * (seen.sums @ (by_scale * residual) + tie * (prediction.scale[:, c] - fit.scale_prior))
        index = np.r_[np.arange(c * cells, (c + 1) * cells), 3 * cells, 3 * cells + 1]
        hessian[np.ix_(index, index)] += syrk(1.0, jacobian.T) - syrk(1.0, projected.T)
        gradient[index] += jacobian.T @ residual - projected.T @ of_scale.astype(np.float32)
    differences = fit.transport.grid.differences
    smooth = prior.smooth**2 * (differences.T @ differences).toarray()
    tint = appearance.light - appearance.light.mean(axis=1, keepdims=True)
    diagonal = np.arange(cells)
    for c in range(3):
        own = slice(c * cells, (c + 1) * cells)
        hessian[own, own] += smooth
        gradient[own] += smooth @ appearance.light[:, c] + prior.neutral**2 * tint[:, c]
        for other in range(3):
            hessian[c * cells + diagonal, other * cells + diagonal] += prior.neutral**2 * ((c == other) - 1 / 3)
    return hessian, gradient


def _stepped(appearance: Appearance, hessian: np.ndarray, gradient: np.ndarray, damping: float) -> Appearance | None:
    """A step; None where the damping is too little for a factorisation in single precision."""
    damped = hessian.copy()
    diagonal = np.arange(len(damped))
    damped[diagonal, diagonal] += damping * damped[diagonal, diagonal] + 1e-6
    try:
        factor = scipy.linalg.cho_factor(damped, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        return None
    step = -scipy.linalg.cho_solve(factor, gradient.astype(np.float32), check_finite=False).astype(np.float64)
    light = step[:-2].reshape(3, -1).T.clip(-MOST_STEP["light"], MOST_STEP["light"])
    roughness, metallic = (
        float(np.clip(value, -MOST_STEP[name], MOST_STEP[name]))
        for name, value in zip(("roughness", "metallic"), step[-2:], strict=True)
    )
    return replace(
        appearance,
        light=np.clip(appearance.light + light, *LOG_RANGE),
        roughness=np.clip(appearance.roughness + roughness, NODES[0], 1),
        metallic=np.clip(appearance.metallic + metallic, 0, 1),
    )
