"""Mitsuba shades an `Intrinsics`: one surface point per pixel, from its normal and material, under an environment.

The radiance that leaves pixel x towards the viewer along v is, with the principled BSDF f of the pixel,

    L(x) = integral of f(l, v) E(l) max(n . l, 0) dl

estimated with one light sample and one BSDF sample per sample, combined by the balance heuristic. There is no geometry:
no shadows, no interreflection, and one normal per pixel where a render averages many. `shade` of the true maps is
therefore a row of its own in the tables, and the ceiling of every closed loop.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_reference.backend import mitsuba
from unirender_reference.passes import SAMPLES_PER_PASS, Counters, derive_seed, finite_pass, pass_count
from unirender_reference.scene import envmap_data

LEAST_FACING = 0.01  # cosine to which normals that face away from the viewer are bent


def shade(
    intrinsics: Intrinsics,
    environment: Float[np.ndarray, "eh ew 3"] | None = None,
    spp: int = 256,
    seed: int = 0,
    counters: Counters | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """The image of given maps under a light: linear, premultiplied by the mask (all ones where the mask is None).

    Args:
        intrinsics: needs albedo, normal, roughness and metallic; normals of 0 give black.
        environment: lat-long radiance in camera axes, display units; the intrinsics' own if None.
        spp: samples per pixel (each one light sample and one BSDF sample).
        seed: equal seeds give equal images.
        counters: if given, its `nan_pixels` grows by the points that came out NaN or infinite in some pass and were
            shaded again with another seed.

    Raises:
        UnirenderError: a map is missing, the environment is not usable, or a point stays NaN.
    """
    maps = intrinsics.require("albedo", "normal", "roughness", "metallic")
    if environment is None:
        environment = intrinsics.require("environment")["environment"]
    height, width = intrinsics.height, intrinsics.width
    if maps["normal"].ndim != 3:
        raise UnirenderError(f"shade: got maps of shape {maps['normal'].shape}, expected one picture (h, w, c)")
    image = np.zeros((height, width, 3), np.float32)
    inside = np.any(maps["normal"] != 0, axis=-1)
    if inside.any() and np.max(environment) > 0:
        view = intrinsics.camera.view_directions(height, width)[inside]
        normal = facing_normals(maps["normal"][inside], view)
        material = {name: maps[name][inside] for name in ("albedo", "roughness", "metallic")}
        image[inside] = _radiance(normal, view, material, environment, spp, seed, counters or Counters())
    return image if intrinsics.mask is None else (image * intrinsics.mask).astype(np.float32)


def facing_normals(normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals; those that face away from the viewer (averaged or predicted ones may) are bent until they don't."""
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = (normal * view).sum(axis=-1, keepdims=True)
    normal = normal + view * np.maximum(LEAST_FACING - cosine, 0)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


def _radiance(
    normal: Float[np.ndarray, "n 3"],
    view: Float[np.ndarray, "n 3"],
    material: dict[str, Float[np.ndarray, "n c"]],
    environment: Float[np.ndarray, "eh ew 3"],
    spp: int,
    seed: int,
    counters: Counters,
) -> Float[np.ndarray, "n 3"]:
    """Outgoing radiance of n points with the given normals and materials, per-point mean over `spp` samples."""
    mi = mitsuba()
    envmap_data(environment)  # checks
    count = len(normal)
    light = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(environment, np.float32))}
    scene = mi.load_dict({"type": "scene", "light": light})
    bsdf = mi.load_dict(_material_rows(material))
    passes = pass_count(spp, 1, max(1, SAMPLES_PER_PASS // count))
    total = np.zeros((count, 3), np.float64)
    for index in range(passes):

        def draw(attempt: int, index: int = index) -> Float[np.ndarray, "n 3"]:
            parts = ("shade", index, attempt) if attempt else ("shade", index)
            return _pass(scene, bsdf, normal, view, spp // passes, derive_seed(seed, *parts))

        total += finite_pass(draw, counters, "shade")
    return (total / passes).astype(np.float32)


def _material_rows(material: dict[str, Float[np.ndarray, "n c"]]) -> dict[str, Any]:
    """A principled BSDF whose parameters are pictures one pixel high: point i reads column i."""
    mi = mitsuba()

    def row(values: Float[np.ndarray, "n c"]) -> dict[str, Any]:
        bitmap = mi.Bitmap(np.ascontiguousarray(np.clip(values, 0, 1)[None], np.float32))
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}

    return {
        "type": "principled",
        "base_color": row(material["albedo"]),
        "roughness": row(material["roughness"]),
        "metallic": row(material["metallic"]),
    }


def _pass(
    scene: Any, bsdf: Any, normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"], spp: int, seed: int
) -> Float[np.ndarray, "n 3"]:
    import drjit as dr

    mi = mitsuba()
    count = len(normal)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, count * spp)
    index = dr.arange(mi.UInt32, count * spp) // spp
    to_points = {name: mi.Vector3f(np.ascontiguousarray(array.T)) for name, array in (("n", normal), ("v", view))}
    n, v = (dr.gather(mi.Vector3f, to_points[name], index) for name in ("n", "v"))

    hit = dr.zeros(mi.SurfaceInteraction3f, count * spp)
    hit.t = mi.Float(1.0)
    hit.n, hit.sh_frame, hit.uv = mi.Normal3f(n), mi.Frame3f(n), mi.Point2f((mi.Float(index) + 0.5) / count, 0.5)
    hit.wi = hit.to_local(v)
    context = mi.BSDFContext()

    towards, weight = scene.sample_emitter_direction(hit, sampler.next_2d(), False)
    local = hit.to_local(towards.d)
    value, pdf = bsdf.eval_pdf(context, hit, local)
    lit = value * weight * _balance(towards.pdf, pdf)

    drawn, throughput = bsdf.sample(context, hit, sampler.next_1d(), sampler.next_2d())
    ray = hit.spawn_ray(hit.to_world(drawn.wo))
    sky = scene.ray_intersect(ray)
    emitter = sky.emitter(scene)
    direction = mi.DirectionSample3f(scene, sky, hit)
    pdf_light = scene.pdf_emitter_direction(hit, direction)
    delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
    share = dr.select(delta, 1.0, _balance(drawn.pdf, pdf_light))
    reflected = throughput * emitter.eval(sky) * share

    radiance = dr.select(towards.pdf > 0, lit, 0) + dr.select(drawn.pdf > 0, reflected, 0)
    means = [dr.block_sum(channel, spp) / spp for channel in (radiance.x, radiance.y, radiance.z)]
    return np.stack([np.array(mean) for mean in means], axis=-1)


def _balance(pdf: Any, other: Any) -> Any:
    """Weight of a strategy in the balance heuristic; 0 where neither can draw the direction."""
    import drjit as dr

    total = pdf + other
    return dr.select(total > 0, pdf / dr.maximum(total, 1e-20), 0)
