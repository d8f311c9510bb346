"""The pinhole camera of the data contract.

Camera axes: +x right, +y up, +z towards the viewer; the camera sits at the origin of its own frame and looks along -z.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError

DEFAULT_FOV_DEG = 36.0
DEFAULT_FILL = 0.9


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        fov_deg: vertical field of view in degrees, in (0, 180).
        principal: principal point as a fraction of (width, height) from the top-left corner.
    """

    fov_deg: float = DEFAULT_FOV_DEG
    principal: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        if not 0.0 < self.fov_deg < 180.0:
            raise UnirenderError(
                f"field of view: got {self.fov_deg} degrees, expected a vertical angle between 0 and 180; pass --fov"
            )
        if len(self.principal) != 2 or not all(math.isfinite(p) for p in self.principal):
            raise UnirenderError(f"principal point: got {self.principal}, expected two finite fractions of the frame")

    def rays(self, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
        """Unit directions from the camera into the scene through the pixel centres, in camera axes (z < 0)."""
        half_height = math.tan(math.radians(self.fov_deg) / 2)  # of the image plane at distance 1
        pixel = 2 * half_height / height
        x = (np.arange(width) + 0.5 - self.principal[0] * width) * pixel
        y = -(np.arange(height) + 0.5 - self.principal[1] * height) * pixel
        directions = np.stack([*np.meshgrid(x, y), np.full((height, width), -1.0)], axis=-1)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return directions.astype(np.float32)

    def view_directions(self, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
        """Unit directions from each pixel's surface point towards the viewer: `-rays`."""
        return -self.rays(height, width)

    def distance(self, radius: float = 1.0, fill: float = DEFAULT_FILL) -> float:
        """Distance at which a sphere's silhouette fills `fill` of the frame height.

        A sphere of radius R at distance D has its silhouette at the angle asin(R / D) from the axis.
        """
        tangent = fill * math.tan(math.radians(self.fov_deg) / 2)
        return radius * math.sqrt(1 + 1 / tangent**2)
