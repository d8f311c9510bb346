"""Small scenes with known answers for the tests of the reference renderer."""

import numpy as np
import trimesh

from unirender_reference.lights import Light
from unirender_reference.shapes import MeshObject


def sphere(albedo: tuple[float, float, float] = (0.7, 0.4, 0.2), subdivisions: int = 5) -> MeshObject:
    """The unit sphere with exact shading normals and one base colour."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(mesh.vertices, np.float32)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    faces = np.asarray(mesh.faces, np.int32)
    return MeshObject("sphere", "sphere", vertices, faces, vertices.copy(), None, np.array(albedo, np.float32))


def environment(seed: int = 0, shape: tuple[int, int] = (16, 32), peaks: int = 3) -> np.ndarray:
    """A light with structure at all scales: coloured noise and a few bright texels."""
    rng = np.random.default_rng(seed)
    light = rng.random((*shape, 3)) * rng.random(3)
    for _ in range(peaks):
        light[rng.integers(2, shape[0] - 2), rng.integers(shape[1])] += rng.uniform(3, 8, 3)
    return light.astype(np.float32)


def light(seed: int = 0, shape: tuple[int, int] = (16, 32), peaks: int = 3) -> Light:
    return Light(f"light-{seed}", environment(seed, shape, peaks), {})
