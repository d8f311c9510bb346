r"""The image as a sum of effects, each by its own estimator and its own seed.

At the surface point x that a camera ray meets, with f the BSDF (its cosine included), E the environment and V(x, l) = 1
where the ray from x along l leaves the scene, 0 where it meets the object again:

    unshadowed       integral f(l) E(l) dl                      direct light, as if nothing stood in its way
    shadow          -integral f(l) E(l) (1 - V(x, l)) dl        the part of it that the object blocks; never positive
    interreflection  integral f(l) L(x, l) (1 - V(x, l)) dl     L: the path-traced radiance of the point met along l

Their sum is the path-traced image. V is decided by the rays that the path tracer uses (`spawn_ray_to` for a light
sample, `spawn_ray` for a BSDF sample), so both agree at terminators, too, where a direction lies above the shading
surface and under the triangle: there it counts as lit and shadowed.
"""

from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba
from unirender_reference.integrators import path_integrator, python_integrator
from unirender_reference.materials import Surface, surface_parameters
from unirender_reference.passes import (
    TRUTH_BATCHES,
    Estimate,
    derive_seed,
    integrator_passes,
    mean_estimate,
    ratio_estimate,
)
from unirender_reference.render import DIRECT_DEPTH, IMAGE_DEPTH, MOST_DEPTH, Renderer

EFFECTS = ("unshadowed", "shadow", "interreflection")


@dataclass(frozen=True)
class Effects:
    """The three passes, premultiplied linear RGBA; alpha is the coverage in each of them."""

    unshadowed: Estimate
    shadow: Estimate
    interreflection: Estimate

    def total(self) -> Estimate:
        """The image: the sum of radiance and the mean of alpha, with their variances."""
        parts = [getattr(self, name) for name in EFFECTS]
        weight = np.array([1, 1, 1, 1 / len(parts)], np.float32)
        mean = np.sum([part.mean * weight for part in parts], axis=0)
        spread = [part.variance * weight**2 for part in parts if part.variance is not None]
        variance = np.sum(spread, axis=0) if len(spread) == len(parts) else None
        return Estimate(mean, variance, sum(part.nan_pixels for part in parts))


def render_effects(
    renderer: Renderer,
    environment: Float[np.ndarray, "h w 3"],
    roughness: float | None,
    metallic: float | None,
    spp: int,
    seed: int = 0,
    depth: int = IMAGE_DEPTH,
    batches: int = TRUTH_BATCHES,
) -> Effects:
    """The three passes of an image; arguments as `Renderer.image`, `spp` samples per pixel for each pass.

    Raises:
        UnirenderError: `depth` is no whole number of at least 2, or as `Renderer.image`.
    """
    if not isinstance(depth, Integral) or not DIRECT_DEPTH <= depth <= MOST_DEPTH:
        raise UnirenderError(
            f"depth: got {depth!r:.40}, expected a whole number from {DIRECT_DEPTH}, one bounce, to {MOST_DEPTH}"
        )
    scene = renderer.lit("principled", {"roughness": roughness, "metallic": metallic}, environment)
    integrators = {
        "unshadowed": python_integrator(_unshadowed),
        "shadow": python_integrator(_shadow),
        "interreflection": interreflection_integrator(depth),
    }
    passes = {
        name: integrator_passes(scene, integrator, spp, derive_seed(seed, name), batches, renderer.counters)
        for name, integrator in integrators.items()
    }
    return Effects(**{name: mean_estimate(*result, batches) for name, result in passes.items()})


def render_unshadowed(
    renderer: Renderer,
    surface: Surface,
    environment: Float[np.ndarray, "h w 3"],
    roughness: float | None,
    spp: int,
    seed: int = 0,
    batches: int = TRUTH_BATCHES,
) -> Estimate:
    """The unshadowed light of one of the contract's surfaces, divided by coverage: of `mirror` it is s without shadows,
    of `white` it is d without; arguments as `Renderer.specular`."""
    parameters = {"roughness": roughness} if "roughness" in surface_parameters(surface) else {}
    scene = renderer.lit(surface, parameters, environment)
    own = derive_seed(seed, "unshadowed", surface)
    passes = integrator_passes(scene, python_integrator(_unshadowed), spp, own, batches, renderer.counters)
    return ratio_estimate(*passes, batches)


def interreflection_integrator(depth: int) -> Any:
    """Light after two bounces or more: one BSDF sample, and the path tracer from the point that it meets."""
    path = path_integrator(depth - 1)

    def radiance(scene: Any, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any, list[Any]]:
        import drjit as dr

        mi = mitsuba()
        surface = scene.ray_intersect(ray, active)
        hit = active & surface.is_valid()
        drawn, weight = surface.bsdf(ray).sample(
            mi.BSDFContext(), surface, sampler.next_1d(hit), sampler.next_2d(hit), hit
        )
        reflected = hit & dr.any(weight != 0)
        onward = mi.RayDifferential3f(surface.spawn_ray(surface.to_world(drawn.wo)))
        light, met, _ = path.sample(scene, sampler, onward, None, reflected)
        return dr.select(reflected & met, weight * light, 0), hit, []

    return python_integrator(radiance)


def _unshadowed(scene: Any, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any, list[Any]]:
    hit, samples = _direct_samples(scene, sampler, ray, active)
    return sum(light for light, _ in samples), hit, []


def _shadow(scene: Any, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any, list[Any]]:
    import drjit as dr

    hit, samples = _direct_samples(scene, sampler, ray, active)
    blocked = [dr.select(scene.ray_test(towards, dr.any(light != 0)), light, 0) for light, towards in samples]
    return -sum(blocked), hit, []


def _direct_samples(scene: Any, sampler: Any, ray: Any, active: Any) -> tuple[Any, list[tuple[Any, Any]]]:
    """Direct light at the first hit, as if nothing stood in its way: one light sample and one BSDF sample.

    Returns:
        Where the camera ray meets the object; and for both strategies the radiance that the sample brings to the
        camera, weighted by multiple importance sampling, 0 where there is no sample, with the ray towards its light.
    """
    import drjit as dr

    mi = mitsuba()
    surface = scene.ray_intersect(ray, active)
    hit = active & surface.is_valid()
    bsdf, context, sky = surface.bsdf(ray), mi.BSDFContext(), scene.environment()

    towards, light = scene.sample_emitter_direction(surface, sampler.next_2d(hit), test_visibility=False, active=hit)
    lit = hit & (towards.pdf != 0)
    value, density = bsdf.eval_pdf(context, surface, surface.to_local(towards.d), lit)
    by_light = dr.select(lit, value * light * _power_heuristic(towards.pdf, density), 0)

    drawn, weight = bsdf.sample(context, surface, sampler.next_1d(hit), sampler.next_2d(hit), hit)
    reflected = hit & dr.any(weight != 0)
    onward = surface.spawn_ray(surface.to_world(drawn.wo))
    far, seen = dr.zeros(mi.SurfaceInteraction3f), dr.zeros(mi.DirectionSample3f)
    far.wi, seen.d, seen.emitter = -onward.d, onward.d, mi.EmitterPtr(sky)
    density = scene.pdf_emitter_direction(surface, seen, reflected)
    by_bsdf = weight * sky.eval(far, reflected) * _power_heuristic(drawn.pdf, density)
    by_bsdf = dr.select(reflected, by_bsdf, 0)
    return hit, [(by_light, surface.spawn_ray_to(towards.p)), (by_bsdf, onward)]


def _power_heuristic(pdf: Any, other: Any) -> Any:
    """Veach's weight of a strategy, exponent 2 as in Mitsuba; written so that large densities do not overflow."""
    import drjit as dr

    return dr.rcp(1 + dr.square(other / pdf))
