"""Any picture size <-> the model's square: pad to a square, resample; and back.

Pictures are resampled premultiplied and in linear light, so that no background bleeds in. A picture that has the
model's size passes through untouched.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.lighting import resample_environment

MIN_NORMAL = 1e-3  # length below which a mean of normals has no direction
MIN_COVERAGE = 1e-3  # below it a resampled pixel carries no colour


@dataclass(frozen=True)
class Frame:
    """How a picture of `height` x `width` sits in the model's square.

    Attributes:
        height: of the picture, pixels.
        width: of the picture, pixels.
        size: of the model's square, pixels.
    """

    height: int
    width: int
    size: int

    @property
    def identity(self) -> bool:
        return self.height == self.width == self.size

    @property
    def side(self) -> int:
        """Side of the padded square, picture pixels."""
        return max(self.height, self.width)

    @property
    def offset(self) -> tuple[int, int]:
        """Rows above and columns left of the picture in the padded square."""
        return (self.side - self.height) // 2, (self.side - self.width) // 2

    def camera(self, camera: Camera) -> Camera:
        """The same camera for the padded square."""
        half = math.tan(math.radians(camera.fov_deg) / 2) * self.side / self.height
        top, left = self.offset
        x = (camera.principal[0] * self.width + left) / self.side
        y = (camera.principal[1] * self.height + top) / self.side
        return Camera(fov_deg=math.degrees(2 * math.atan(half)), principal=(x, y))

    def enter(self, picture: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "s s c"]:
        """Picture -> square; for premultiplied pictures and coverage."""
        if self.identity:
            return picture
        top, left = self.offset
        bottom, right = self.side - self.height - top, self.side - self.width - left
        return resize(np.pad(picture, ((top, bottom), (left, right), (0, 0))), (self.size, self.size))

    def leave(self, picture: Float[np.ndarray, "s s c"]) -> Float[np.ndarray, "h w c"]:
        """Square -> picture; for premultiplied pictures and coverage."""
        if self.identity:
            return picture
        top, left = self.offset
        return resize(picture, (self.side, self.side))[top : top + self.height, left : left + self.width]

    def enter_map(
        self, value: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]
    ) -> Float[np.ndarray, "s s c"]:
        """A map that is not premultiplied -> square: coverage-weighted mean, 0 without coverage."""
        return value if self.identity else divide(self.enter(value * mask), self.enter(mask))

    def leave_map(
        self, value: Float[np.ndarray, "s s c"], mask: Float[np.ndarray, "h w 1"]
    ) -> Float[np.ndarray, "h w c"]:
        """A map that is not premultiplied -> picture; 0 where the picture's mask is 0."""
        if not self.identity:
            inside = self.enter(mask)
            value = divide(self.leave(value * inside), self.leave(inside))
        return np.where(mask > 0, value, 0).astype(np.float32)

    def enter_intrinsics(self, intrinsics: Intrinsics, environment_size: tuple[int, int] | None = None) -> Intrinsics:
        """All maps and the camera -> square; the mask has to be known.

        Args:
            intrinsics: at the picture's size.
            environment_size: rows and columns that the environment gets; None: it stays as it is.
        """
        mask = intrinsics.require("mask")["mask"]
        maps = {name: value for name, value in intrinsics.maps.items() if name not in ("mask", "environment")}
        changes = {name: self.enter_map(value, mask) for name, value in maps.items()}
        if "normal" in changes:
            changes["normal"] = unit_normal(changes["normal"])
        environment = intrinsics.environment
        if environment is not None and environment_size and environment.shape[:2] != environment_size:
            environment = resample_environment(environment, environment_size)
        mask, camera = np.clip(self.enter(mask), 0, 1), self.camera(intrinsics.camera)
        return Intrinsics(mask=mask, environment=environment, camera=camera).replace(**changes)


def resize(picture: Float[np.ndarray, "h w c"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2 c"]:
    """Bilinear, with an antialiasing support where it shrinks."""
    tensor = torch.from_numpy(np.ascontiguousarray(picture, dtype=np.float32)).permute(2, 0, 1)[None]
    return F.interpolate(tensor, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0).numpy()


def divide(premultiplied: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w c"]:
    """Undoes a premultiplication; 0 where there is no coverage."""
    return np.where(mask > MIN_COVERAGE, premultiplied / np.maximum(mask, MIN_COVERAGE), 0).astype(np.float32)


def unit_normal(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Normals of length 1; 0 stays 0."""
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length > MIN_NORMAL, normal / np.maximum(length, MIN_NORMAL), 0).astype(np.float32)
