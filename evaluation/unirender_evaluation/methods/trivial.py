"""The rows that a method must beat: answers that look at no more than the picture's values, or at nothing.

They need no network and no renderer; those of the light are in `methods.light`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import Image, Mask, seen_linear, uniform_map
from unirender_evaluation.training_statistics import training_statistics


class UneditedInput:
    """Answers every edit and every relighting with the picture it was given."""

    name = "unedited input"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "unedited"})

    def edit(self, image_srgb: Image, mask: Mask, camera: Camera, **_: Any) -> Image:
        return seen_linear(image_srgb, mask)

    def relight(self, image_srgb: Image, mask: Mask, camera: Camera, **_: Any) -> Image:
        return seen_linear(image_srgb, mask)


class InputAsAlbedo:
    """albedo = the picture, linear."""

    name = "input as albedo"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "input-as-albedo"})

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        return Intrinsics(albedo=srgb_decode(image_srgb), mask=mask, camera=camera)


class MeanAlbedo:
    """albedo = the training objects' mean, the mean taken of display values (the best constant for a PSNR in sRGB)."""

    name = "mean albedo"

    @property
    def config(self) -> dict[str, Any]:
        return {"trivial": "mean-albedo", "albedo_srgb": training_statistics()["albedo_srgb"]}

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        albedo = srgb_decode(np.array(training_statistics()["albedo_srgb"], np.float32))
        return Intrinsics(albedo=uniform_map(mask, albedo), mask=mask, camera=camera)


class MeanNormal:
    """normal = the training objects' mean direction, which faces the viewer."""

    name = "mean normal"

    @property
    def config(self) -> dict[str, Any]:
        return {"trivial": "mean-normal", "normal": training_statistics()["normal"]}

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        return Intrinsics(normal=uniform_map(mask, training_statistics()["normal"]), mask=mask, camera=camera)


class SphereNormal:
    """normal = that of the sphere around the mask: what a silhouette alone suggests."""

    name = "sphere normal"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "sphere-normal"})

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        rows, columns = np.nonzero(mask[..., 0] > 0)
        if not len(rows):
            return Intrinsics(normal=np.zeros_like(image_srgb), mask=mask, camera=camera)
        centre = (rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2
        half = (np.ptp(rows) + 1) / 2, (np.ptp(columns) + 1) / 2
        y, x = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float32)
        x, y = (x - centre[1]) / half[1], -(y - centre[0]) / half[0]
        radius = np.sqrt(x**2 + y**2)
        x, y = x / np.maximum(radius, 1.0), y / np.maximum(radius, 1.0)
        normal = np.stack([x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], axis=-1)
        return Intrinsics(normal=np.where(mask > 0, normal, 0.0), mask=mask, camera=camera)


class ConstantMaterial:
    """metallic = roughness = 0.5."""

    name = "constant 0.5"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "constant", "value": 0.5})

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        half = uniform_map(mask, 0.5)
        return Intrinsics(metallic=half, roughness=half, mask=mask, camera=camera)
