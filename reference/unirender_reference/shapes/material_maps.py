"""Roughness, metallic and normal maps of procedural objects.

A *solid material* is a function from points of R^3 (the object about in [-1, 1]^3) to roughness, metallic and height;
maps are baked by evaluating it on a part's position map, as base colours are (`unirender_reference.textures`). Most
objects are made of one or two materials, so metallic is two-level with soft borders, and roughness varies within a
range around a value of each material. The normal map is the slope of the height along the surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from unirender.errors import UnirenderError
from unirender_reference.shapes.noise import ValueNoise, random_direction, soft_step, value_noise

ROUGHEST, SMOOTHEST = 0.95, 0.08
STEEPEST = 0.8  # slope of the height, 39 degrees

KINDS = {"plain": 0.2, "worn": 0.22, "stripes": 0.16, "patches": 0.22, "scratches": 0.2}

Field = Callable[[Float[np.ndarray, "h w 3"]], Float[np.ndarray, "h w"]]


@dataclass(frozen=True)
class BakedMaps:
    """Baked maps of one part: roughness (perceptual) and metallic in [0, 1], unit normals in tangent space."""

    roughness: Float[np.ndarray, "h w"]
    metallic: Float[np.ndarray, "h w"]
    normal_map: Float[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class SolidMaterial:
    """Two materials and where the second lies, with bumps of their own.

    Attributes:
        kind: one of `KINDS`.
        share: how much of the second material a point is made of, [0, 1].
        roughness: of the two.
        metallic: of the two, 0 or 1.
        variation: how far roughness strays from its value.
        relief: height of the second material over the first, negative for grooves.
        bumps: height of the fine structure of the first material.
        noise: for both.
        frequency: of the fine structure.
    """

    kind: str
    share: Field
    roughness: tuple[float, float]
    metallic: tuple[float, float]
    variation: float
    relief: float
    bumps: float
    noise: ValueNoise
    frequency: float

    def bake(self, position_map: Float[np.ndarray, "h w 3"]) -> BakedMaps:
        """The maps of a part whose texels show the points of `position_map`.

        Raises:
            UnirenderError: it has one row or one column, or all its points are one.
        """
        if min(position_map.shape[:2]) < 2:
            raise UnirenderError(f"position map: got {position_map.shape[:2]} texels, expected at least (2, 2)")
        low, high = position_map.min((0, 1)), position_map.max((0, 1))
        extent = np.linalg.norm(high - low)
        if not extent > 0:
            raise UnirenderError(f"position map: all points are {low.tolist()}, expected a surface with an extent")
        points = ((position_map - (low + high) / 2) / (extent / 2)).astype(np.float32)
        share = np.clip(self.share(points), 0, 1)
        fine = self.noise.fractal(points * self.frequency, 2)
        smudge = self.variation * self.noise.fractal(points * 1.7 + 11, 2)
        roughness = np.clip(_mix(self.roughness, share) + smudge, SMOOTHEST, ROUGHEST)
        height = self.relief * share + self.bumps * fine * (1 - share)
        return BakedMaps(
            roughness.astype(np.float32),
            np.clip(_mix(self.metallic, share), 0, 1).astype(np.float32),
            normal_from_height(height, points),
        )


def random_material(rng: np.random.Generator) -> SolidMaterial:
    """Draws a kind of pattern, its two materials and its bumps."""
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    noise, frequency = value_noise(rng), rng.uniform(1.5, 4.5)
    first = bool(rng.random() < 0.45)
    second = {"worn": not first, "scratches": first, "plain": first}.get(kind, bool(rng.random() < 0.5))
    roughness = rng.uniform(0.15, 0.85), rng.uniform(0.12, 0.8)
    relief = rng.choice([0.0, rng.uniform(0.01, 0.03)]) * rng.choice([-1, 1])
    return SolidMaterial(
        kind=kind,
        share=_share(kind, rng, noise, frequency),
        roughness=roughness,
        metallic=(float(first), float(second)),
        variation=rng.uniform(0.03, 0.18),
        relief=-abs(relief) if kind in ("worn", "scratches") else float(relief),
        bumps=float(rng.choice([0.0, rng.uniform(0.005, 0.04)], p=[0.35, 0.65])),
        noise=noise,
        frequency=float(rng.uniform(2.5, 6)),
    )


def _share(kind: str, rng: np.random.Generator, noise: ValueNoise, frequency: float) -> Field:
    """Where the second material lies."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    level, phase = rng.uniform(-0.25, 0.3), rng.uniform(0, 1)
    sites = KDTree(rng.uniform(-1.2, 1.2, (int(rng.integers(8, 50)), 3)))
    chosen = rng.random(sites.n) < rng.uniform(0.25, 0.6)
    lines = [
        (random_direction(rng), rng.uniform(-0.8, 0.8), random_direction(rng)) for _ in range(int(rng.integers(6, 16)))
    ]

    def worn(points: np.ndarray) -> np.ndarray:
        return soft_step(noise.fractal(points * frequency, 3) - level, 0.08)

    def stripes(points: np.ndarray) -> np.ndarray:
        return soft_step(np.sin(np.pi * (points @ axis * frequency + phase)) - level, 0.25)

    def patches(points: np.ndarray) -> np.ndarray:
        distance, nearest = map(np.asarray, sites.query(points + 0.1 * noise(points * 3)[..., None], k=2))
        border = soft_step(distance[..., 1] - distance[..., 0], 0.08)  # 0.5 where two cells meet
        here, there = chosen[nearest[..., 0]], chosen[nearest[..., 1]]
        return np.where(here == there, here, np.where(here, border, 1 - border))

    def scratches(points: np.ndarray) -> np.ndarray:
        across = [
            np.abs(points @ normal - offset + 0.05 * np.sin(3 * points @ along)) for normal, offset, along in lines
        ]
        return 1 - soft_step(np.min(across, axis=0) - 0.02, 0.03)

    fields = {"worn": worn, "stripes": stripes, "patches": patches, "scratches": scratches}
    return fields.get(kind, lambda points: np.zeros(points.shape[:-1], np.float32))


def normal_from_height(
    height: Float[np.ndarray, "h w"], positions: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Tangent-space unit normals of a height over a surface, x along +u and y against +v (see `MeshObject`).

    Args:
        height: over the surface, in the unit of `positions`.
        positions: the surface point of each texel. Where it stands still along u or v (poles), the normal is (0, 0, 1).
    """
    rise = np.gradient(height.astype(np.float64))
    along_v, along_u = (np.gradient(positions.astype(np.float64), axis=axis) for axis in (0, 1))
    step = np.linalg.norm(along_u, axis=-1)
    proper = step > 1e-6
    tangent = np.divide(along_u, step[..., None], out=np.zeros_like(along_u), where=proper[..., None])
    slope_x = np.divide(rise[1], step, out=np.zeros_like(step), where=proper)
    # -v has a part along the tangent, too: only what is left over is y.
    sheared = -np.einsum("hwk,hwk->hw", along_v, tangent)
    rest = np.linalg.norm(-along_v - sheared[..., None] * tangent, axis=-1)
    proper &= rest > 1e-6
    slope_y = np.divide(-rise[0] - sheared * slope_x, rest, out=np.zeros_like(step), where=proper)
    slope = np.where(proper, np.hypot(slope_x, slope_y), 0)
    scale = np.minimum(1, STEEPEST / np.maximum(slope, 1e-12)) * proper
    normal = np.stack([-slope_x * scale, -slope_y * scale, np.ones_like(step)], axis=-1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


def _mix(pair: tuple[float, float], share: np.ndarray) -> np.ndarray:
    return pair[0] + (pair[1] - pair[0]) * share
