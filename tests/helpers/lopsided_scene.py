"""A scene without any symmetry: two cubes in four colours, and two lights from its sides."""

import numpy as np

from unirender.light.environment import environment_directions
from unirender_reference.shapes import MeshObject


def box(centre: tuple[float, float, float], half: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (24, 3) and faces of a cube turned about the axis (1, 1, 1)."""
    corners, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            n = sign * np.eye(3)[axis]
            start = len(corners)
            corners += [n - u - sign * v, n + u - sign * v, n + u + sign * v, n - u + sign * v]
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    k = np.full(3, 1 / np.sqrt(3))
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    rotation = np.eye(3) + np.sin(turn) * cross + (1 - np.cos(turn)) * cross @ cross
    return np.array(corners) @ rotation.T * half + np.array(centre), np.array(faces)


ALBEDO = np.array([[[0.8, 0.3, 0.1], [0.2, 0.7, 0.4]], [[0.6, 0.6, 0.1], [0.9, 0.5, 0.7]]], np.float32)


def lopsided_object(matrix: np.ndarray | None = None, albedo: np.ndarray = ALBEDO) -> MeshObject:
    """Two cubes, unequal, near enough to light each other; optionally moved by an orthogonal matrix."""
    vertices, faces = box((-0.25, -0.2, 0.0), 0.38, 0.5)
    small, more = box((0.42, 0.25, 0.25), 0.24, 1.1)
    vertices, faces = np.concatenate([vertices, small]), np.concatenate([faces, more + len(vertices)])
    uv = np.tile(np.array([[0.1, 0.1], [0.9, 0.2], [0.8, 0.9], [0.2, 0.8]]), (len(vertices) // 4, 1))
    vertices /= np.linalg.norm(vertices, axis=-1).max()
    if matrix is not None:
        vertices = vertices @ matrix.T
        faces = faces[:, ::-1] if np.linalg.det(matrix) < 0 else faces
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for column in range(3):
        normals[faces[:, column]] = face_normals / np.linalg.norm(face_normals, axis=-1, keepdims=True)
    return MeshObject(
        name="lopsided",
        family="test",
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        normals=normals.astype(np.float32),
        uv=uv.astype(np.float32),
        albedo=albedo,
        provenance={},
    )


def light(direction: tuple[float, float, float], colour: tuple[float, float, float], matrix=None) -> np.ndarray:
    """A smooth coloured light from one side, evaluated on the grid; `matrix` moves it along with the scene."""
    d = np.array(direction) / np.linalg.norm(direction)
    d = d if matrix is None else matrix @ d
    cosine = environment_directions(64, 128) @ d
    radiance = 0.15 + np.exp(4 * (cosine - 1))[..., None] * np.array(colour) * 3
    return radiance.astype(np.float32)


KEY = light((0.8, 0.5, 0.6), (1.0, 0.6, 0.3))
RIM = light((-0.9, 0.2, 0.1), (0.2, 0.5, 1.0))
