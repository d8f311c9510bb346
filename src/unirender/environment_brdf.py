"""Schlick's reflectance averaged over a GGX lobe, by Karis's split sum ("Real Shading in Unreal Engine 4", 2013).

Schlick's reflectance is F0 + (1 - F0)(1 - v.h)^5; its mean over the lobe is

    F = (F0 A + B) / (A + B),    A = integral (1 - (1 - v.h)^5) f n.l dl,    B = integral (1 - v.h)^5 f n.l dl

with f = D G / (4 n.v n.l) the GGX lobe of a reflector of F = 1, whose radiance under the light is s. A + B is its
albedo in the direction v; the sum is split because the light and F are averaged over the lobe one by one.
"""

import functools
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.light.surface_light import MIN_ALPHA

COSINES, ROUGHNESSES = 64, 32  # nodes of the tables of A and B, evenly spaced over [0, 1]
LOBE_SAMPLES = (64, 32)  # of a lobe, over its two coordinates
LOBES = 4  # at a time: their samples stay in the processor's cache
GRAZING = 1e-3  # the least n.v: at 0 a visible lobe does not exist
TABLES = Path(__file__).with_name("environment_brdf.npy")  # what `integrate_environment_brdf` gives, [2 n r], float64


def mean_fresnel(
    f0: Float[np.ndarray, "*size c"], n_v: Float[np.ndarray, "*size 1"], roughness: Float[np.ndarray, "*size 1"]
) -> Float[np.ndarray, "*size c"]:
    """Schlick's reflectance averaged over the lobe, (F0 A + B) / (A + B), in [F0, 1]."""
    a, b = environment_brdf(n_v, roughness)
    return (f0 * a + b) / (a + b)


def environment_brdf(
    n_v: Float[np.ndarray, "*size"], roughness: Float[np.ndarray, "*size"]
) -> tuple[Float[np.ndarray, "*size"], Float[np.ndarray, "*size"]]:
    """Karis's scale A and bias B of F0, interpolated (bilinearly) in a table.

    Args:
        n_v: cosine between normal and view direction; clipped to [0, 1].
        roughness: perceptual, clipped to [0, 1]; alpha = roughness^2.
    """
    x = np.clip(n_v, 0, 1) * (COSINES - 1)
    y = np.clip(roughness, 0, 1) * (ROUGHNESSES - 1)
    i, j = (np.minimum(p.astype(np.int64), n - 2) for p, n in ((x, COSINES), (y, ROUGHNESSES)))
    fx, fy = x - i, y - j
    first = i * ROUGHNESSES + j  # in the flat table; the other corners follow it by a row, by one, and by both
    weights = ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)
    corners = list(zip(weights, (first, first + ROUGHNESSES, first + 1, first + ROUGHNESSES + 1), strict=True))
    a, b = (sum(weight * table.take(at) for weight, at in corners) for table in environment_brdf_tables())
    return np.asarray(a, np.float32), np.asarray(b, np.float32)


@functools.cache
def environment_brdf_tables() -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, "n r"]]:
    """A and B at evenly spaced n.v (rows) and roughnesses (columns), both from 0 to 1, from the file that ships."""
    a, b = np.load(TABLES)
    return a, b


def integrate_environment_brdf() -> Float[np.ndarray, "2 n r"]:
    """What `TABLES` holds. It ships since to integrate takes a quarter of a second, in every process that renders."""
    n_v = np.maximum(np.linspace(0, 1, COSINES), GRAZING)
    alpha = np.maximum(np.square(np.linspace(0, 1, ROUGHNESSES)), MIN_ALPHA)
    blocks = [[_integrate_lobes(rows, float(r)) for r in alpha] for rows in np.split(n_v, COSINES // LOBES)]
    return np.array(blocks).transpose(2, 0, 3, 1).reshape(2, COSINES, ROUGHNESSES)


def _integrate_lobes(
    n_v: Float[np.ndarray, " n"], alpha: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """A and B of lobes: the midpoint rule over visible normals (Dupuy & Benyoub 2023), n = +z, v in the xz plane.

    A visible normal h is drawn with the density D G1(v) max(v.h, 0) / n.v, so that f n.l over the density of l is
    G1(l), Smith's shadowing of the light.
    """
    u = (np.arange(LOBE_SAMPLES[0]) + 0.5) / LOBE_SAMPLES[0]
    cos_phi = np.cos(np.pi * (np.arange(LOBE_SAMPLES[1]) + 0.5) / LOBE_SAMPLES[1])[:, None]  # the rest: mirror images
    v_z = n_v[:, None, None]
    v_x = np.sqrt(1 - v_z**2)
    length = np.sqrt((alpha * v_x) ** 2 + v_z**2)
    x, z = alpha * v_x / length, v_z / length  # v stretched to the configuration of alpha 1
    h_z = (1 - u) * (1 + z)  # a point of the cap of the sphere that v sees, moved by v; stretched back below
    radius = np.sqrt(np.maximum(1 - (h_z - z) ** 2, 0))
    h_x = radius * cos_phi + x
    length = np.sqrt(alpha**2 * (h_x**2 + radius**2 * (1 - cos_phi**2)) + h_z**2)
    v_h = (alpha * h_x * v_x + h_z * v_z) / length
    n_l = 2 * v_h * h_z / length - v_z
    squared = np.square(np.maximum(n_l, 1e-6))
    g1 = np.where(n_l > 0, 2 / (1 + np.sqrt(1 + alpha**2 * (1 - squared) / squared)), 0)
    away = np.clip(1 - v_h, 0, 1)
    schlick = np.square(np.square(away)) * away  # the 5th power; `**` is slower
    return np.mean((1 - schlick) * g1, axis=(1, 2)), np.mean(schlick * g1, axis=(1, 2))
