"""All cameras of a set of views at once: projection to pixels with its derivative, and rays through pixels."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError
from unirender_reference.optimize.views import View


class Cameras:
    """The cameras of some views, stacked.

    Args:
        views: at least one, all of one size.

    Attributes:
        height, width: of the frames in pixels.
        rotation: (k, 3, 3) camera to world.
        center: (k, 3) positions in the world.
        focal: (k,) focal lengths in pixels.
    """

    def __init__(self, views: Sequence[View]) -> None:
        self.height, self.width = views[0].image.shape[:2]
        poses = np.stack([view.pose for view in views]).astype(np.float64)
        self.rotation, self.center = poses[:, :3, :3], poses[:, :3, 3]
        self.focal = np.array([self.height / 2 / math.tan(math.radians(view.camera.fov_deg) / 2) for view in views])
        self._principal = np.array([view.camera.principal for view in views]) * [self.width, self.height]

    def __len__(self) -> int:
        return len(self.center)

    def require_outside(self) -> None:
        """Looks whether the unit sphere, where the object may be, lies before each camera.

        Raises:
            UnirenderError: a camera stands in it.
        """
        nearest = float(np.linalg.norm(self.center, axis=1).min())
        if nearest <= 1:
            raise UnirenderError(
                f"views: a camera stands {nearest:.3g} from the origin, inside the object's unit sphere; expected all "
                "cameras outside: scale the poses so that the object lies within radius 1 about the origin"
            )

    def depth(self, points: Float[np.ndarray, "n 3"], view: int) -> Float[np.ndarray, " n"]:
        """How far world points lie before a camera, along its axis; below 0 behind it."""
        return -(points - self.center[view]) @ self.rotation[view][:, 2]

    def project(self, points: Float[np.ndarray, "n 3"], view: Int[np.ndarray, " n"] | int) -> Float[np.ndarray, "n 2"]:
        """Pixel coordinates of world points, each in the view named beside it."""
        local = np.einsum("nji,nj->ni", *self._local(points, view))
        return self.focal[view, None] * local[:, :2] * [1, -1] / -local[:, 2:] + self._principal[view]

    def jacobian(self, points: Float[np.ndarray, "n 3"], view: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2 3"]:
        """Derivative of `project` with respect to the points."""
        rotation, offset = self._local(points, view)
        local = np.einsum("nji,nj->ni", rotation, offset)
        depth = -local[:, 2]
        inner = np.zeros((len(points), 2, 3))
        inner[:, 0, 0], inner[:, 0, 2] = 1 / depth, local[:, 0] / depth**2
        inner[:, 1, 1], inner[:, 1, 2] = -1 / depth, -local[:, 1] / depth**2
        return self.focal[view, None, None] * np.einsum("nij,nkj->nik", inner, rotation)

    def rays(self, pixels: Float[np.ndarray, "n 2"], view: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions from the camera through pixel coordinates, in the world."""
        across = (pixels - self._principal[view]) / self.focal[view, None]
        local = np.stack([across[:, 0], -across[:, 1], -np.ones(len(pixels))], axis=1)
        directions = np.einsum("nij,nj->ni", self.rotation[view], local)
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def _local(self, points: np.ndarray, view: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
        offset = points - self.center[view]
        return np.broadcast_to(self.rotation[view], (len(points), 3, 3)), offset
