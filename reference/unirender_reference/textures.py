"""Base colours: palettes and solid textures.

A solid texture is a function from points of R^3 (the object about in [-1, 1]^3) to linear Rec.709 albedo in
[DARKEST, BRIGHTEST]; real materials lie within those (charcoal 0.02, fresh snow 0.9).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from unirender.color import srgb_decode
from unirender_reference.shapes.noise import soft_step, value_noise

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


def random_texture(rng: np.random.Generator) -> tuple[str, SolidTexture]:
    """Draws a kind of pattern and its parameters; returns its name and the texture."""
    palette = random_palette(rng)
    noise = value_noise(rng)
    kind = str(
        rng.choice(
            ["checker", "stripes", "clouds", "cells", "marble", "spots", "gradient", "wood", "speckle", "bands"],
            p=[0.1, 0.12, 0.14, 0.12, 0.12, 0.1, 0.1, 0.07, 0.06, 0.07],
        )
    )
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    frequency = rng.uniform(1.0, 4.0)
    phase = rng.uniform(0, 1, 3)
    warp = rng.choice([0.0, rng.uniform(0.05, 0.3)])
    count = int(np.exp(rng.uniform(np.log(12), np.log(160))))
    sites = KDTree(rng.uniform(-1.2, 1.2, (count, 3)))
    site_color = palette[rng.integers(len(palette), size=count)]
    size, share = rng.uniform(0.35, 0.8), rng.uniform(-0.35, 0.35)

    def texture(points: np.ndarray) -> np.ndarray:
        p = points.astype(np.float64)
        if kind == "checker":
            parity = np.floor(p * frequency + phase).astype(int).sum(-1) % len(palette)
            return palette[parity]
        if kind in ("stripes", "bands", "wood", "marble", "gradient"):
            along = p @ axis
            if kind == "gradient":
                return _ramp(np.clip(0.5 + 0.5 * along + 0.3 * warp * noise(points * 2), 0, 1), palette)
            if kind == "wood":
                around = np.linalg.norm(p - along[..., None] * axis + 0.4 * phase, axis=-1)
                rings = (around * 2.5 * frequency + 0.5 * noise.fractal(points * [1, 3, 1], 2)) % 1
                return _ramp(rings**1.5, palette[:2])
            if kind == "marble":
                veins = np.sin(2 * np.pi * (along * frequency * 0.5 + noise.fractal(points * 1.5, 4)))
                return _ramp(np.abs(veins) ** 0.6, palette)
            swing = along * frequency + phase[0] + warp * 2 * noise(points * 2)
            if kind == "stripes":
                return palette[np.floor(swing * 1.5).astype(int) % len(palette)]
            return _ramp(0.5 + 0.5 * np.sin(2 * np.pi * swing * 0.5), palette)
        if kind == "clouds":
            return _ramp(np.clip(0.5 + 0.9 * noise.fractal(points * frequency, 4), 0, 1), palette)
        if kind == "speckle":
            grain = noise.fractal(points * (4 + 3 * frequency), 2)
            return palette[0] + (palette[1] - palette[0]) * soft_step(grain - share, 0.1)[..., None]
        shifted = p + warp * np.stack([noise(points * 2 + k) for k in range(3)], -1)
        distance, nearest = map(np.asarray, sites.query(shifted, k=2))
        if kind == "cells":
            edge = soft_step(distance[..., 1] - distance[..., 0] - 0.06, 0.03)[..., None]
            joint = palette[0] if share > 0 else site_color[nearest[..., 0]]
            return joint + (site_color[nearest[..., 0]] - joint) * edge
        radius = size * 1.1 / count ** (1 / 3)
        inside = soft_step(radius - distance[..., 0], 0.03)[..., None]
        return palette[0] + (palette[1 + nearest[..., 0] % (len(palette) - 1)] - palette[0]) * inside

    return kind, lambda points: np.clip(texture(points), DARKEST, BRIGHTEST).astype(np.float32)
