"""Rays against a mesh, by Mitsuba: what a camera sees of it, sub-pixel coverage, normals, crossings."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender_reference.arrays import components
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.shape.cameras import Cameras

MOST_RAYS = 1 << 21  # at once: a ray takes about 200 bytes


class MeshTracer:
    """A mesh in a Mitsuba scene; its vertices may move.

    Args:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
    """

    def __init__(self, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> None:
        mi = mitsuba()
        mesh = mi.Mesh("object", vertex_count=len(vertices), face_count=len(faces))
        own = mi.traverse(mesh)
        own["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
        own["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
        own.update()
        self.scene = mi.load_dict({"type": "scene", "object": mesh})
        self._parameters = mi.traverse(self.scene)
        self._key = next(key for key in self._parameters.keys() if key.endswith("vertex_positions"))  # noqa: SIM118 - SceneParameters iterates over pairs

    def move(self, vertices: Float[np.ndarray, "n 3"]) -> None:
        """Puts the vertices elsewhere; the faces stay."""
        self._parameters[self._key] = np.ascontiguousarray(vertices, np.float32).ravel()
        self._parameters.update()

    def meets(self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether each ray meets the mesh anywhere."""
        return np.array(self.scene.ray_test(_rays(origins, directions)))

    def first_hits(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
        """Face (-1: none), distance, and barycentric coordinates of the second and third corner (0), of first hits."""
        hit = self.scene.ray_intersect_preliminary(_rays(origins, directions))
        valid = np.array(hit.is_valid())
        face = np.where(valid, np.array(hit.prim_index).astype(np.int64), -1)
        at = np.where(valid, np.array(hit.prim_uv), 0)  # of rays that meet nothing it is whatever memory held, NaN too
        return face, np.where(valid, np.array(hit.t), np.inf), at.T

    def coverage(self, cameras: Cameras, side: int) -> Float[np.ndarray, "k h w"]:
        """Box-filtered coverage of all views by `side` x `side` rays on a regular grid in each pixel."""
        rows = max(1, MOST_RAYS // (cameras.width * side**2))
        found = np.empty((len(cameras), cameras.height, cameras.width))
        for index in range(len(cameras)):
            for top in range(0, cameras.height, rows):
                bottom = min(top + rows, cameras.height)
                found[index, top:bottom] = self._covered(cameras, index, top, bottom, side)
        return found

    def _covered(self, cameras: Cameras, index: int, top: int, bottom: int, side: int) -> Float[np.ndarray, "rows w"]:
        """Coverage of some rows of a view."""
        y, x = np.arange(top * side, bottom * side) + 0.5, np.arange(cameras.width * side) + 0.5
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / side
        view = np.full(len(pixels), index)
        met = self.meets(cameras.center[view], cameras.rays(pixels, view))
        return met.reshape(bottom - top, side, cameras.width, side).mean((1, 3))


def _rays(origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Any:
    mi = mitsuba()
    return mi.Ray3f(mi.Point3f(*components(origins)), mi.Vector3f(*components(directions)))
