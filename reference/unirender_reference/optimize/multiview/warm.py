"""A warm start for several views: the maps that a model predicts for each picture, laid on the mesh.

Each pixel's point of the surface is found by a ray through its centre; what was predicted there is spread over the four
texels around it, weighted by the cosine between normal and viewer (grazing pixels mix much). Texels that no view shows
take the nearest that one does.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import rotate_environment
from unirender.light.resampling import resample_environment
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.shape.uv import charted
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.surface.textures import texel_weights
from unirender_reference.optimize.views import View, Views
from unirender_reference.scene import object_scene
from unirender_reference.sensors import sensor_at
from unirender_reference.shapes import MeshObject

LEAST_RADIANCE = 1e-4  # of the start's light: logarithms of it are refined


def solution_from_predictions(
    views: Views, obj: MeshObject, predictions: Sequence[Intrinsics], texture_size: int, light_rows: int
) -> Solution:
    """Mean maps on the mesh, and the mean of the lights, each turned into the world.

    Args:
        views: what was predicted from.
        obj: the mesh; new texture coordinates are made where its own do not serve.
        predictions: for each view that is seen; albedo, roughness, metallic and environment.
        texture_size: texels along each side.
        light_rows: of the environment.

    Raises:
        UnirenderError: a prediction lacks a map, or there is not one for each view.
    """
    if len(predictions) != len(views.seen):
        raise UnirenderError(
            f"warm start: got {len(predictions)} predictions for {len(views.seen)} views, expected "
            "one for each; leave held-out pictures out"
        )
    obj = charted(obj, texture_size)
    total = np.zeros((texture_size * texture_size, 5))
    weight = np.zeros(texture_size * texture_size)
    light = np.zeros((light_rows, 2 * light_rows, 3))
    scene = object_scene(obj)
    for view, prediction in zip(views.seen, predictions, strict=True):
        maps = prediction.require("albedo", "roughness", "metallic", "environment")
        uv, cosine = _seen(scene, view)
        values = np.concatenate([maps[name] for name in ("albedo", "roughness", "metallic")], axis=-1)
        keep = cosine > 0
        importance = (cosine * view.mask[..., 0])[keep]
        texels = texel_weights(uv[keep], texture_size).T
        weight += texels @ importance
        total += texels @ (importance[:, None] * values[keep])
        turned = rotate_environment(maps["environment"], view.pose[:3, :3])
        light += resample_environment(turned, (light_rows, 2 * light_rows)) / len(views.seen)
    if not weight.any():
        raise UnirenderError(f"warm start: no view shows {obj.name}; are mesh and poses in the same place?")
    nearest = ndimage.distance_transform_edt(
        weight.reshape(texture_size, texture_size) <= 0, return_distances=False, return_indices=True
    )
    assert nearest is not None
    mean = (total / np.maximum(weight, 1e-9)[:, None]).reshape(texture_size, texture_size, 5)[tuple(nearest)]
    maps = np.clip(mean, 0, 1).astype(np.float32)
    textured = dataclasses.replace(
        obj,
        albedo=np.ascontiguousarray(maps[..., :3]),
        roughness=np.ascontiguousarray(maps[..., 3]),
        metallic=np.ascontiguousarray(maps[..., 4]),
    )
    return Solution(textured, np.maximum(light, LEAST_RADIANCE).astype(np.float32))


def _seen(scene: Any, view: View) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """Texture coordinates of the surface behind each pixel's centre, and its cosine to the viewer (0: nothing)."""
    mi = mitsuba()
    height, width = view.mask.shape[:2]
    sensor = mi.load_dict(sensor_at(view.pose, view.camera, height, width))
    row, column = (np.indices((height, width)) + 0.5).reshape(2, -1).astype(np.float32)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(column / width, row / height), mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    uv = np.stack([np.array(hit.uv.x), np.array(hit.uv.y)], axis=-1).reshape(height, width, 2)
    cosine = np.where(np.array(hit.is_valid()), np.abs(np.array(hit.wi.z)), 0).reshape(height, width)
    return uv, cosine
