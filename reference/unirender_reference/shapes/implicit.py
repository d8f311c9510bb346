"""Families given by a signed distance: smooth unions and differences of primitives, meshed by marching cubes.

Distances are bounds, not exact, once smoothed or displaced; only the zero set matters here.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from skimage.measure import marching_cubes

from unirender_reference.shapes.noise import random_direction, value_noise
from unirender_reference.shapes.surface import Part, box_part

GRID = 54
SCOUT = 26
HALF = 1.3

Distance = Callable[[Float[np.ndarray, "*shape 3"]], Float[np.ndarray, "*shape"]]


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """A rotation drawn uniformly (unit quaternion)."""
    quaternion = rng.normal(size=4)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _length(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...k,...k->...", x, x))


def primitive(rng: np.random.Generator, size: float, center: Float[np.ndarray, "3"]) -> Distance:
    """A sphere, ellipsoid, rounded box, torus, cylinder or capsule in a random pose."""
    kind = rng.choice(["sphere", "ellipsoid", "box", "box", "torus", "cylinder", "cylinder", "capsule"])
    rotation = random_rotation(rng).astype(np.float32)
    a, b, c = (size * rng.uniform(0.45, 1, 3)).astype(np.float32)
    center = center.astype(np.float32)

    def distance(points: np.ndarray) -> np.ndarray:
        p = (points - center) @ rotation
        if kind == "sphere":
            return _length(p) - a
        if kind == "ellipsoid":
            scaled = _length(p / np.array([a, b, c]))
            return (scaled - 1) * min(a, b, c)
        if kind == "box":
            edge = 0.15 * min(a, b, c)
            q = np.abs(p) - (np.array([a, b, c]) - edge)
            return _length(np.maximum(q, 0)) + np.minimum(q.max(-1), 0) - edge
        if kind == "torus":
            ring = np.sqrt(p[..., 0] ** 2 + p[..., 2] ** 2) - a
            return np.sqrt(ring**2 + p[..., 1] ** 2) - 0.4 * b
        if kind == "cylinder":
            edge = 0.1 * min(a, b)
            radial = np.sqrt(p[..., 0] ** 2 + p[..., 2] ** 2) - 0.8 * a + edge
            axial = np.abs(p[..., 1]) - b + edge
            outside = np.sqrt(np.maximum(radial, 0) ** 2 + np.maximum(axial, 0) ** 2)
            return outside + np.minimum(np.maximum(radial, axial), 0) - edge
        along = np.clip(p[..., 1], -b, b)
        return np.sqrt(p[..., 0] ** 2 + (p[..., 1] - along) ** 2 + p[..., 2] ** 2) - 0.5 * a

    return distance


def smooth_min(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Quilez's polynomial smooth minimum: a fillet of size about k."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * (k / 4)


def mesh_field(distance: Distance, cells: int = GRID) -> Part:
    """The zero set of a field (negative inside) as a closed mesh: its largest piece inside [-HALF, HALF]^3.

    A coarse grid finds where the solid is; `cells` cells then span its longest side.
    """
    scout = distance(_lattice(np.full(3, -HALF), 2 * HALF / (SCOUT - 1), (SCOUT,) * 3))
    inside = np.argwhere(scout < 1.2 * HALF / SCOUT)
    step = 2 * HALF / (SCOUT - 1)
    low = np.maximum(inside.min(0) - 1.5, 0) * step - HALF if len(inside) else np.full(3, -HALF)
    high = np.minimum(inside.max(0) + 1.5, SCOUT - 1) * step - HALF if len(inside) else np.full(3, HALF)
    spacing = float((high - low).max()) / (cells - 1)
    count = np.ceil((high - low) / spacing).astype(int) + 1
    field = distance(_lattice(low, spacing, (int(count[0]), int(count[1]), int(count[2])))).astype(np.float32)
    for axis in range(3):
        wall = np.moveaxis(field, axis, 0)
        wall[[0, -1]] = np.maximum(wall[[0, -1]], spacing)
    labelled: Any = ndimage.label(field < 0)
    pieces, number = labelled
    if number > 1:
        largest = 1 + int(np.argmax(np.bincount(pieces.reshape(-1))[1:]))
        field = np.where((pieces > 0) & (pieces != largest), 0.5 * spacing, field)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(spacing,) * 3, allow_degenerate=False)
    return box_part((vertices + low).astype(np.float32), faces.astype(np.int64), crease_deg=180)


def _lattice(low: np.ndarray, spacing: float, count: tuple[int, ...]) -> Float[np.ndarray, "i j k 3"]:
    axes = [(low[k] + spacing * np.arange(count[k])).astype(np.float32) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def _spread(rng: np.random.Generator, count: int, reach: float) -> Float[np.ndarray, "count 3"]:
    """Centres that hang together: each starts near an earlier one."""
    centers = [np.zeros(3)]
    for _ in range(count - 1):
        step = random_direction(rng) * rng.uniform(0.5, 1) * reach
        centers.append(np.clip(centers[int(rng.integers(len(centers)))] + step, -0.7, 0.7))
    return np.array(centers)


def union_of(solids: Sequence[Distance], k: float) -> Distance:
    """Smooth union, fillets of size k."""
    return lambda points: functools.reduce(lambda a, b: smooth_min(a, b, k), [solid(points) for solid in solids])


def carved(body: Distance, cutters: Sequence[Distance], k: float) -> Distance:
    """Smooth difference: the body without the cutters, edges rounded by k."""
    outside = union_of([lambda points: -body(points), *cutters], k)
    return lambda points: -outside(points)


def _cluster(rng: np.random.Generator, count: int) -> Distance:
    k = float(rng.choice([0.03, rng.uniform(0.05, 0.35)]))
    return union_of([primitive(rng, rng.uniform(0.3, 0.6), center) for center in _spread(rng, count, 0.55)], k)


def smooth_union(rng: np.random.Generator) -> Part:
    """Two to five primitives melted together."""
    return mesh_field(_cluster(rng, int(rng.integers(2, 6))))


def smooth_difference(rng: np.random.Generator) -> Part:
    """One or two primitives with one to three others carved out."""
    solids = [primitive(rng, rng.uniform(0.75, 1.0), np.zeros(3))]
    if rng.random() < 0.5:
        solids.append(primitive(rng, 0.5, rng.uniform(-0.5, 0.5, 3)))
    cutters = [
        primitive(rng, rng.uniform(0.25, 0.5), random_direction(rng) * rng.uniform(0.45, 0.8))
        for _ in range(int(rng.integers(1, 4)))
    ]
    body = union_of(solids, 0.08)
    solid = carved(body, cutters, 0.04)
    scout = solid(_lattice(np.full(3, -HALF), 2 * HALF / (SCOUT - 1), (SCOUT,) * 3))
    return mesh_field(solid if (scout < 0).mean() > 0.01 else body)


def displaced_union(rng: np.random.Generator) -> Part:
    """One to three primitives displaced by fractal noise: bark, clay, coral."""
    solid, noise = _cluster(rng, int(rng.integers(1, 4))), value_noise(rng)
    frequency, amplitude = np.float32(rng.uniform(1.5, 4)), np.float32(rng.uniform(0.06, 0.18))
    return mesh_field(lambda points: solid(points) - amplitude * noise.fractal(points * frequency, 2))


def shell(rng: np.random.Generator) -> Part:
    """Hollowed union opened by a plane: bowls, helmets, broken pots."""
    solids = [primitive(rng, rng.uniform(0.7, 0.95), np.zeros(3)), primitive(rng, 0.5, rng.uniform(-0.4, 0.4, 3))]
    solid, normal, offset = union_of(solids, 0.15), random_direction(rng), rng.uniform(-0.1, 0.4)

    def field(points: np.ndarray) -> np.ndarray:
        hollow = np.abs(solid(points) + 0.09) - 0.09
        plane = points @ normal.astype(np.float32) - np.float32(offset)
        return -smooth_min(-hollow, -plane, 0.05)

    return mesh_field(field)


def stacked_blobs(rng: np.random.Generator) -> Part:
    """A leaning stack of four to nine spheres (held out of training)."""
    count = int(rng.integers(4, 10))
    angle = rng.uniform(0, 2 * np.pi) + np.arange(count) * rng.uniform(0.7, 2.2)
    swing = rng.uniform(0, 0.45)
    centers = np.stack([swing * np.cos(angle), np.linspace(-0.75, 0.75, count), swing * np.sin(angle)], -1)
    radii = rng.uniform(0.16, 0.38, count).astype(np.float32)

    def ball(center: np.ndarray, radius: np.float32) -> Distance:
        return lambda points: _length(points - center) - radius

    return mesh_field(union_of([ball(c, r) for c, r in zip(centers.astype(np.float32), radii, strict=True)], 0.1))


def gyroid(rng: np.random.Generator) -> Part:
    """A thickened gyroid cut by a ball or a cube (held out of training)."""
    rotation, frequency = random_rotation(rng).astype(np.float32), np.float32(rng.uniform(3.0, 5.0))
    phase, thickness, round_cut = rng.uniform(0, 6, 3).astype(np.float32), rng.uniform(0.45, 0.75), rng.random() < 0.5

    def field(points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(points @ rotation * frequency + phase, -1, 0)
        sheet = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
        body = _length(points) - 1 if round_cut else np.abs(points).max(-1) - 0.85
        return -smooth_min(-(np.abs(sheet) - thickness) / 4, -body, 0.04)

    return mesh_field(field, 42)


TRAIN_FAMILIES = {f.__name__: f for f in (smooth_union, smooth_difference, displaced_union, shell)}
HELD_OUT_FAMILIES = {f.__name__: f for f in (stacked_blobs, gyroid)}
