"""The surface points that the pixels of some views show: several in each pixel, with what shading needs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender_reference import materials
from unirender_reference.backend import mitsuba
from unirender_reference.multiview import sensor_at
from unirender_reference.optimize.views import View
from unirender_reference.passes import derive_seed
from unirender_reference.scene import mesh_shape
from unirender_reference.shapes import MeshObject


@dataclass(frozen=True)
class SurfacePoints:
    """S points in each of N pixels; rows in which `hit` is False hold nothing.

    Attributes:
        view: index of the view of each pixel.
        pixel: index of the pixel in its view, row-major.
        position: world position.
        normal: unit shading normal, towards the viewer.
        side: unit geometric normal, towards the viewer.
        to_viewer: unit direction.
        uv: texture coordinates.
        hit: where the ray met the object.
    """

    view: Int[np.ndarray, " n"]
    pixel: Int[np.ndarray, " n"]
    position: Float[np.ndarray, "n s 3"]
    normal: Float[np.ndarray, "n s 3"]
    side: Float[np.ndarray, "n s 3"]
    to_viewer: Float[np.ndarray, "n s 3"]
    uv: Float[np.ndarray, "n s 2"]
    hit: Bool[np.ndarray, "n s"]

    def __len__(self) -> int:
        return len(self.view)

    @property
    def coverage(self) -> Float[np.ndarray, " n"]:
        """Share of the points that hit."""
        return self.hit.mean(axis=1, dtype=np.float32)

    def mean_position(self) -> Float[np.ndarray, "n 3"]:
        """Of the points that hit."""
        total = np.where(self.hit[..., None], self.position, 0).sum(axis=1)
        return total / np.maximum(self.hit.sum(axis=1), 1)[:, None]

    def of(self, pictures: Sequence[Float[np.ndarray, "h w c"]]) -> Float[np.ndarray, "n c"]:
        """The pixels' values in pictures of the views."""
        return np.stack([picture.reshape(-1, picture.shape[-1]) for picture in pictures])[self.view, self.pixel]


def blocker(obj: MeshObject) -> Any:
    """A Mitsuba scene of the mesh alone, to trace rays in."""
    return mitsuba().load_dict({"type": "scene", "object": mesh_shape(obj, materials.white_bsdf())})


def trace_points(scene: Any, views: Sequence[View], samples: int, seed: int, most: int | None = None) -> SurfacePoints:
    """Points of all pixels that meet the object and that their mask does not exclude.

    Args:
        scene: of `blocker`.
        views: cameras and masks.
        samples: S, points per pixel, stratified; a number that makes a grid (4, 9, 16, ...).
        seed: of their positions in the pixels.
        most: keep a random choice of so many pixels; None: all.
    """
    found = [
        _trace(scene, view, index, samples, derive_seed(seed, "points", index)) for index, view in enumerate(views)
    ]
    columns = [np.concatenate(parts) for parts in zip(*found, strict=True)]
    if most is not None and len(columns[0]) > most:
        kept = np.sort(np.random.default_rng(seed).choice(len(columns[0]), most, replace=False))
        columns = [column[kept] for column in columns]
    return SurfacePoints(*columns)


def _trace(scene: Any, view: View, index: int, samples: int, seed: int) -> tuple[np.ndarray, ...]:
    """The fields of `SurfacePoints`, of one view."""
    import drjit as dr

    mi = mitsuba()
    height, width = view.image.shape[:2]
    sensor = mi.load_dict(sensor_at(view.pose, view.camera, height, width))
    count = height * width * samples
    pixel = dr.arange(mi.UInt32, count) // samples
    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    sampler.set_samples_per_wavefront(samples)
    sampler.seed(dr.opaque(mi.UInt32, seed), count)
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    position = (corner + sampler.next_2d()) / mi.ScalarVector2f(width, height)
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, position, mi.Point2f(0.5))
    point = scene.ray_intersect(ray)
    to_viewer = -ray.d
    normal = dr.select(dr.dot(point.sh_frame.n, to_viewer) < 0, -point.sh_frame.n, point.sh_frame.n)
    side = dr.select(dr.dot(point.n, to_viewer) < 0, -point.n, point.n)
    hit = np.array(point.is_valid()).reshape(-1, samples)
    chosen = np.flatnonzero(hit.any(axis=1) & (view.mask.ravel() > 0))

    def rows(vectors: Any) -> np.ndarray:
        values = np.array(vectors).T.reshape(height * width, samples, -1)[chosen]
        return np.where(hit[chosen][..., None], values, 0).astype(np.float32)

    return (
        np.full(len(chosen), index),
        chosen,
        *(rows(vectors) for vectors in (point.p, normal, side, to_viewer, point.uv)),
        hit[chosen],
    )
