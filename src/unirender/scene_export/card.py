"""The card: maps without holes, and the rectangle in front of the camera on which they are seen."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from unirender.arguments import as_instance
from unirender.camera import Camera
from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics

LEAST_FACING = 0.01  # cosine to the viewer to which normals that face away are bent, as `shade` of the reference does


@dataclass(frozen=True)
class Card:
    """A flat card that fills the frame of a camera.

    Outside the mask every map continues what the nearest covered pixel has, so that interpolation between texels mixes
    nothing foreign into the object's edge.

    Attributes:
        albedo: linear, [0, 1].
        normal: unit, camera axes, facing the viewer of its pixel.
        roughness: perceptual, [0, 1].
        metallic: [0, 1].
        opacity: the mask, 0 where no normal is known.
        environment: the light, camera axes, on the grid of `unirender.light.environment`.
        camera: through which the card fills the frame.
    """

    albedo: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    roughness: Float[np.ndarray, "h w 1"]
    metallic: Float[np.ndarray, "h w 1"]
    opacity: Float[np.ndarray, "h w 1"]
    environment: Float[np.ndarray, "eh ew 3"]
    camera: Camera

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> "Card":
        """The card of a decomposition.

        Raises:
            UnirenderError: a map is missing, there are several pictures, or nothing is covered.
        """
        as_instance(intrinsics, Intrinsics, "export")
        maps = intrinsics.require("albedo", "normal", "roughness", "metallic", "environment")
        environment, normal = maps.pop("environment"), maps["normal"]
        if normal.ndim != 3:
            raise UnirenderError(f"export: got maps of shape {normal.shape}, expected one picture (h, w, c)")
        known = np.any(normal != 0, axis=-1, keepdims=True)
        opacity = np.where(known, 1 if intrinsics.mask is None else intrinsics.mask, 0).astype(np.float32)
        if not opacity.any():
            raise UnirenderError("export: no pixel is covered and has a normal, expected an object")
        view = intrinsics.camera.view_directions(*normal.shape[:2])
        filled = {name: continued(value, opacity[..., 0] > 0) for name, value in maps.items()}
        filled["normal"] = facing(filled["normal"], view)
        unit_range = {name: np.clip(filled[name], 0, 1) for name in ("albedo", "roughness", "metallic")}
        return cls(
            **(filled | unit_range), opacity=np.clip(opacity, 0, 1), environment=environment, camera=intrinsics.camera
        )

    @property
    def height(self) -> int:
        return self.albedo.shape[0]

    @property
    def width(self) -> int:
        return self.albedo.shape[1]

    @property
    def distance(self) -> float:
        """Of the card from the camera: a unit sphere there would have the frame of the training data."""
        return self.camera.distance()

    def points(self, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
        """Places on the card (plane z = 0) of fractions of the frame from its top-left corner."""
        pixel = 2 * self.distance * math.tan(math.radians(self.camera.fov_deg) / 2) / self.height
        x = (u - self.camera.principal[0]) * self.width * pixel
        y = -(v - self.camera.principal[1]) * self.height * pixel
        return np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.float32)

    def base_color_srgb(self) -> Float[np.ndarray, "h w 4"]:
        """Straight display values with alpha."""
        return np.concatenate([image_srgb(self.albedo), self.opacity], axis=-1)

    def metallic_roughness(self) -> Float[np.ndarray, "h w 3"]:
        """As glTF 2.0 wants it: roughness in G, metallic in B."""
        return np.concatenate([np.zeros_like(self.roughness), self.roughness, self.metallic], axis=-1)

    def tangent_normal(self) -> Float[np.ndarray, "h w 3"]:
        """(n + 1) / 2, green up: on a card that faces the camera the tangent frame is the camera's.

        Normals that face the viewer of an off-centre pixel but not the card's front are bent until they do.
        """
        z_only = np.broadcast_to(np.array([0, 0, 1], np.float32), self.normal.shape)
        return (facing(self.normal, z_only) + 1) / 2


def facing(normal: Float[np.ndarray, "h w 3"], view: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Unit normals; those that face away from `view` are bent towards it until they do not."""
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = (normal * view).sum(axis=-1, keepdims=True)
    bent = normal + view * np.maximum(LEAST_FACING - cosine, 0)
    return (bent / np.linalg.norm(bent, axis=-1, keepdims=True)).astype(np.float32)


def continued(values: Float[np.ndarray, "h w c"], inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w c"]:
    """The values, and outside of `inside` (h, w) those of the nearest pixel in it."""
    from scipy.ndimage import distance_transform_edt

    nearest = np.asarray(distance_transform_edt(~inside, return_distances=False, return_indices=True))
    return values[nearest[0], nearest[1]]
