"""A small multi-view scene with known answers: a painted ball under two lights."""

from dataclasses import replace

import numpy as np
from reference_scenes import environment, sphere

from unirender.camera import Camera
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.settings import MultiviewSettings
from unirender_reference.optimize.solution import Solution
from unirender_reference.shapes import MeshObject

SMALL = MultiviewSettings(seen=3, held_out=2, spp=64, truth_spp=64, buffer_spp=16)
MATERIAL = (0.3, 0.6)  # metallic, roughness


def painted_ball() -> MeshObject:
    """The unit sphere with longitude and latitude as texture coordinates and a smooth albedo texture."""
    ball = sphere(subdivisions=4)
    x, y, z = ball.vertices.T
    uv = np.stack([0.5 + np.arctan2(x, z) / (2 * np.pi), np.arccos(np.clip(y, -1, 1)) / np.pi], axis=-1)
    v, u = np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 2 * np.pi, 16), indexing="ij")
    albedo = np.stack([0.5 + 0.3 * np.sin(u), 0.2 + 0.5 * v, 0.5 + 0.2 * np.cos(u)], axis=-1)
    return replace(ball, uv=uv.astype(np.float32), albedo=albedo.astype(np.float32))


def ball_scene(resolution: int = 24, settings: MultiviewSettings = SMALL) -> MultiviewScene:
    """The ball in MATERIAL, seen by few cameras."""
    light, other_light = (0.5 * environment(seed) for seed in (1, 2))
    return MultiviewScene(painted_ball(), MATERIAL, light, other_light, Camera(), resolution, settings)


def true_solution(scene: MultiviewScene) -> Solution:
    """The object with its material as textures, and its light."""
    metallic, roughness = (np.full((2, 2), value, np.float32) for value in scene.material)
    return Solution(replace(scene.obj, metallic=metallic, roughness=roughness), scene.light)
