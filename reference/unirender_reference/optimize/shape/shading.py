"""How the shading of the points that pixels show changes with their normals, by Mitsuba's forward derivatives.

For each point, with direct light and its shadows as in `shader`: directions and densities are drawn with the present
normal and then held fixed (detached); only the BSDF with its cosine is differentiated, along two tangents.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from unirender_reference.arrays import aligned, components
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.solution_scene import solution_scene

MOST_LANES = 1 << 19  # samples of all points in one launch
LEAST_FACING = 0.05  # cosine of normal and view below which a point does not count


@dataclass(frozen=True)
class ShadedPoints:
    """Points under some pixels, with the derivative of their radiance.

    Attributes:
        pixel: flat index (view, row, column).
        face: which they lie on.
        share: (n, 3) barycentric coordinates: what the corners' normals count.
        radiance: (n, 3) linear, direct light only.
        derivative: (n, 3, 3) of the radiance's channels by a movement of the unit normal (world axes).
    """

    pixel: Int[np.ndarray, " n"]
    face: Int[np.ndarray, " n"]
    share: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    derivative: Float[np.ndarray, "n 3 3"]


def shade_points(
    solution: Solution, cameras: Cameras, pixel: Int[np.ndarray, " k"], samples: int, seed: int
) -> ShadedPoints:
    """The points at the centres of pixels; those that show nothing, or the surface edge on, are left out.

    Args:
        solution: mesh, textures, light.
        cameras: of all views.
        pixel: flat indices (view, row, column).
        samples: pairs of directions (light, BSDF) for each point, at least.
        seed: equal seeds draw equal directions.
    """
    mi = mitsuba()
    scene = solution_scene(solution)
    view, place = np.divmod(pixel, cameras.height * cameras.width)
    row, column = np.divmod(place, cameras.width)
    direction = cameras.rays(np.stack([column, row], axis=1) + 0.5, view)
    ray = mi.Ray3f(mi.Point3f(*components(cameras.center[view])), mi.Vector3f(*components(direction)))
    first = scene.ray_intersect_preliminary(ray)
    hit = first.compute_surface_interaction(ray)
    kept = np.flatnonzero(np.array(hit.is_valid()) & (np.array(hit.wi.z) > LEAST_FACING))
    at = np.array(first.prim_uv).T[kept]
    radiance, derivative = np.zeros((len(kept), 3)), np.zeros((len(kept), 3, 3))
    lanes = max(1, min(samples, MOST_LANES // max(len(kept), 1)))
    rounds = -(-samples // lanes)
    for index in range(rounds if len(kept) else 0):
        value, slope = _round(scene, ray, kept, lanes, seed * 8191 + index)
        radiance += value / rounds
        derivative += slope / rounds
    face = np.array(first.prim_index).astype(np.int64)[kept]
    return ShadedPoints(pixel[kept], face, np.column_stack([1 - at.sum(1), at]), radiance, derivative)


def _round(scene: Any, ray: Any, kept: np.ndarray, lanes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean radiance (n, 3) over `lanes` samples, and its derivative (n, 3, 3) by the normal."""
    mi = mitsuba()
    import drjit as dr

    count = len(kept) * lanes
    index = dr.gather(mi.UInt32, mi.UInt32(aligned(kept.astype(np.uint32))), dr.arange(mi.UInt32, count) // lanes)
    own = dr.gather(mi.Ray3f, ray, index)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), count)
    point = scene.ray_intersect(own)
    light, bsdf, context = scene.environment(), point.bsdf(), mi.BSDFContext()
    lit, _ = light.sample_direction(point, sampler.next_2d())
    drawn, _ = bsdf.sample(context, point, sampler.next_1d(), sampler.next_2d())
    reflected = dr.zeros(mi.DirectionSample3f, count)
    reflected.d = point.to_world(drawn.wo)
    lit_density = lit.pdf + bsdf.pdf(context, point, point.to_local(lit.d))
    drawn_density = drawn.pdf + light.pdf_direction(point, reflected)
    normal = mi.Vector3f(point.sh_frame.n)
    tangents = mi.coordinate_system(normal)
    incoming = []
    for towards, density, pdf in ((lit.d, lit_density, lit.pdf), (reflected.d, drawn_density, drawn.pdf)):
        sky = dr.zeros(mi.SurfaceInteraction3f, count)
        sky.wi = -towards
        counts = (pdf > 0) & ~scene.ray_test(point.spawn_ray(towards), pdf > 0)
        incoming.append((towards, dr.select(counts, light.eval(sky) / density, 0)))
    dr.eval(point, incoming, tangents)
    value, slopes = mi.Color3f(0), []
    for tangent in tangents:
        tilt = dr.zeros(mi.Float, count)
        dr.enable_grad(tilt)
        point.sh_frame = mi.Frame3f(dr.normalize(normal + tangent * tilt))
        point.wi = point.to_local(-own.d)
        radiance = mi.Color3f(0)
        for towards, weight in incoming:
            radiance += bsdf.eval(context, point, point.to_local(towards)) * weight
        dr.forward(tilt)
        slope, value = dr.grad(radiance), dr.detach(radiance)
        dr.eval(slope, value)
        slopes.append(slope)
    parts = [_mean(component, lanes) for vector in (value, *slopes, *tangents) for component in vector]
    radiance, first, second, one, two = np.stack(parts, axis=1).reshape(len(kept), 5, 3).transpose(1, 0, 2)
    return radiance, first[:, :, None] * one[:, None] + second[:, :, None] * two[:, None]


def _mean(values: Any, lanes: int) -> Float[np.ndarray, " n"]:
    import drjit as dr

    return np.array(dr.block_sum(values, lanes)) / lanes
