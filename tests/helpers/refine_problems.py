"""Small problems with known answers for the refinement: a textured ball, its light, and views of it."""

import numpy as np
import trimesh

from unirender.camera import Camera
from unirender.color import image_srgb
from unirender_reference.multiview import orbit
from unirender_reference.optimize.refine.scene import TexturedScene, maps_of
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject

SIDE, TEXELS, LIGHT = 16, 8, (6, 12)


def ball(subdivisions: int = 3, seed: int = 0) -> MeshObject:
    """The unit sphere with random textures; they are projected along z, so that there is no seam."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(mesh.vertices, np.float64)
    vertices = (vertices / np.linalg.norm(vertices, axis=1, keepdims=True)).astype(np.float32)
    uv = 0.5 + 0.45 * vertices[:, [0, 1]]  # front and back share texels
    rng = np.random.default_rng(seed)
    return MeshObject(
        "ball",
        "sphere",
        vertices,
        np.asarray(mesh.faces, np.int32),
        vertices.copy(),
        uv,
        rng.uniform(0.15, 0.85, (TEXELS, TEXELS, 3)).astype(np.float32),
        rng.uniform(0.35, 0.7, (TEXELS, TEXELS)).astype(np.float32),
        rng.uniform(0.2, 0.7, (TEXELS, TEXELS)).astype(np.float32),
    )


def soft_light(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 1.2, (*LIGHT, 3)).astype(np.float32)


def solution(seed: int = 0) -> Solution:
    return Solution(ball(seed=seed), soft_light(seed))


def blank_views(count: int, side: int = SIDE) -> tuple[View, ...]:
    """Cameras without pictures."""
    camera = Camera()
    blank, full = np.zeros((side, side, 3), np.float32), np.ones((side, side, 1), np.float32)
    return tuple(View(blank, full, camera, pose) for pose in orbit(count, camera))


def rendered_views(truth: Solution, count: int, side: int = SIDE, spp: int = 256, held_out: int = 0) -> Views:
    """What cameras around a solution see, as 8-bit display values."""
    cameras = blank_views(count + held_out, side)
    images = TexturedScene(truth, cameras).image(maps_of(truth), spp, seed=99)
    views = []
    for view, image in zip(cameras, images, strict=True):
        mask = np.clip(image[..., 3:], 0, 1)
        straight = np.where(mask > 0, image[..., :3] / np.maximum(mask, 1e-6), 0)
        views.append(View(np.round(image_srgb(straight) * 255) / 255, mask, view.camera, view.pose))
    return Views(tuple(views[:count]), tuple(views[count:]))
