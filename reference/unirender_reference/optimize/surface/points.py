"""The surface points that pixels show: several in each pixel, with what shading needs."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference.arrays import components
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.views import View
from unirender_reference.passes import derive_seed
from unirender_reference.samplers import stratified_sampler
from unirender_reference.scene import object_scene
from unirender_reference.sensors import sensor_at, sensor_dict
from unirender_reference.shader import facing
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

    def some(self, most: int, seed: int) -> "SurfacePoints":
        """At most so many of the pixels, drawn at random, in their order."""
        if len(self) <= most:
            return self
        kept = np.sort(np.random.default_rng(seed).choice(len(self), most, replace=False))
        return SurfacePoints(*(getattr(self, field.name)[kept] for field in fields(self)))

    @property
    def coverage(self) -> Float[np.ndarray, " n"]:
        """Share of the points that hit."""
        return self.hit.mean(axis=1, dtype=np.float32)

    def mean_position(self) -> Float[np.ndarray, "n 3"]:
        """Of the points that hit."""
        total = np.where(self.hit[..., None], self.position, 0).sum(axis=1)
        return total / np.maximum(self.hit.sum(axis=1), 1)[:, None]

    def of(
        self, pictures: Sequence[Shaped[np.ndarray, "h w c"]] | Shaped[np.ndarray, "v h w c"]
    ) -> Shaped[np.ndarray, "n c"]:
        """The pixels' values in pictures of the views."""
        return np.stack([picture.reshape(-1, picture.shape[-1]) for picture in pictures])[self.view, self.pixel]


def blocker(obj: MeshObject) -> Any:
    """A Mitsuba scene of the mesh alone, to trace rays in."""
    return object_scene(obj)


def trace_points(scene: Any, views: Sequence[View], samples: int, seed: int, most: int | None = None) -> SurfacePoints:
    """Points of all pixels that meet the object and that their mask does not exclude.

    Args:
        scene: of `blocker`.
        views: cameras and masks.
        samples: S, points per pixel, stratified; a number that makes a grid (4, 9, 16, ...).
        seed: of their positions in the pixels.
        most: keep a random choice of so many pixels; None: all.

    Raises:
        UnirenderError: no covered pixel shows the mesh.
    """
    found = []
    for index, view in enumerate(views):
        size = view.mask.shape[:2]
        sensor = sensor_at(view.pose, view.camera, *size)
        own = derive_seed(seed, "points", index)
        pixel, *points = _trace(scene, sensor, view.mask, size, samples, own)
        found.append((np.full(len(pixel), index), pixel, *points))
    columns = [np.concatenate(parts) for parts in zip(*found, strict=True)]
    if not len(columns[0]):
        raise UnirenderError("geometry: the mesh is in no covered pixel; expected the object that the pictures show")
    points = SurfacePoints(*columns)
    return points if most is None else points.some(most, seed)


def picture_points(
    scene: Any,
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    size: tuple[float, float],
    samples: int,
    seed: int = 0,
) -> SurfacePoints:
    """Points of the covered pixels of one picture from the contract's camera.

    Args:
        scene: of `blocker`, the object in the contract's place before the camera.
        mask: coverage; a pixel of it may be a block of pixels of the picture.
        camera: of the picture.
        size: height and width of the picture in pixels of the mask; no integers where the last blocks stick out.
        samples: S, as in `trace_points`.
        seed: of the points' places within their pixels.

    Raises:
        UnirenderError: no covered pixel shows the mesh.
    """
    sensor = sensor_dict(camera, round(size[0] * 64), round(size[1] * 64))  # only their ratio counts
    pixel, *points = _trace(scene, sensor, mask, size, samples, seed)
    if not len(pixel):
        raise UnirenderError("geometry: the mesh is in no covered pixel; expected the object that the picture shows")
    return SurfacePoints(np.zeros_like(pixel), pixel, *points)


def mapped_points(
    mask: Float[np.ndarray, "h w 1"], normal: Float[np.ndarray, "h w 3"], view: Float[np.ndarray, "h w 3"]
) -> SurfacePoints:
    """One point for each covered pixel, with the pixel's normal and direction to the viewer, and no place.

    Raises:
        UnirenderError: no covered pixel has a normal.
    """
    mi = mitsuba()
    inside = (mask[..., 0] > 0) & np.any(normal != 0, axis=-1)
    if not inside.any():
        raise UnirenderError("normals: they are 0 wherever the mask covers a pixel; expected a normal for each of them")
    columns = (mi.Vector3f(*components(x[inside])) for x in (normal, view))
    bent = np.array(facing(*columns)).T[:, None]
    pixel, nowhere = np.flatnonzero(inside), np.zeros((len(bent), 1, 2), np.float32)
    position, to_viewer = np.zeros_like(bent), view[inside][:, None].astype(np.float32)
    hit = np.ones((len(bent), 1), bool)
    return SurfacePoints(np.zeros_like(pixel), pixel, position, bent, bent, to_viewer, nowhere, hit)


def _trace(
    scene: Any,
    sensor: dict[str, Any],
    mask: Float[np.ndarray, "h w 1"],
    size: tuple[float, float],
    samples: int,
    seed: int,
) -> tuple[np.ndarray, ...]:
    """The covered pixels that meet the object, and of their points the fields of `SurfacePoints` from `position` on."""
    import drjit as dr

    mi = mitsuba()
    covered = np.flatnonzero(mask[..., 0] > 0)
    count = len(covered) * samples
    owner = dr.arange(mi.UInt32, count) // samples
    row, column = np.divmod(covered, mask.shape[1])
    corner = dr.gather(mi.Point2f, mi.Point2f(*components(np.stack([column, row], axis=1))), owner)
    sampler = stratified_sampler(samples, count, seed)
    scale = mi.Point2f(*(dr.opaque(mi.Float, float(1 / np.float32(side))) for side in reversed(size)))
    ray, _ = mi.load_dict(sensor).sample_ray(0.0, 0.5, (corner + sampler.next_2d()) * scale, mi.Point2f(0.5))
    point = scene.ray_intersect(ray)
    to_viewer = -ray.d
    normal = dr.select(dr.dot(point.sh_frame.n, to_viewer) < 0, -point.sh_frame.n, point.sh_frame.n)
    side = dr.select(dr.dot(point.n, to_viewer) < 0, -point.n, point.n)
    found, valid = (point.p, normal, side, to_viewer, point.uv), point.is_valid()
    dr.eval(found, valid)  # each would be traced for
    hit = np.array(valid).reshape(-1, samples)
    chosen = hit.any(axis=1)

    def rows(vectors: Any) -> np.ndarray:
        values = np.stack([np.array(component) for component in vectors], axis=1)
        values = values.reshape(len(covered), samples, -1)[chosen]
        return np.where(hit[chosen][..., None], values, 0).astype(np.float32)

    return (covered[chosen], *map(rows, found), hit[chosen])
