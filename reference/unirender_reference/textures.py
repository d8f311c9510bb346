"""Base colours: palettes and solid textures.

A solid texture is a function from points of R^3 (the object about in [-1, 1]^3) to linear Rec.709 albedo in
[DARKEST, BRIGHTEST]; real materials lie within those (charcoal 0.02, fresh snow 0.9).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from unirender.color import srgb_decode
from unirender_reference.shapes.noise import ValueNoise, soft_step, value_noise

DARKEST, BRIGHTEST = 0.015, 0.95

MOODS = {"saturated": 0.27, "any": 0.25, "earthy": 0.14, "pastel": 0.1, "grey": 0.1, "dark": 0.08, "white": 0.06}

SolidTexture = Callable[[Float[np.ndarray, "h w 3"]], Float[np.ndarray, "h w 3"]]


def _hsv(h: float, s: float, v: float) -> Float[np.ndarray, "3"]:
    k = (np.array([5.0, 3.0, 1.0]) + h * 6) % 6
    return v - v * s * np.clip(np.minimum(k, 4 - k), 0, 1)


def random_color(rng: np.random.Generator, hue: float | None = None) -> Float[np.ndarray, "3"]:
    """One linear albedo: saturated, pastel, earthy, dark, grey or white; `hue` in [0, 1) keeps it near that hue."""
    h = rng.random() if hue is None else (hue + rng.normal(0, 0.04)) % 1
    mood = str(rng.choice(list(MOODS), p=list(MOODS.values())))
    s, v = {
        "saturated": (rng.uniform(0.65, 1), rng.uniform(0.45, 1)),
        "any": (rng.uniform(0, 1), rng.uniform(0.15, 1)),
        "pastel": (rng.uniform(0.1, 0.45), rng.uniform(0.75, 1)),
        "earthy": (rng.uniform(0.25, 0.75), rng.uniform(0.25, 0.75)),
        "dark": (rng.uniform(0, 0.9), rng.uniform(0.1, 0.35)),
        "grey": (rng.uniform(0, 0.06), rng.uniform(0.2, 0.9)),
        "white": (rng.uniform(0, 0.06), rng.uniform(0.88, 1)),
    }[mood]
    if mood == "earthy":
        h = rng.uniform(0.02, 0.2)
    return np.clip(srgb_decode(_hsv(h, s, v).astype(np.float32)), DARKEST, BRIGHTEST)


def random_palette(rng: np.random.Generator) -> Float[np.ndarray, "colors 3"]:
    """Two to four albedos: unrelated, of one hue, or of a hue and its opposite."""
    count, scheme = int(rng.integers(2, 5)), rng.choice(["free", "hue", "opposite"], p=[0.6, 0.2, 0.2])
    hue = rng.random()
    hues = {"free": [None] * count, "hue": [hue] * count, "opposite": [(hue + 0.5 * (k % 2)) % 1 for k in range(count)]}
    return np.stack([random_color(rng, h) for h in hues[scheme]])


def _ramp(value: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Piecewise-linear colour of a value in [0, 1]."""
    stops = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(value, stops, palette[:, k]) for k in range(3)], -1)


@dataclass(frozen=True)
class _Pattern:
    """What the kinds of patterns are made of.

    Attributes:
        palette: two to four colours.
        noise: a field that blurs, bends or is the pattern.
        axis: unit direction of stripes, veins, rings and gradients.
        frequency: of what is repeated.
        phase: shift of what is repeated.
        warp: how much the noise, in float32, bends; 0 or more. As numpy's own float64 it makes that float64.
        sites: places of cells and spots.
        site_color: a colour of the palette for each of them.
        size: of spots, in mean distances of the sites.
        share: level of speckles; above 0 cells have joints.
    """

    palette: Float[np.ndarray, "colors 3"]
    noise: ValueNoise
    axis: Float[np.ndarray, "3"]
    frequency: float
    phase: Float[np.ndarray, "3"]
    warp: np.float64
    sites: KDTree
    site_color: Float[np.ndarray, "sites 3"]
    size: float
    share: float

    def along(self, points: np.ndarray) -> np.ndarray:
        """Place along the axis."""
        return points.astype(np.float64) @ self.axis

    def swing(self, points: np.ndarray) -> np.ndarray:
        """Place along the axis in periods, bent."""
        bent = self.warp * 2 * self.noise(points * 2)
        return self.along(points) * self.frequency + self.phase[0] + bent

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances to the two nearest sites, and which these are; the points are bent."""
        bent = self.warp * np.stack([self.noise(points * 2 + k) for k in range(3)], -1)
        distance, index = self.sites.query(points.astype(np.float64) + bent, k=2)
        return np.asarray(distance), np.asarray(index)


def _checker(of: _Pattern, points: np.ndarray) -> np.ndarray:
    cell = np.floor(points.astype(np.float64) * of.frequency + of.phase).astype(int)
    return of.palette[cell.sum(-1) % len(of.palette)]


def _stripes(of: _Pattern, points: np.ndarray) -> np.ndarray:
    return of.palette[np.floor(of.swing(points) * 1.5).astype(int) % len(of.palette)]


def _bands(of: _Pattern, points: np.ndarray) -> np.ndarray:
    return _ramp(0.5 + 0.5 * np.sin(2 * np.pi * of.swing(points) * 0.5), of.palette)


def _gradient(of: _Pattern, points: np.ndarray) -> np.ndarray:
    return _ramp(np.clip(0.5 + 0.5 * of.along(points) + 0.3 * of.warp * of.noise(points * 2), 0, 1), of.palette)


def _wood(of: _Pattern, points: np.ndarray) -> np.ndarray:
    off = points.astype(np.float64) - of.along(points)[..., None] * of.axis + 0.4 * of.phase
    grain = 0.5 * of.noise.fractal(points * [1, 3, 1], 2)
    rings = (np.linalg.norm(off, axis=-1) * 2.5 * of.frequency + grain) % 1
    return _ramp(rings**1.5, of.palette[:2])


def _marble(of: _Pattern, points: np.ndarray) -> np.ndarray:
    veins = np.sin(2 * np.pi * (of.along(points) * of.frequency * 0.5 + of.noise.fractal(points * 1.5, 4)))
    return _ramp(np.abs(veins) ** 0.6, of.palette)


def _clouds(of: _Pattern, points: np.ndarray) -> np.ndarray:
    return _ramp(np.clip(0.5 + 0.9 * of.noise.fractal(points * of.frequency, 4), 0, 1), of.palette)


def _speckle(of: _Pattern, points: np.ndarray) -> np.ndarray:
    grain = of.noise.fractal(points * (4 + 3 * of.frequency), 2)
    return of.palette[0] + (of.palette[1] - of.palette[0]) * soft_step(grain - of.share, 0.1)[..., None]


def _cells(of: _Pattern, points: np.ndarray) -> np.ndarray:
    distance, nearest = of.nearest(points)
    inside = soft_step(distance[..., 1] - distance[..., 0] - 0.06, 0.03)[..., None]
    color = of.site_color[nearest[..., 0]]
    joint = of.palette[0] if of.share > 0 else color
    return joint + (color - joint) * inside


def _spots(of: _Pattern, points: np.ndarray) -> np.ndarray:
    distance, nearest = of.nearest(points)
    radius = of.size * 1.1 / len(of.site_color) ** (1 / 3)
    inside = soft_step(radius - distance[..., 0], 0.03)[..., None]
    color = of.palette[1 + nearest[..., 0] % (len(of.palette) - 1)]
    return of.palette[0] + (color - of.palette[0]) * inside


# of each kind its chance and its colours
KINDS: dict[str, tuple[float, Callable[[_Pattern, np.ndarray], np.ndarray]]] = {
    "checker": (0.1, _checker),
    "stripes": (0.12, _stripes),
    "clouds": (0.14, _clouds),
    "cells": (0.12, _cells),
    "marble": (0.12, _marble),
    "spots": (0.1, _spots),
    "gradient": (0.1, _gradient),
    "wood": (0.07, _wood),
    "speckle": (0.06, _speckle),
    "bands": (0.07, _bands),
}


def random_texture(rng: np.random.Generator) -> tuple[str, SolidTexture]:
    """Draws a kind of pattern and its parameters; returns its name and the texture."""
    palette = random_palette(rng)
    noise = value_noise(rng)
    kind = str(rng.choice(list(KINDS), p=[chance for chance, _ in KINDS.values()]))
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    frequency = rng.uniform(1.0, 4.0)
    phase = rng.uniform(0, 1, 3)
    warp = rng.choice([0.0, rng.uniform(0.05, 0.3)])
    count = int(np.exp(rng.uniform(np.log(12), np.log(160))))
    sites = KDTree(rng.uniform(-1.2, 1.2, (count, 3)))
    site_color = palette[rng.integers(len(palette), size=count)]
    size, share = rng.uniform(0.35, 0.8), rng.uniform(-0.35, 0.35)
    pattern = _Pattern(palette, noise, axis, frequency, phase, warp, sites, site_color, size, share)
    color = KINDS[kind][1]
    return kind, lambda points: np.clip(color(pattern, points), DARKEST, BRIGHTEST).astype(np.float32)
