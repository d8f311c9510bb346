"""How far a found light is from the true one: log-RMSE at the best scale, and the direction that it comes from, for
both of which the scale is free; `score_light` adds what it makes of two balls (`light_balls`).

Both lights are brought to 16 x 32 texels first (`resample_environment`, which keeps the energy). Notation: p
found, t true, w the texels' solid angles, eps = `metrics.LOG_EPSILON`.
"""

import functools
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions, sample_environment, texel_solid_angles
from unirender.light.resampling import resample_environment
from unirender_evaluation import metrics
from unirender_evaluation.light_balls import ball_values
from unirender_evaluation.metrics import LOG_EPSILON, LOWER, Metric

SHAPE = (16, 32)
CONE_DEG = 10.0  # half-angle of the cone that a lamp is looked for with
CONE_SHAPE = (46, 90)  # directions and quadrature of the cones: 4 degrees
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
LARGEST_SCALE = 1e4  # of k, either way, times that of equal energy
DIMMEST = 1e-12  # no light has less radiance at its brightest: the factor that would make it the true one overflows
UNIFORM = 1e-3  # relative differences below which a light has no brightest direction: of all cones, or all around

SCALED_LOG_RMSE = Metric(
    "log_rmse_scaled",
    "log-RMSE",
    "",
    LOWER,
    0.0,
    (),
    3,
    f"min over one factor k of sqrt(sum w (ln(k p + {LOG_EPSILON}) - ln(t + {LOG_EPSILON}))^2 / sum w), "
    f"{SHAPE[0]} x {SHAPE[1]} texels, w solid angle",
)
PEAK_ANGLE = Metric(
    "peak_deg",
    "angle",
    "deg",
    LOWER,
    0.0,
    (),
    0,
    f"between the brightest directions (centroid of the luminance in the cone of {CONE_DEG:g} degrees that holds the "
    "most); 90 for a uniform light",
)


def light_values(found: Float[np.ndarray, "h w 3"], true: Float[np.ndarray, "th tw 3"]) -> dict[str, float]:
    """Metric key -> value of a light, both metrics.

    Args:
        found: lat-long radiance, any resolution, any scale.
        true: the same; both in the same axes.
    """
    p, t = (resample_environment(light, SHAPE) for light in (found, true))
    return {
        metrics.metric_key("environment", SCALED_LOG_RMSE): scaled_log_rmse(p, t),
        metrics.metric_key("environment", PEAK_ANGLE): peak_angle_deg(p, t),
    }


def score_light(found: Intrinsics | None, true: Intrinsics | None) -> dict[str, float]:
    """Metric key -> value of the light among a method's maps, as it is and with its scale free; empty where one of the
    two has none. Where the true light has no brightest direction there is no angle.

    Args:
        found: with its `environment`, any resolution; what is below 0 (ringing) counts as 0.
        true: the same.

    Raises:
        UnirenderError: the found light is black.
    """
    if found is None or true is None or found.environment is None or true.environment is None:
        return {}
    light = np.maximum(found.environment, 0)
    values = {**light_values(light, true.environment), **ball_values(light, true.environment)}
    if brightest_direction(resample_environment(true.environment, SHAPE)) is None:
        del values[metrics.metric_key("environment", PEAK_ANGLE)]
    return values


def scaled_log_rmse(p: Float[np.ndarray, "h w 3"], t: Float[np.ndarray, "h w 3"]) -> float:
    """The log-RMSE of `k p` against `t` for the best single factor k, weighted by solid angle.

    Raises:
        UnirenderError: `p` is black, which no factor makes a light.
    """
    from scipy.optimize import minimize_scalar  # half a second, which tables of stored results do without

    if not p.max() > DIMMEST:
        raise UnirenderError(f"light metric: the found light is black, expected radiance above {DIMMEST:g}")
    w = texel_solid_angles(*p.shape[:2])[..., None]

    def error(log_scale: float) -> float:
        return metrics.log_rmse(p * math.exp(log_scale), t, w)

    limit = math.log(LARGEST_SCALE)
    equal = math.log(max(float((w * t).sum()), LOG_EPSILON) / float((w * p).sum()))  # ln k of equal energy
    grid = equal + np.linspace(-limit, limit, 41)
    start = grid[int(np.argmin([error(k) for k in grid]))]
    step = grid[1] - grid[0]
    best: Any = minimize_scalar(error, bounds=(start - step, start + step), method="bounded")
    return float(best.fun)


def peak_angle_deg(p: Float[np.ndarray, "h w 3"], t: Float[np.ndarray, "h w 3"]) -> float:
    """Angle between the brightest directions of two lights, in degrees; 90, the mean over random directions, where one
    of them has none."""
    a, b = brightest_direction(p), brightest_direction(t)
    if a is None or b is None:
        return 90.0
    chord = float(np.linalg.norm(a - b))
    return float(np.degrees(2 * np.arcsin(min(chord / 2, 1.0))))


def brightest_direction(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 3"] | None:
    """Unit centroid of the luminance in the cone of `CONE_DEG` that holds the most of it, weighted by solid angle; None
    for uniform light, and for one that is the same all around.

    Cones are centred on, and integrated over, the texel directions of a grid of `CONE_SHAPE`, between which the light
    is bilinear.
    """
    directions, weights, inside = _cones()
    luminance = sample_environment(environment, directions).astype(np.float64) @ LUMINANCE * weights
    means = inside @ luminance
    around = np.ptp(environment @ LUMINANCE, axis=1).max() <= UNIFORM * float(environment.max())
    if around or np.ptp(means) <= UNIFORM * means.max():
        return None
    best = int(np.argmax(means))
    centroid = (luminance * inside[best]) @ directions.astype(np.float64)
    return centroid / np.linalg.norm(centroid)


@functools.cache
def _cones() -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Directions, their solid angles, and which lie in the cone around each: row i is the cone around direction i.

    Rows are divided by their cone's own solid angle on the grid, which varies by the grid's coarseness.
    """
    directions = environment_directions(*CONE_SHAPE).reshape(-1, 3)
    weights = texel_solid_angles(*CONE_SHAPE).ravel().astype(np.float64)
    inside = (directions @ directions.T >= math.cos(math.radians(CONE_DEG))).astype(np.float32)
    return directions, weights, inside / (inside @ weights)[:, None].astype(np.float32)
