"""A solution as a Mitsuba scene, and its pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender_reference import materials
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View
from unirender_reference.passes import Counters, derive_seed, mean_estimate, render_passes
from unirender_reference.render import IMAGE_DEPTH
from unirender_reference.scene import object_scene
from unirender_reference.sensors import sensor_at


def solution_scene(solution: Solution) -> Any:
    """Mesh, textures, normal map and light; no sensor."""
    obj = solution.obj
    assert obj.roughness is not None  # every solution has both
    assert obj.metallic is not None
    surface = mitsuba().load_dict(materials.principled_bsdf(obj.albedo, obj.roughness, obj.metallic))
    if obj.normal_map is not None:
        surface = materials.with_normal_map(surface, materials.normal_texture_of(obj.normal_map))
    return object_scene(obj, surface, solution.environment)


def solution_images(solution: Solution, views: Sequence[View], spp: int, seed: int = 0) -> Float[np.ndarray, "n h w 4"]:
    """The solution from the cameras of some views: premultiplied linear RGBA, path traced.

    Args:
        solution: what is shown.
        views: cameras; all pictures have one size.
        spp: samples per pixel (`sample_counts.pass_count` says which numbers serve).
        seed: equal seeds give equal pictures.
    """
    scene, images = solution_scene(solution), []
    for index, view in enumerate(views):
        sensor = sensor_at(view.pose, view.camera, *view.mask.shape[:2])
        passes = render_passes(scene, IMAGE_DEPTH, spp, derive_seed(seed, index), 1, Counters(), sensor)
        images.append(mean_estimate(*passes, 1).mean)
    return np.stack(images)
