"""The buffers that no light enters: base colour, normal, coverage, roughness, metallic.

All are means over the camera rays of a pixel that meet the object. Base colour, roughness and metallic are read with
`eval_attribute`: Mitsuba's albedo AOV is view-dependent on metals. The normal is the one that the surfaces are
evaluated at: the shading normal, normal map included, towards the viewer by `twosided`'s rule.
"""

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_reference import materials
from unirender_reference.backend import mitsuba
from unirender_reference.editable_scene import EditableScene
from unirender_reference.passes import derive_seed
from unirender_reference.sample_counts import SAMPLES_PER_PASS, next_spp, pass_count
from unirender_reference.samplers import stratified_sampler

RoughnessMetallic = tuple[float | None, float | None]  # in this order; None is the object's own map


def geometry_buffers(
    scene: EditableScene, camera: Camera, resolution: int, spp: int, seed: int, material: RoughnessMetallic | None
) -> Intrinsics:
    """Albedo, normal (camera axes) and mask; with a `material` also roughness and metallic.

    Args:
        scene: of the object, at this camera and resolution.
        camera: the contract's camera, which the buffers carry.
        resolution: height and width in pixels.
        spp: least number of camera rays per pixel: the next that makes full multi-jittered grids is taken.
        seed: of the rays' positions within the pixels.
        material: (roughness, metallic) of the scene, each a value or None for the object's own map.
    """
    channels = 7 if material is None else 9
    sums = np.zeros((resolution, resolution, channels), np.float64)
    budget = max(1, SAMPLES_PER_PASS // resolution**2)
    spp = next_spp(spp, 1, budget)
    count = pass_count(spp, 1, budget)
    for index in range(count):
        own = derive_seed(seed, "geometry", index)
        sums += _trace(scene, resolution, spp // count, own, material) * (spp // count)
    mask = sums[..., :1] / spp
    maps = np.divide(sums[..., 1:], sums[..., :1], out=np.zeros_like(sums[..., 1:]), where=mask > 0)
    length = np.linalg.norm(maps[..., 3:6], axis=-1, keepdims=True)
    normal = np.divide(maps[..., 3:6], length, out=np.zeros_like(maps[..., 3:6]), where=length > 0)
    return Intrinsics(
        albedo=np.clip(maps[..., :3], 0, 1).astype(np.float32),
        normal=normal.astype(np.float32),
        roughness=None if material is None else np.clip(maps[..., 6:7], 0, 1).astype(np.float32),
        metallic=None if material is None else np.clip(maps[..., 7:8], 0, 1).astype(np.float32),
        mask=np.clip(mask, 0, 1).astype(np.float32),
        camera=camera,
    )


def _trace(
    scene: EditableScene, size: int, spp: int, seed: int, material: RoughnessMetallic | None
) -> Float[np.ndarray, "h w c"]:
    """Mean over `spp` camera rays of (hit, base colour, normal[, roughness, metallic]), per pixel."""
    mi = mitsuba()
    import drjit as dr

    values = {} if material is None else {"roughness": material[0], "metallic": material[1]}
    shown, bsdf = scene.show("principled", values), scene.parameters("principled", values)
    sensor = shown.sensors()[0]
    index = dr.arange(mi.UInt32, size * size * spp)
    pixel = index // spp
    sampler = stratified_sampler(spp, size * size * spp, seed)
    corner = mi.Point2f(mi.Float(pixel % size), mi.Float(pixel // size))
    position = (corner + sampler.next_2d()) / size
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, position, mi.Point2f(0.5))
    coherent = True  # rays of one pixel follow each other; twice as fast
    hit = shown.ray_intersect(ray, mi.RayFlags.All, coherent)
    valid = hit.is_valid()
    base = bsdf.eval_attribute_3("base_color", hit, valid)
    if scene.normal_texture is None:
        normal = materials.facing_normal(hit)
    else:
        normal = materials.mapped_normal(hit, scene.normal_texture, valid)
    scalars = [bsdf.eval_attribute_1(name, hit, valid) for name in values]
    channels = [dr.select(valid, mi.Float(channel), 0.0) for channel in (valid, *base, *normal, *scalars)]
    dr.eval(channels)  # one kernel; block_sum would trace again for every channel
    means = [dr.block_sum(channel, spp) / spp for channel in channels]
    return np.stack([np.array(mean).reshape(size, size) for mean in means], axis=-1)
