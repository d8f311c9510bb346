"""The pinhole camera of the data contract.

Camera axes: +x right, +y up, +z towards the viewer; the camera sits at the origin of its own frame and looks along -z.
"""

import math
import re
from dataclasses import dataclass
from numbers import Real

import numpy as np
from jaxtyping import Float

from unirender.blocks import row_blocks
from unirender.errors import UnirenderError
from unirender.vectors import lengths

DEFAULT_FOV_DEG = 36.0
DEFAULT_FILL = 0.9
_NUMBER = r"(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
_DESCRIPTION = re.compile(f"fov_deg={_NUMBER} principal={_NUMBER},{_NUMBER}")


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
        try:
            principal = tuple(self.principal)
        except TypeError:
            principal = (None,)
        if not all(isinstance(number, Real) for number in (self.fov_deg, *principal)):
            raise UnirenderError(f"camera: got {self}, expected numbers, like {Camera()}")
        object.__setattr__(self, "principal", principal)  # a list would have no hash
        if not 0.0 < self.fov_deg < 180.0:
            raise UnirenderError(
                f"field of view: got {self.fov_deg} degrees, expected a vertical angle between 0 and 180"
            )
        if len(self.principal) != 2 or not all(math.isfinite(p) for p in self.principal):
            raise UnirenderError(f"principal point: got {self.principal}, expected two finite fractions of the frame")

    @classmethod
    def from_focal(cls, focal: float, height: int, width: int, center: tuple[float, float] | None = None) -> "Camera":
        """The camera of a calibration, with square pixels and a straight lens.

        Args:
            focal: focal length in pixels, the same across and down.
            height: of the picture in whose pixels it counts.
            width: of this picture.
            center: principal point (x, y) in pixels from the picture's top-left corner, as COLMAP counts: the middle of
                the first pixel is (0.5, 0.5). OpenCV counts from there: add 0.5 to each. None: the picture's middle.

        Raises:
            UnirenderError: the focal length or a side is not above 0, or the point is not finite.
        """
        if not (focal > 0 and math.isfinite(focal) and height > 0 and width > 0):
            raise UnirenderError(
                f"focal length: got {focal:g} pixels in a picture of {width} x {height}, expected numbers above 0"
            )
        if center is not None and np.shape(center) != (2,):
            raise UnirenderError(f"center: got {center!r}, expected (x, y) in pixels; sides are height, width")
        x, y = (width / 2, height / 2) if center is None else center
        return cls(math.degrees(2 * math.atan(height / (2 * focal))), (x / width, y / height))

    def focal(self, height: int) -> float:
        """Focal length in pixels of a picture of this height; `from_focal` takes it back."""
        return height / (2 * math.tan(math.radians(self.fov_deg) / 2))

    def describe(self) -> str:
        """`fov_deg=36 principal=0.5,0.5`: as it stands in the header attribute `unirender:camera` of a file."""
        x, y = (_number(p) for p in self.principal)
        return f"fov_deg={_number(self.fov_deg)} principal={x},{y}"

    @classmethod
    def parse(cls, text: str) -> "Camera":
        """The camera that `describe` wrote.

        Raises:
            UnirenderError: the text is no such camera.
        """
        found = _DESCRIPTION.fullmatch(text.strip()) if isinstance(text, str) else None
        if found is None:
            raise UnirenderError(f"camera: got {text!r}, expected a text like {cls().describe()!r}")
        fov_deg, x, y = (float(number) for number in found.groups())
        return cls(fov_deg, (x, y))

    def rays(self, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
        """Unit directions from the camera into the scene through the pixel centres, in camera axes (z < 0)."""
        half_height = math.tan(math.radians(self.fov_deg) / 2)  # of the image plane at distance 1
        pixel = 2 * half_height / height
        x = (np.arange(width) + 0.5 - self.principal[0] * width) * pixel
        y = -(np.arange(height) + 0.5 - self.principal[1] * height) * pixel
        rays = np.empty((height, width, 3), np.float32)
        for rows in row_blocks(height, width):
            directions = np.stack([*np.meshgrid(x, y[rows]), np.full((len(y[rows]), width), -1.0)], axis=-1)
            rays[rows] = directions / lengths(directions)
        return rays

    def view_directions(self, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
        """Unit directions from each pixel's surface point towards the viewer: `-rays`."""
        rays = self.rays(height, width)
        return np.negative(rays, out=rays)

    def of_square(self, top: int, left: int, side: int, height: int, width: int) -> "Camera":
        """The camera of a square part of a picture: the same rays through the same pixels.

        Args:
            top: its first row; it may reach beyond the picture.
            left: its first column.
            side: of the square, pixels.
            height: of the picture, pixels.
            width: of the picture, pixels.
        """
        half = math.tan(math.radians(self.fov_deg) / 2) * side / height
        x = (self.principal[0] * width - left) / side
        y = (self.principal[1] * height - top) / side
        return Camera(fov_deg=math.degrees(2 * math.atan(half)), principal=(x, y))

    def distance(self, radius: float = 1.0, fill: float = DEFAULT_FILL) -> float:
        """Distance at which a sphere's silhouette fills `fill` of the frame height.

        A sphere of radius R at distance D has its silhouette at the angle asin(R / D) from the axis.
        """
        tangent = fill * math.tan(math.radians(self.fov_deg) / 2)
        return radius * math.sqrt(1 + 1 / tangent**2)


def _number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    return short if float(short := f"{value:g}") == value else repr(float(value))
