"""Which directions an object hides from its own surfaces, by traced rays: what a network of its shadows learns from.

A group of `--vary visibility` has no lights and no pictures: `shared.exr` (albedo, normal, mask) and `visible.npy`, for
each pixel that is covered by half or more, in the order of the picture, one bit for each direction (uint8 [p, 64],
`numpy.packbits`). The directions are those of a lat-long map of `DIRECTIONS` texels, in camera axes, row by row. One
ray each, from a point of the surface drawn within the pixel: a bit is 1 where the ray meets nothing. Along the
silhouette points are drawn until they lie on the object. `json` says the rest.
"""

import io
import json
import time

import numpy as np
from jaxtyping import Bool, Float

from unirender.exr import exr_bytes, intrinsics_channels
from unirender.light.environment import environment_directions
from unirender_reference.arrays import components
from unirender_reference.backend import mitsuba
from unirender_reference.passes import derive_seed
from unirender_reference.plan import GroupPlan
from unirender_reference.render import Renderer, renderer_provenance

DIRECTIONS = (16, 32)
GEOMETRY_SPP = 25
COVERED = 0.5
_RAYS = 1 << 21  # at a time
TRIES = 32  # of a point that lies on the object; of a pixel that is half covered, one in 2^32 finds none


def visibility_members(plan: GroupPlan, renderer: Renderer) -> dict[str, bytes]:
    """The encoded files of a group by name.

    Args:
        plan: of the group.
        renderer: of its object, at the contract's camera.
    """
    start = time.perf_counter()
    geometry = renderer.geometry(GEOMETRY_SPP, derive_seed(plan.render_seed, "shared"))
    mask = geometry.require("mask")["mask"]
    visible = trace_visible(renderer, mask[..., 0] >= COVERED, derive_seed(plan.render_seed, "visibility"))
    renderer.counters.render_seconds += time.perf_counter() - start
    stored = io.BytesIO()
    np.save(stored, np.packbits(visible, axis=1))
    header = {**renderer_provenance(renderer), "spp": str(GEOMETRY_SPP), "seed": str(plan.render_seed)}
    record = {
        **header,
        "family": renderer.obj.family,
        "vary": "visibility",
        "camera": {"fov_deg": renderer.camera.fov_deg, "principal": list(renderer.camera.principal)},
        "coverage": round(float(mask.mean()), 6),
        "directions": list(DIRECTIONS),
        "object_provenance": dict(renderer.obj.provenance),
    }
    if plan.mesh is not None:
        record["file"] = plan.mesh.name
    return {
        "shared.exr": exr_bytes(intrinsics_channels(geometry), attributes=header),
        "visible.npy": stored.getvalue(),
        "json": json.dumps(record, sort_keys=True).encode(),
    }


def trace_visible(renderer: Renderer, surface: Bool[np.ndarray, "h w"], seed: int) -> Bool[np.ndarray, "p m"]:
    """Which of the directions are free, for each pixel of a surface, in the order of the picture.

    Args:
        renderer: of the object.
        surface: pixels to look from.
        seed: equal seeds draw equal points. A ray of a pixel in which `TRIES` points miss the object says nothing of a
            surface, and counts as free; so do all of a pixel that the object does not touch.
    """
    directions = environment_directions(*DIRECTIONS).reshape(-1, 3).astype(np.float32)
    rows, columns = np.nonzero(surface)
    rng, again = (np.random.default_rng(each) for each in (seed, (seed, 1)))
    found = np.ones((len(rows), len(directions)), bool)
    step = max(1, _RAYS // len(directions))
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        corner = np.repeat(np.stack([columns[part], rows[part]]), len(directions), axis=1)
        towards = np.tile(directions.T, (1, corner.shape[1] // len(directions)))
        free, hit = _free(renderer, corner + rng.random(corner.shape), towards)
        for _ in range(TRIES - 1):
            (missed,) = np.nonzero(~hit)
            if not len(missed):
                break
            place = corner[:, missed] + again.random((2, len(missed)))
            free[missed], hit[missed] = _free(renderer, place, towards[:, missed])
        found[part] = free.reshape(-1, len(directions))
    return found


def _free(
    renderer: Renderer, position: Float[np.ndarray, "2 n"], towards: Float[np.ndarray, "3 n"]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Whether rays from what is seen at positions of the picture, in pixels, meet nothing; whether anything is seen."""
    mi = mitsuba()
    scene = renderer.scene.show("principled", {})
    seen = mi.Point2f(*components((position / renderer.resolution).T))
    ray, _ = scene.sensors()[0].sample_ray_differential(0.0, 0.5, seen, mi.Point2f(0.5))
    coherent = True  # rays of one pixel follow each other
    surface = scene.ray_intersect(ray, mi.RayFlags.All, coherent)
    valid = surface.is_valid()
    blocked = scene.ray_test(surface.spawn_ray(mi.Vector3f(*components(towards.T))), valid)
    return np.array(~(valid & blocked)), np.array(valid)
