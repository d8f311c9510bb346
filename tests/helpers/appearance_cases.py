"""Tiny multi-view problems with known answers."""

from dataclasses import replace

import numpy as np

from unirender.camera import Camera
from unirender.color import image_srgb, unpremultiply
from unirender_reference.lights import make_light
from unirender_reference.multiview import orbit
from unirender_reference.optimize.shape.uv import charted
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.views import View, Views
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject, make_object

SIZE = 24
POINTS = 8  # along each side of a cell, over which a map is averaged


def bare(seed: int = 3, texture_size: int = 32) -> MeshObject:
    """A procedural mesh with charts, in grey."""
    obj = make_object(seed, "train")
    grey = np.full(3, 0.5, np.float32)
    return charted(replace(obj, albedo=grey, roughness=None, metallic=None), texture_size)


def two_colours(obj: MeshObject, texture_size: int = 32) -> MeshObject:
    """Reddish above, bluish below: an albedo texture by the height of the surface."""
    from unirender_reference.optimize.surface.points import blocker, trace_points
    from unirender_reference.optimize.surface.textures import footprint, spread

    camera = Camera()
    blank = np.zeros((64, 64, 3), np.float32)
    views = [View(blank, np.ones((64, 64, 1), np.float32), camera, pose) for pose in orbit(8, camera)]
    points = trace_points(blocker(obj), views, 4, 0)
    above = points.mean_position()[:, 1:2] > 0
    colour = np.where(above, [[0.6, 0.2, 0.1]], [[0.1, 0.3, 0.5]]).astype(np.float32)
    texels = spread(colour, np.ones(len(points), np.float32), footprint(points, texture_size))
    return replace(obj, albedo=texels.reshape(texture_size, texture_size, 3).astype(np.float32))


def averages(grid: LightGrid, environment: np.ndarray) -> np.ndarray:
    """Mean radiance of an environment map over each cell (midpoint rule, `POINTS` of them along each side)."""
    height, width = environment.shape[:2]
    upper, lower = grid.cosines
    part = (np.arange(POINTS) + 0.5) / POINTS
    theta = np.arccos(np.clip(upper[:, None] + (lower - upper)[:, None] * part, -1, 1)).ravel()
    y, x = (
        theta / np.pi * (height - 1),
        (np.arange(grid.columns)[:, None] + part).ravel() / grid.columns * width - 0.5,
    )
    top, left = np.clip(np.floor(y).astype(int), 0, height - 2), np.floor(x).astype(int)
    down, right = (y - top)[:, None, None], (x - left)[None, :, None]

    def texels(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        return environment[row][:, column % width]

    above = texels(top, left) * (1 - right) + texels(top, left + 1) * right
    below = texels(top + 1, left) * (1 - right) + texels(top + 1, left + 1) * right
    fine = above * (1 - down) + below * down
    blocks = fine.reshape(grid.rows, POINTS, grid.columns, POINTS, 3)
    return blocks.mean(axis=(1, 3)).reshape(-1, 3).astype(np.float32)


def coarse_light(seed: int = 0, rows: int = 8) -> np.ndarray:
    """A light that a grid of so many rows holds, as an environment map on it."""
    grid = LightGrid(rows, 2 * rows)
    cells = averages(grid, make_light(seed, "train").environment)
    return grid.environment(np.maximum(cells, 0.02))


def pictures(
    obj: MeshObject,
    light: np.ndarray,
    roughness: float | None,
    metallic: float | None,
    count: int = 4,
    spp: int = 256,
    size: int = SIZE,
) -> Views:
    """8-bit views of an object."""
    camera = Camera()
    renderer, poses = Renderer(obj, camera, size), orbit(count, camera)
    seen = []
    for pose, estimate in zip(poses, renderer.images(poses, light, roughness, metallic, spp), strict=True):
        mask = np.clip(estimate.mean[..., 3:], 0, 1)
        shown = np.round(image_srgb(unpremultiply(estimate.mean[..., :3], mask)) * 255) / 255
        seen.append(View(shown.astype(np.float32), mask, camera, pose))
    return Views(tuple(seen))
