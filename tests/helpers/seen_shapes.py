"""Shapes as a picture shows them, whose depth is known in closed form."""

import math

import numpy as np

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics

CAMERA = Camera()
SIZE = 48


def rays(size: int = SIZE, camera: Camera = CAMERA) -> np.ndarray:
    """(x, y, -1) of each pixel."""
    directions = camera.rays(size, size)
    return directions / -directions[..., 2:]


def ball(size: int = SIZE, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, mask and depth along the view axis of a unit ball."""
    r = rays(size, camera).astype(np.float64)
    distance = camera.distance()
    a, b, c = (r * r).sum(-1), distance * np.ones(r.shape[:2]), distance**2 - 1
    root = b**2 - a * c
    hit = root > 0
    depth = np.where(hit, (b - np.sqrt(np.maximum(root, 0))) / a, 1)
    normal = np.where(hit[..., None], r * depth[..., None] + np.array([0, 0, distance]), 0)
    return normal.astype(np.float32), hit[..., None].astype(np.float32), depth


def gutter(size: int = SIZE, slope_deg: float = 45.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two planes that meet in the vertical middle line, which is the farthest: both face it."""
    r = rays(size)
    slope = math.tan(math.radians(slope_deg))
    left = r[..., 0] < 0
    # x = -z' / slope on the left, +z' / slope on the right, z' = 4 - depth
    depth = 4 / (1 + slope * np.abs(r[..., 0]))
    c, s = math.cos(math.radians(slope_deg)), math.sin(math.radians(slope_deg))
    normal = np.where(left[..., None], [s, 0, c], [-s, 0, c]).astype(np.float32)
    return normal, np.ones((size, size, 1), np.float32), depth


def as_maps(normal: np.ndarray, mask: np.ndarray, roughness: float = 0.6) -> Intrinsics:
    return Intrinsics(normal=normal, mask=mask, roughness=(roughness * mask).astype(np.float32), camera=CAMERA)
