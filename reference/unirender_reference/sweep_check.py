"""A sweep against brute force, one render for each pair of roughness and metallic: time, values, error.

Notation: R roughness values, M metallic values; arrays of pairs are [R, M, h, w, c].
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.color import image_srgb, unpremultiply
from unirender_reference.backend import mitsuba
from unirender_reference.integrators import path_integrator
from unirender_reference.noise import masked_noise_mse
from unirender_reference.passes import derive_seed
from unirender_reference.render import IMAGE_DEPTH, Renderer
from unirender_reference.statistics import ZTest, z_test
from unirender_reference.sweep import QUADRATIC, Sweep, render_sweep

Environment = Float[np.ndarray, "eh ew 3"]
Mask = Float[np.ndarray, "h w 1"]


@dataclass(frozen=True)
class Pairs:
    """All pairs, each rendered by itself: mean and its variance."""

    mean: Float[np.ndarray, "r m h w 4"]
    variance: Float[np.ndarray, "r m h w 4"]


def brute_force(
    renderer: Renderer,
    environment: Environment,
    roughness_values: Sequence[float],
    metallic_values: Sequence[float],
    spp: int,
    seed: int,
    batches: int,
) -> Pairs:
    """Every pair with a seed of its own; arguments as `render_sweep`."""
    found = [
        [
            renderer.image(environment, r, m, spp, derive_seed(seed, "pair", i, j), IMAGE_DEPTH, batches)
            for j, m in enumerate(metallic_values)
        ]
        for i, r in enumerate(roughness_values)
    ]
    variances = [[pair.variance for pair in row if pair.variance is not None] for row in found]
    return Pairs(np.array([[pair.mean for pair in row] for row in found]), np.array(variances))


def compare(sweep: Sweep, brute: Pairs, mask: Mask, batches: int) -> ZTest:
    """z-test of all values of all pairs inside the mask."""
    tiled = np.broadcast_to(mask, (*sweep.mean.shape[:-1], 1)).reshape(-1, mask.shape[1], 1)
    return z_test(
        _stacked(sweep.mean),
        _stacked(_variance(sweep)),
        _stacked(brute.mean),
        _stacked(brute.variance),
        tiled,
        batches_a=batches,
        batches_b=batches,
    )


def error_ratios(sweep: Sweep, brute: Pairs, mask: Mask) -> tuple[float, float]:
    """The sweep's error in units of brute force's, mean over all pairs: in linear light, and as displayed.

    The display's slopes are taken at the mean of both: at one's own, a dark pixel whose light that one missed counts
    for the other alone.
    """
    variance, middle = _variance(sweep), (sweep.mean + brute.mean) / 2

    def displayed(noise: Float[np.ndarray, "r m h w 4"]) -> float:
        pairs = zip(np.split(_stacked(middle), count), np.split(_stacked(noise), count), strict=True)
        return sum(masked_noise_mse(mean, own, mask, premultiplied=True) for mean, own in pairs)

    count = middle.shape[0] * middle.shape[1]
    linear = float((mask * variance[..., :3]).sum() / (mask * brute.variance[..., :3]).sum())
    return linear, displayed(variance) / displayed(brute.variance)


def _stacked(pairs: Float[np.ndarray, "r m h w 4"]) -> Float[np.ndarray, "n w 3"]:
    """The RGB of all pairs below one another."""
    return pairs[..., :3].reshape(-1, pairs.shape[3], 3)


def _variance(sweep: Sweep) -> Float[np.ndarray, "r m h w 4"]:
    assert sweep.variance is not None, "of several batches"
    return sweep.variance


def row_times(
    renderer: Renderer,
    environment: Environment,
    roughness_values: Sequence[float],
    metallic_values: Sequence[float],
    spp: int,
    nodes: Sequence[float] = QUADRATIC,
) -> tuple[float, float]:
    """Seconds of bare `mi.render` calls, one for each pair, and of the sweep with the same error.

    Row by row in turn, so that other work on the machine slows both; kernels are compiled beforehand.
    """
    mi = mitsuba()
    integrator = path_integrator(IMAGE_DEPTH)

    def bare(roughness: float) -> None:
        for number, metallic in enumerate(metallic_values):
            scene = renderer.scene.show("principled", {"roughness": roughness, "metallic": metallic})
            np.array(mi.render(scene, integrator=integrator, spp=spp, seed=number))

    def ours(roughness: float) -> None:
        render_sweep(renderer, environment, [roughness], metallic_values, spp, batches=1, nodes=nodes)

    ours(roughness_values[0])
    bare(roughness_values[0])
    seconds = {bare: 0.0, ours: 0.0}
    for roughness in roughness_values:
        for way in seconds:
            start = time.perf_counter()
            way(roughness)
            seconds[way] += time.perf_counter() - start
    return seconds[bare], seconds[ours]


def difference_noise(
    renderer: Renderer,
    environment: Environment,
    roughness_values: Sequence[float],
    metallic_values: Sequence[float],
    mask: Mask,
    spp: int,
    *,
    common_seeds: bool,
) -> float:
    """Variance, displayed, of the difference between neighbours in roughness, from two independent sweeps."""

    def steps(seed: int) -> Float[np.ndarray, "s m h w 3"]:
        sweep = render_sweep(
            renderer, environment, roughness_values, metallic_values, spp, seed, 1, common_seeds=common_seeds
        )
        coverage = np.broadcast_to(mask, (*sweep.mean.shape[:-1], 1))
        return np.diff(image_srgb(unpremultiply(sweep.mean[..., :3], coverage)), axis=0)

    spread = np.square(steps(11) - steps(12)) / 2
    return float((mask * spread).sum() / (mask.sum() * spread.shape[-1] * spread.shape[0] * spread.shape[1]))


def cubic_bias(
    renderer: Renderer, environment: Environment, roughness: float, mask: Mask, spp: int, seed: int, batches: int
) -> tuple[float, float]:
    """What three nodes leave out at depth 4, relative to the object's mean radiance, and its standard error.

    The cubic coefficient c is 4.5 times the third difference of renders at metallic 0, 1/3, 2/3 and 1; the polynomial
    through 0, 1/2 and 1 misses c m (m - 1/2) (m - 1), at most c sqrt(3) / 36.
    """
    renders = [
        renderer.image(environment, roughness, metallic, spp, derive_seed(seed, "cubic", k), batches=batches)
        for k, metallic in enumerate((0.0, 1 / 3, 2 / 3, 1.0))
    ]
    weights = 4.5 * np.sqrt(3) / 36 * np.array([-1.0, 3.0, -3.0, 1.0])
    area = mask.sum(dtype=np.float64) * 3
    means, errors = [], []
    for found in renders:
        assert found.variance is not None, "of several batches"
        means.append(float(found.mean[..., :3].sum(dtype=np.float64)) / area)
        errors.append(float(found.variance[..., :3].sum(dtype=np.float64)) / area**2)
    # Neighbouring channels share their samples: three fully correlated channels have three times the variance.
    spread = np.sqrt(3 * np.square(weights) @ np.array(errors))
    return float(weights @ np.array(means)) / float(np.mean(means)), float(spread) / float(np.mean(means))
