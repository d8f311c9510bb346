"""Posed pictures with known pixels, and small objects with textures, for the tests of the optimiser."""

import dataclasses

import numpy as np

from unirender.camera import Camera
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject, make_object


def painted_view(azimuth_deg: float, size: tuple[int, int] = (12, 16), hdr: bool = False, name: str = "view") -> View:
    """A disc of 8-bit noise with soft edges; HDR values reach 4."""
    rng = np.random.default_rng(round(azimuth_deg) + 1)
    height, width = size
    row, column = np.indices(size) + 0.5
    radius = np.hypot(row - height / 2, column - width / 2)
    mask = np.round(np.clip(0.42 * height - radius + 0.5, 0, 1) * 255)[..., None] / 255
    image = rng.uniform(0, 4, (*size, 3)) if hdr else rng.integers(0, 256, (*size, 3)) / 255
    camera = Camera(36.0)
    pose = pose_towards(azimuth_deg, 10.0, camera)
    return View(np.where(mask > 0, image, 0).astype(np.float32), mask.astype(np.float32), camera, pose, name)


def painted_views(seen: int = 3, held_out: int = 1, size: tuple[int, int] = (12, 16), hdr: bool = False) -> Views:
    """Painted views around the object."""
    views = [painted_view(360 * k / (seen + held_out), size, hdr, f"view {k}") for k in range(seen + held_out)]
    return Views(tuple(views[:seen]), tuple(views[seen:]), hdr)


def textured_object(seed: int = 0, side: int = 24) -> MeshObject:
    """A procedural object whose three textures hold noise in 8-bit steps of their own file."""
    from unirender.color import srgb_decode

    obj = make_object(seed, "train", maps=True)
    rng = np.random.default_rng(seed)
    albedo = srgb_decode(rng.integers(0, 256, (side, side, 3)) / 255)
    roughness, metallic = (rng.integers(0, 256, (side, side)) / 255 for _ in range(2))
    return dataclasses.replace(
        obj,
        albedo=albedo.astype(np.float32),
        roughness=roughness.astype(np.float32),
        metallic=metallic.astype(np.float32),
        normal_map=None,
    )
