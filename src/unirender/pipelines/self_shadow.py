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

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Integer, Shaped, UInt8, UInt64
from scipy.ndimage import distance_transform_edt

from unirender.camera import Camera
from unirender.light.ggx import dot
from unirender.pipelines.normal_integration import integrate_normals
from unirender.vectors import nonzero

HALF_PLANES = 32  # evenly around the viewer's direction; a power of two
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
_BLOCK = 1 << 16  # of these, and pixels times steps: many passes go over them, so they stay in the processor's cache
_BORDER = 1e-4  # of a sector or half plane: far more than two libraries' angles differ by


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
        classes = self.classes(part, directions)
        return classes == 0, classes <= 1

    def classes(self, part: slice, directions: Float[np.ndarray, "3 m"]) -> UInt8[np.ndarray, "q m"]:
        """For each direction its number in `unirender.models.visibility.CLASSES`; arguments: `look`."""
        ray, (masks, behind) = self.ray[part], (_as_bytes(of[part]) for of in (self.hidden, self.behind))
        masks = (2 - behind) * (1 - masks)  # class of each half plane's sectors
        cosine = -ray / np.linalg.norm(ray, axis=1, keepdims=True) @ directions
        found = np.empty(cosine.shape, np.uint8)
        step = max(1, _BLOCK // cosine.shape[1])
        for some in (slice(i, i + step) for i in range(0, len(found), step)):
            x, y = ray[some, :1], ray[some, 1:2]
            # where the projection of a point goes that moves along the direction
            azimuth = _angle(
                torch.atan2,
                np.arctan2,
                HALF_PLANES / (2 * math.pi),
                0.5,
                directions[1] + y * directions[2],
                directions[0] + x * directions[2],
            )
            plane = np.rint(azimuth, out=azimuth).astype(np.int32) & (HALF_PLANES - 1)  # `%` is slow
            theta = _angle(torch.acos, np.arccos, SECTORS / math.pi, 0, np.clip(cosine[some], -1, 1))
            sector = np.minimum(theta, SECTORS - 1, out=theta).astype(np.int32)
            found[some] = of_rows(masks[some], plane * SECTORS + sector)
        return found

    def parts(self, directions: int) -> Iterator[slice]:
        """Pixels that fit into memory together with so many directions."""
        step = max(1, _CHUNK // directions)
        yield from (slice(i, i + step) for i in range(0, len(self.hidden), step))


def of_rows(table: Shaped[np.ndarray, "q t"], index: Integer[np.ndarray, "q m"]) -> Shaped[np.ndarray, "q m"]:
    """What stands in each row of a table in the columns that the same row of the index names."""
    found = np.empty(index.shape, table.dtype)
    step = max(1, _BLOCK // index.shape[1])
    first = np.arange(min(step, len(table)), dtype=np.int32)[:, None] * np.int32(table.shape[1])  # of a row
    for some in (slice(i, i + step) for i in range(0, len(table), step)):
        rows = table[some]
        found[some] = rows.reshape(-1).take(first[: len(rows)] + index[some])
    return found


def _as_bytes(masks: UInt64[np.ndarray, "q a"]) -> UInt8[np.ndarray, "q t"]:
    """The bits of a pixel's masks, one after another."""
    return np.unpackbits(masks.astype("<u8").view(np.uint8), axis=1, bitorder="little")


def _hidden(
    normal: Float[np.ndarray, "p 3"],
    rays: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    surface: Bool[np.ndarray, "h w"],
    camera: Camera,
) -> UInt64[np.ndarray, "2 p a"]:
    """The masks of the pixels of a surface: hidden, and behind."""
    height, width = depth.shape
    width_of_pixel = 2 * math.tan(math.radians(camera.fov_deg) / 2) / height  # at distance 1
    thick = ROUNDNESS * _distance_to_ends(depth, surface, CUT * width_of_pixel) * (width_of_pixel * depth)
    points = (rays * np.where(surface, depth, 0)[..., None]).astype(np.float32)[surface]
    walls = _Walls(
        np.ascontiguousarray(points.T),
        np.ascontiguousarray((points / np.linalg.norm(points, axis=1, keepdims=True)).T),
        np.ascontiguousarray(normal.T),
        thick[surface].astype(np.float32),
    )
    number = np.full((height + 2, width + 2), -1)
    number[1:-1, 1:-1][surface] = np.arange(len(points))
    rows, columns = _targets(height, width)
    row, column = np.nonzero(surface)
    masks = np.empty((2, len(points), HALF_PLANES), np.uint64)
    step = _BLOCK // STEPS
    for part in (slice(i, i + step) for i in range(0, len(points), step)):
        for plane in range(HALF_PLANES):
            met = rows[plane].take(row[part], axis=1) * number.shape[1] + columns[plane].take(column[part], axis=1)
            masks[:, part, plane] = walls.hide(part.start, number.take(met))
    return masks


def _targets(height: int, width: int) -> tuple[Int[np.ndarray, "a s h"], Int[np.ndarray, "a s w"]]:
    """Rows and columns to which the steps of each half plane lead from each row and column; in a frame padded by one,
    where whatever lies outside is on its border.
    """
    distances = np.geomspace(NEAREST, max(FARTHEST * max(height, width), 2 * NEAREST), STEPS)
    angles = [2 * math.pi * plane / HALF_PLANES for plane in range(HALF_PLANES)]
    down = np.array([-math.sin(angle) for angle in angles])[:, None] * distances
    right = np.array([math.cos(angle) for angle in angles])[:, None] * distances
    ends = (
        np.clip(np.round(np.arange(size) + offset[..., None]).astype(np.int64), -1, size) + 1
        for size, offset in ((height, down), (width, right))
    )
    return next(ends), next(ends)


@dataclass(frozen=True)
class _Walls:
    """The surface's pixels as what hides and what is hidden from.

    Attributes:
        at: where each is.
        away: unit direction from the viewer to it.
        normal: of it.
        thick: by so much it goes on behind.
    """

    at: Float[np.ndarray, "3 p"]
    away: Float[np.ndarray, "3 p"]
    normal: Float[np.ndarray, "3 p"]
    thick: Float[np.ndarray, " p"]

    def hide(
        self, start: int, met: Int[np.ndarray, "s q"]
    ) -> tuple[UInt64[np.ndarray, " q"], UInt64[np.ndarray, " q"]]:
        """Masks of a half plane.

        Args:
            start: number of the first of q pixels in a row.
            met: numbers of the pixels that each of them meets, step by step; -1: none.
        """
        hidden, lowest = np.zeros(met.shape, np.uint64), np.full(met.shape, SECTORS)
        where = np.flatnonzero(met >= 0)
        own, other = np.broadcast_to(np.arange(start, start + met.shape[1]), met.shape).take(where), met.take(where)
        towards = self.at.take(other, axis=1) - self.at.take(own, axis=1)
        length = np.sqrt(dot(towards, towards))
        above = np.flatnonzero(dot(towards, self.normal.take(own, axis=1)) > LEAST_RISE * length)
        where, own, other, length = (each.take(above) for each in (where, own, other, length))
        towards, view = towards.take(above, axis=1), -self.away.take(own, axis=1)
        deep = self.thick.take(other) + THICKENING * length
        behind = towards + self.away.take(other, axis=1) * deep
        first = _middles(dot(towards, view) / length)
        last = _middles(dot(behind, view) / np.sqrt(dot(behind, behind)))
        hidden.reshape(-1)[where] = _bits(first, last)
        lowest.reshape(-1)[where] = first
        return np.bitwise_or.reduce(hidden, axis=0), _bits(lowest.min(axis=0), np.full(met.shape[1], SECTORS))


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


def _middles(cosine: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """How many sectors have their middle below an angle of that cosine."""
    angle = _angle(torch.acos, np.arccos, SECTORS / math.pi, 0.5, np.clip(cosine, -1, 1))
    return np.clip(np.ceil(angle - 0.5), 0, SECTORS).astype(np.int64)


def _bits(first: Int[np.ndarray, " n"], last: Int[np.ndarray, " n"]) -> UInt64[np.ndarray, " n"]:
    """Masks of the sectors from `first` to before `last`."""
    ones = _ones()
    return ones.take(np.maximum(first, last)) ^ ones.take(first)


@functools.cache
def _ones() -> UInt64[np.ndarray, " n"]:
    """Masks of 0, 1, ... SECTORS lowest bits."""
    return np.array([(1 << count) - 1 for count in range(SECTORS + 1)], np.uint64)


def _angle(
    fast: Callable[..., torch.Tensor],
    exact: Callable[..., np.ndarray],
    scale: float,
    border: float,
    *arguments: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """`scale * exact(*arguments)`, to be rounded: torch is several times as fast as numpy, but for last bits.

    Args:
        fast: of torch.
        exact: the same of numpy, which is taken where last bits may decide.
        scale: parts by radian.
        border: of the parts, modulo 1.
        arguments: of both.
    """
    angle = fast(*map(torch.from_numpy, arguments)).numpy()
    angle *= scale
    apart = angle + border
    apart -= np.rint(apart)
    near = np.flatnonzero(np.abs(apart, out=apart) < _BORDER)
    if len(near):
        angle.reshape(-1)[near] = scale * exact(*(argument.take(near) for argument in arguments))
    return angle
