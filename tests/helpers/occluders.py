"""Objects that shadow and light themselves, for the tests of passes by effect and by lobe."""

import dataclasses

import numpy as np
import trimesh

from unirender_reference.shapes import MeshObject

BRIGHT = (0.95, 0.9, 0.85)
BOOK_SIDES = ("left", "right", "both")


def torus(albedo: tuple[float, float, float] = BRIGHT) -> MeshObject:
    """A torus seen at a slant, with smooth shading normals on few triangles: its terminators are coarse."""
    mesh = trimesh.creation.torus(0.65, 0.35, major_sections=24, minor_sections=12)
    turn = np.asarray(trimesh.transformations.rotation_matrix(np.radians(50), (1, 0.3, 0)))[:3, :3]
    vertices = np.asarray(mesh.vertices) @ turn.T
    vertices /= np.linalg.norm(vertices, axis=1).max()
    normals = np.asarray(mesh.vertex_normals) @ turn.T
    return MeshObject(
        "torus",
        "torus",
        vertices.astype(np.float32),
        np.asarray(mesh.faces, np.int32),
        normals.astype(np.float32),
        None,
        np.array(albedo, np.float32),
    )


def book(sides: str = "both", albedo: tuple[float, float, float] = BRIGHT) -> MeshObject:
    """An open book that faces the camera: two flat pages in a right angle, or one of them.

    Seen from the camera no page hides the other, and a page alone can neither shadow nor light itself.
    """
    height, depth, reach = 0.55, -0.35, 0.6
    outer = np.sqrt(1 - height**2 - (depth + reach) ** 2)  # the outer corners lie on the unit sphere
    vertices, faces, normals = [], [], []
    for side in BOOK_SIDES[:2] if sides == "both" else (sides,):
        sign = -1 if side == "left" else 1
        corners = [(0, -height, depth), (0, height, depth), (sign * outer, height, depth + reach)]
        corners.append((sign * outer, -height, depth + reach))
        start = len(vertices)
        faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
        vertices += corners
        a, b, c = (np.array(corner) for corner in corners[:3])
        normal = np.cross(b - a, c - a)
        normal *= np.sign(normal[2]) / np.linalg.norm(normal)
        normals += [normal] * 4
    return MeshObject(
        f"book-{sides}",
        "book",
        np.array(vertices, np.float32),
        np.array(faces, np.int32),
        np.array(normals, np.float32),
        None,
        np.array(albedo, np.float32),
    )


def textured(obj: MeshObject, seed: int = 0, texels: int = 24, bumps: float = 0.4) -> MeshObject:
    """The object with noise in all its maps: base colour, roughness, metallic and normal."""
    rng = np.random.default_rng(seed)
    size = (texels, texels)
    normal = np.concatenate([rng.normal(0, bumps, (*size, 2)), np.ones((*size, 1))], axis=-1)
    return dataclasses.replace(
        obj,
        name=f"{obj.name}-textured",
        uv=(0.5 + 0.45 * obj.vertices[:, :2]).astype(np.float32),
        albedo=(rng.random((*size, 3)) > 0.5).astype(np.float32) * 0.9,
        roughness=rng.uniform(0.15, 0.9, size).astype(np.float32),
        metallic=(rng.random(size) > 0.5).astype(np.float32),
        normal_map=(normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32),
    )
