"""Where the surfaces of a picture hide the light from one another, as far as the picture shows.

From a pixel one walks along lines of the picture. The surface that stands there, as thick as is assumed, hides a range
of directions: of the angle theta between them and the direction v to the viewer, in the half plane of v and the line. A
mask of 64 bits for each half plane says which of its directions are hidden (Therrien et al. 2023, "Screen space
indirect lighting with visibility bitmask"). Depth comes from the normals (`unirender.pipelines.normal_integration`).

How thick surfaces are no picture says. So a second mask has what they would hide if all behind them were solid: what
only that one has may be hidden or not.

What the picture does not show is in neither mask: the back of the object, and what lies outside the frame. What the
masks are worth, and what they miss, a network has learned (`unirender.models.visibility`).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt64
from scipy.ndimage import distance_transform_edt

from unirender.camera import Camera
from unirender.pipelines.normal_integration import integrate_normals
from unirender.vectors import nonzero

HALF_PLANES = 32  # evenly around the viewer's direction
SECTORS = 64  # of theta, from 0 to pi: the bits of a mask
STEPS = 24  # along each line, ever longer ones
NEAREST = 1.5  # pixels: the first step
FARTHEST = 0.8  # of the frame's longer side: the last one
CUT = 4.0  # widths of a pixel by which the depths of neighbours differ where one surface ends in front of another
ROUNDNESS = 2.0  # times its distance from where it ends is as thick as a surface is taken to be there
THICKENING = 0.05  # by so much more for each unit of distance: directions between two steps
LEAST_RISE = 0.05  # sine of the angle above the surface below which it does not hide itself
COVERED = 0.5  # coverage from which a pixel is a surface that hides others
_CHUNK = 1 << 20  # pixels times directions at a time


@dataclass(frozen=True)
class SelfShadow:
    """Which directions the surfaces of a picture hide from one another.

    Attributes:
        where: pixels of a surface, covered by half or more; p of them, in the order of the picture.
        hidden: for each of these pixels and each half plane a mask, bit by bit of theta.
        behind: the same of what lies in or behind what hides.
        ray: the pixels' rays (x, y, -1).
        depth: along the view axis, up to a factor; NaN where there is no surface.
    """

    where: Bool[np.ndarray, "h w"]
    hidden: UInt64[np.ndarray, "p a"]
    behind: UInt64[np.ndarray, "p a"]
    ray: Float[np.ndarray, "p 3"]
    depth: Float[np.ndarray, "h w"]

    @classmethod
    def of(cls, normal: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], camera: Camera) -> "SelfShadow":
        """Of a picture.

        Args:
            normal: camera axes, unit; where it is 0 there is no surface.
            mask: coverage.
            camera: that took it.
        """
        surface = (mask[..., 0] >= COVERED) & nonzero(normal)
        rays = camera.rays(*surface.shape)
        rays = rays / -rays[..., 2:]
        depth = integrate_normals(normal, surface, camera)
        hidden, behind = np.zeros((2, int(surface.sum()), HALF_PLANES), np.uint64)
        if surface.any():
            hidden, behind = _hidden(normal[surface], rays, depth, surface, camera)
        return cls(surface, hidden, behind, rays[surface].astype(np.float32), depth)

    def look(
        self, part: slice, directions: Float[np.ndarray, "3 m"]
    ) -> tuple[Bool[np.ndarray, "q m"], Bool[np.ndarray, "q m"]]:
        """Which directions are hidden from pixels, and which lie behind what hides: these and others.

        Args:
            part: of the p pixels.
            directions: unit, camera axes.
        """
        x, y = self.ray[part, :1], self.ray[part, 1:2]
        view = -self.ray[part] / np.linalg.norm(self.ray[part], axis=1, keepdims=True)
        # where the projection of a point goes that moves along the direction
        azimuth = np.arctan2(directions[1] + y * directions[2], directions[0] + x * directions[2])
        plane = np.round(azimuth * (HALF_PLANES / (2 * math.pi))).astype(np.int64) % HALF_PLANES
        theta = np.arccos(np.clip(view @ directions, -1, 1))
        sector = np.minimum(theta * (SECTORS / math.pi), SECTORS - 1).astype(np.uint64)
        masks = (np.take_along_axis(of[part], plane, axis=1) for of in (self.hidden, self.behind))
        hidden, behind = ((mask >> sector) & np.uint64(1) == 1 for mask in masks)
        return hidden, behind

    def classes(self, part: slice, directions: Float[np.ndarray, "3 m"]) -> UInt8[np.ndarray, "q m"]:
        """For each direction its number in `unirender.models.visibility.CLASSES`; arguments: `look`."""
        hidden, behind = self.look(part, directions)
        return np.where(hidden, np.uint8(0), np.where(behind, np.uint8(1), np.uint8(2)))

    def parts(self, directions: int) -> Iterator[slice]:
        """Pixels that fit into memory together with so many directions."""
        step = max(1, _CHUNK // directions)
        yield from (slice(i, i + step) for i in range(0, len(self.hidden), step))


def _hidden(
    normal: Float[np.ndarray, "p 3"],
    rays: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    surface: Bool[np.ndarray, "h w"],
    camera: Camera,
) -> UInt64[np.ndarray, "2 p a"]:
    """The masks of the pixels of a surface: hidden, and behind."""
    height, width = depth.shape
    row, column = (index.astype(np.float32) for index in np.nonzero(surface))
    width_of_pixel = 2 * math.tan(math.radians(camera.fov_deg) / 2) / height  # at distance 1
    pixel = width_of_pixel * depth
    thick = (ROUNDNESS * _distance_to_ends(depth, surface, CUT * width_of_pixel) * pixel).astype(np.float32)
    points = (rays * np.where(surface, depth, 0)[..., None]).astype(np.float32)
    at = points[surface]
    view = -at / np.linalg.norm(at, axis=1, keepdims=True)
    masks = np.zeros((2, len(at), HALF_PLANES), np.uint64)
    for plane in range(HALF_PLANES):
        right, up = math.cos(2 * math.pi * plane / HALF_PLANES), math.sin(2 * math.pi * plane / HALF_PLANES)
        for distance in np.geomspace(NEAREST, max(FARTHEST * max(height, width), 2 * NEAREST), STEPS):
            i = np.round(row - up * distance).astype(np.int64)
            j = np.round(column + right * distance).astype(np.int64)
            in_frame = (i >= 0) & (i < height) & (j >= 0) & (j < width)
            i, j = np.where(in_frame, i, 0), np.where(in_frame, j, 0)
            there = np.flatnonzero(in_frame & surface[i, j])
            front = points[i[there], j[there]]
            towards = front - at[there]
            length = np.linalg.norm(towards, axis=1)
            above = (towards * normal[there]).sum(axis=1) > LEAST_RISE * length
            there, front, towards, length = there[above], front[above], towards[above], length[above]
            deep = thick[i[there], j[there]] + THICKENING * length
            away = front / np.linalg.norm(front, axis=1, keepdims=True)
            behind = towards + away * deep[:, None]
            first = _sector((towards * view[there]).sum(axis=1) / length)
            last = _sector((behind * view[there]).sum(axis=1) / np.linalg.norm(behind, axis=1))
            masks[0, there, plane] |= _bits(first, last)
            masks[1, there, plane] |= _bits(first, np.full_like(first, SECTORS))
    return masks


def _distance_to_ends(
    depth: Float[np.ndarray, "h w"], surface: Bool[np.ndarray, "h w"], limit: float
) -> Float[np.ndarray, "h w"]:
    """Pixels from each pixel of a surface to the nearest where it ends or another one begins; 0 there."""
    z = np.log(np.where(surface, depth, 1))
    whole = surface.copy()
    for before, after in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        step = np.abs(z[after] - z[before]) > limit
        whole[before] &= ~step
        whole[after] &= ~step
    return np.asarray(distance_transform_edt(np.pad(whole, 1)))[1:-1, 1:-1]


def _sector(cosine: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """The angle, in sectors."""
    return np.arccos(np.clip(cosine, -1, 1)) * (SECTORS / math.pi)


def _bits(first: Float[np.ndarray, " p"], last: Float[np.ndarray, " p"]) -> UInt64[np.ndarray, " p"]:
    """Masks of the sectors whose middle lies between two angles."""
    low = np.clip(np.ceil(first - 0.5), 0, SECTORS).astype(np.uint64)
    high = np.clip(np.ceil(last - 0.5), 0, SECTORS).astype(np.uint64)
    return np.where(high > low, _ones(high) ^ _ones(low), np.uint64(0))


def _ones(count: UInt64[np.ndarray, " p"]) -> UInt64[np.ndarray, " p"]:
    """Masks of so many lowest bits; 64 of them at most."""
    full = np.uint64(0xFFFFFFFFFFFFFFFF)
    return np.where(count >= SECTORS, full, (np.uint64(1) << np.minimum(count, SECTORS - 1)) - np.uint64(1))
