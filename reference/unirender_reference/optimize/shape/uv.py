"""Texture coordinates that an optimisation can write to: each point of the surface with texels of its own."""

import dataclasses

import numpy as np

from unirender_reference.optimize.shape.charts import unwrap, welded
from unirender_reference.shapes import MeshObject
from unirender_reference.shapes.surface import split_corners

SAMPLES = 20_000
GRID = 256  # cells along a side in which two samples count as one place of the texture
FAR = 0.2  # of the object's radius: samples of one cell that are farther apart lie on different parts of it
MOST_SHARED = 0.2  # share of such cells; where charts merely touch it is a few per cent
LEAST_AREA = 1e-3  # of the texture that the charts cover


def charted(obj: MeshObject, texture_size: int) -> MeshObject:
    """The object itself if its texture coordinates serve, else with new charts (xatlas) and without its textures.

    Args:
        obj: any mesh.
        texture_size: texels along each side of the textures that will be written.
    """
    if has_own_texels(obj):
        return obj
    points, faces, _ = welded(obj.vertices, obj.faces)
    charts = unwrap(points, faces, texture_size)
    vertices, faces, normals, uv = split_corners(points, faces, obj.normals[obj.faces], charts.uv[charts.faces])
    grey = np.full(3, 0.5, np.float32)
    plain = {"albedo": grey, "roughness": None, "metallic": None, "normal_map": None}
    return dataclasses.replace(obj, vertices=vertices, faces=faces, normals=normals, uv=uv, **plain)


def has_own_texels(obj: MeshObject) -> bool:
    """Whether no two distant parts of the surface share a place of the texture.

    Samples are drawn on the surface, evenly by area; those that fall into one cell of the texture are compared.
    """
    if obj.uv is None or obj.uv.min() < -1e-3 or obj.uv.max() > 1 + 1e-3:
        return False
    corners, points = obj.uv[obj.faces].astype(np.float64), obj.vertices[obj.faces].astype(np.float64)
    u, v = (corners[:, k] - corners[:, 0] for k in (1, 2))
    if np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2 < LEAST_AREA:
        return False
    rng = np.random.default_rng(0)
    area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
    face = rng.choice(len(area), SAMPLES, p=area / area.sum())
    weight = rng.dirichlet([1, 1, 1], SAMPLES)[:, :, None]
    place, point = (corners[face] * weight).sum(1), (points[face] * weight).sum(1)
    cell = np.clip((place * GRID).astype(int), 0, GRID - 1) @ [1, GRID]
    order = np.argsort(cell, kind="stable")
    same = cell[order[1:]] == cell[order[:-1]]
    distance = np.linalg.norm(point[order[1:]] - point[order[:-1]], axis=1)[same]
    return not distance.size or float((distance > FAR).mean()) < MOST_SHARED
