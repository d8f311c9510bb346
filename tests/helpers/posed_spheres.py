"""Objects with known shapes in front of posed cameras, for the tests of the reconstruction."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from reference_scenes import sphere

from unirender.camera import Camera
from unirender_reference.multiview import orbit
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.topology import vertex_normals
from unirender_reference.optimize.shape.tracer import MeshTracer
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject


def blank_views(count: int, size: int, start_deg: float = 0.0) -> tuple[View, ...]:
    """Cameras around the origin with empty pictures and full masks."""
    camera, image, mask = Camera(), np.zeros((size, size, 3), np.float32), np.ones((size, size, 1), np.float32)
    return tuple(View(image, mask, camera, pose, f"view {k}") for k, pose in enumerate(orbit(count, camera, start_deg)))


def mask_views(obj: MeshObject, count: int, size: int, start_deg: float = 0.0) -> Views:
    """Views whose masks are the object's coverage (64 rays per pixel); black pictures."""
    return with_masks(obj, blank_views(count, size, start_deg))


def with_masks(obj: MeshObject, blank: Sequence[View]) -> Views:
    """The same of these cameras."""
    coverage = MeshTracer(obj.vertices, obj.faces).coverage(Cameras(blank), 8)
    masks = coverage[..., None].astype(np.float32)
    return Views(tuple(dataclasses.replace(view, mask=mask) for view, mask in zip(blank, masks, strict=True)))


def dented_sphere(depth: float = 0.45, subdivisions: int = 4) -> MeshObject:
    """The unit sphere with a round dent on the +z side, which no silhouette shows."""
    ball = sphere(subdivisions=subdivisions)
    angle = np.arccos(np.clip(ball.vertices[:, 2], -1, 1))
    radius = 1 - depth * np.exp(-((angle / 0.35) ** 2))
    vertices = (ball.vertices * radius[:, None]).astype(np.float32)
    normals = vertex_normals(vertices.astype(np.float64), ball.faces).astype(np.float32)
    return dataclasses.replace(ball, name="dented", vertices=vertices, normals=normals)
