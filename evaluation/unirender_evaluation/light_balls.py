"""A light by what it does: how a matte and a glossy white ball look under it.

Both balls are seen from afar along the camera's axis, in `SIZE` x `SIZE` pixels, the light far away. The matte one is
white and Lambertian: its pixels are the irradiance / pi at each normal that faces the viewer. The glossy one is
the s of roughness `GLOSSY` (F = 1, a GGX lobe, single scattering); mirror directions of a ball's pixels are spread
evenly over the sphere, so that it shows light from everywhere. Integrated over 32 x 64 texels, without noise
(`unirender.light.surface_light`): within about a hundredth of the mean.

Such balls are how estimates of light are usually compared, since what matters of a light is what it makes of things
put into it: a lamp of one texel and one smeared over two are the same to both, and far apart texel by texel.
"""

import functools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from unirender.light.surface_light import diffuse_light, lobe_light
from unirender_evaluation import metrics
from unirender_evaluation.metrics import SCALES, Variant, metric_key

SIZE = 32  # pixels of a ball that is scored; with 48 errors change by less than a hundredth of themselves
GLOSSY = 0.5  # perceptual roughness: a sharper lobe would ask for more than the 16 x 32 texels that methods predict
MATTE_BALL, GLOSSY_BALL = "ball_matte", "ball_glossy"  # quantities, as in metric keys
Ball = Float[np.ndarray, "size size 3"]


def ball_values(found: Float[np.ndarray, "h w 3"], true: Float[np.ndarray, "th tw 3"]) -> dict[str, float]:
    """Metric key -> relative RMSE of both balls: raw, and after one least-squares factor, or one for each channel.

    Args:
        found: lat-long radiance, any resolution.
        true: the same; both in camera axes.
    """
    w = ball_mask(SIZE)
    pictures, truth = balls(found, SIZE), balls(true, SIZE)
    return {
        metric_key(name, "rmse_relative", Variant(scale=scale)): metrics.rmse_relative(
            metrics.align_scale(pictures[name], truth[name], w, scale), truth[name], w
        )
        for name in pictures
        for scale in SCALES
    }


def balls(environment: Float[np.ndarray, "h w 3"], size: int) -> Mapping[str, Ball]:
    """Linear radiance of the matte and of the glossy ball, 0 outside `ball_mask`."""
    normal = ball_normals(size)
    there = ball_mask(size)[..., 0] > 0
    n = normal[there]
    view = np.broadcast_to(np.array([0, 0, 1], np.float32), n.shape)
    glossy = np.zeros_like(normal)
    glossy[there] = lobe_light(n, view, np.full(len(n), GLOSSY, np.float32), environment)
    return {MATTE_BALL: diffuse_light(normal, environment), GLOSSY_BALL: glossy}


@functools.cache
def ball_normals(size: int) -> Ball:
    """Unit normals of a ball that fills the picture, camera axes, at the pixels' centres; 0 outside."""
    x = (2 * np.arange(size) + 1) / size - 1
    x, y = np.meshgrid(x, -x)
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    return (normal * inside[..., None]).astype(np.float32)


@functools.cache
def ball_mask(size: int) -> Float[np.ndarray, "size size 1"]:
    """1 where the ball is, else 0."""
    return np.any(ball_normals(size) != 0, axis=-1, keepdims=True).astype(np.float32)
