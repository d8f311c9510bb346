"""How near a mesh is to the true object: outlines, normals as cameras see them, distances between surfaces."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.tracer import MeshTracer
from unirender_reference.shapes import MeshObject

POINTS = 30_000
RAYS = 4  # along a pixel's side


@dataclass(frozen=True)
class ShapeScore:
    """A mesh against the true object.

    Attributes:
        mask_iou: soft intersection over union of the coverages, mean over the views, [0, 1]; 1 is perfect.
        normal_cosine: mean cosine between the pixels' normals where both cover them, weighted by the true coverage,
            [-1, 1]; 1 is perfect.
        chamfer: mean distance from either surface to the other, averaged over both ways, in radii of the object's
            bounding sphere; 0 is perfect.
    """

    mask_iou: float
    normal_cosine: float
    chamfer: float


def score_shape(found: MeshObject, true: MeshObject, cameras: Cameras) -> ShapeScore:
    """Scores a mesh in the world of the true object, from cameras that the reconstruction has not seen."""
    (a, first), (b, second) = (normal_buffers(obj, cameras) for obj in (found, true))
    iou = np.minimum(a, b).sum((1, 2)) / np.maximum(a, b).sum((1, 2))
    weight = b * (a > 0)
    cosine = (weight * np.einsum("khwc,khwc->khw", first, second)).sum() / weight.sum()
    return ShapeScore(float(iou.mean()), float(cosine), chamfer(found, true))


def normal_buffers(
    obj: MeshObject, cameras: Cameras
) -> tuple[Float[np.ndarray, "k h w"], Float[np.ndarray, "k h w 3"]]:
    """Coverage and the mean shading normal (world axes, unit, 0 outside) of every pixel."""
    side = RAYS
    y, x = np.meshgrid(np.arange(cameras.height * side), np.arange(cameras.width * side), indexing="ij")
    one = (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / side
    view = np.repeat(np.arange(len(cameras)), len(one))
    rays = cameras.rays(np.tile(one, (len(cameras), 1)), view)
    face, _, at = MeshTracer(obj.vertices, obj.faces).first_hits(cameras.center[view], rays)
    corners = obj.normals[obj.faces[face]]
    normal = np.einsum("nk,nkc->nc", np.column_stack([1 - at.sum(1), at]), corners) * (face >= 0)[:, None]
    blocks = (len(cameras), cameras.height, side, cameras.width, side)
    mean = normal.reshape(*blocks, 3).mean((2, 4))
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    unit = np.divide(mean, length, out=np.zeros_like(mean), where=length > 1e-9)
    return (face >= 0).reshape(blocks).mean((2, 4)), unit


def chamfer(a: MeshObject, b: MeshObject) -> float:
    """Mean of the two mean distances from points of one surface to the nearest of `POINTS` points of the other.

    The points' spacing leaves a floor: two samplings of one unit sphere are about 0.01 apart.
    """
    rng = np.random.default_rng(0)
    first, second = (surface_points(obj.vertices, obj.faces, POINTS, rng) for obj in (a, b))
    there, back = KDTree(second).query(first)[0], KDTree(first).query(second)[0]
    return float((there.mean() + back.mean()) / 2)


def surface_points(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "count 3"]:
    """Points that are uniform on the surface."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - u) * a[chosen] + u * (1 - v) * b[chosen] + u * v * c[chosen]
