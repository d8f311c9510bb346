"""The GGX lobe of a rough mirror: shadowing, frames, and normals drawn as a viewer sees them.

Notation: n normal, v view direction, h half vector, alpha = roughness^2. In the *surface's frame* z is the normal.
Arrays have the component of a vector first, so that each is contiguous.
"""

import functools

import numpy as np
from jaxtyping import Float


def dot(a: Float[np.ndarray, "3 ..."], b: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "..."]:
    """Cosines, if the vectors are unit."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def unit(vectors: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "3 ..."]:
    """The vectors at length 1."""
    return vectors / np.sqrt(dot(vectors, vectors))


def mirror_direction(n: Float[np.ndarray, "3 ..."], v: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "3 ..."]:
    """Where a smooth mirror reflects the viewer's ray to, if both are unit."""
    return 2 * dot(n, v) * n - v


def facing_normal(n: Float[np.ndarray, "3 ..."], v: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "3 ..."]:
    """Shading normals that point away from the viewer are bent to graze the view ray (predicted maps have them)."""
    return unit(n + np.maximum(np.float32(1e-2) - dot(n, v), 0) * v)


def smith_g1(cosine: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Smith's shadowing of one direction by its cosine to the normal, 0 below the horizon; the two broadcast."""
    cosine, a2 = np.maximum(cosine, 0), np.square(alpha)
    return 2 * cosine / (cosine + np.sqrt(a2 + (1 - a2) * np.square(cosine)))


def visible_normals(
    view: Float[np.ndarray, "3 ..."],
    alpha: Float[np.ndarray, "..."],
    u1: Float[np.ndarray, "..."],
    u2: Float[np.ndarray, "..."],
) -> Float[np.ndarray, "3 ..."]:
    """GGX normals that a viewer sees, in the surface's frame, from two uniform numbers each.

    Stretched to a hemisphere, the directions in which it reflects the view are uniform over a spherical cap (Dupuy and
    Benyoub 2023).
    """
    stretched = unit(np.stack([alpha * view[0], alpha * view[1], view[2]]))
    z = 1 - u1 * (1 + stretched[2])
    sine, angle = np.sqrt(np.maximum(1 - np.square(z), 0)), np.float32(2 * np.pi) * u2
    x, y = sine * np.cos(angle) + stretched[0], sine * np.sin(angle) + stretched[1]
    return unit(np.stack([alpha * x, alpha * y, np.maximum(z + stretched[2], np.float32(1e-6))]))


def tangents(n: Float[np.ndarray, "3 ..."]) -> tuple[Float[np.ndarray, "3 ..."], Float[np.ndarray, "3 ..."]]:
    """x and y of a right-handed frame whose z is the normal (Duff et al. 2017)."""
    sign = np.where(n[2] >= 0, np.float32(1), np.float32(-1))
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    x = np.stack([1 + sign * np.square(n[0]) * a, sign * b, -sign * n[0]])
    return x, np.stack([b, sign + np.square(n[1]) * a, -n[1]])


@functools.lru_cache(maxsize=4)
def halton(count: int) -> tuple[Float[np.ndarray, " n"], ...]:
    """Four coordinates of a low-discrepancy set in [0, 1): evenly spaced, then radical inverses of base 2, 3, 5."""
    coordinates = [(np.arange(count) + 0.5) / count]
    for base in (2, 3, 5):
        digits, value, scale = np.arange(count), np.zeros(count), 1 / base
        while digits.any():
            value += scale * (digits % base)
            digits, scale = digits // base, scale / base
        coordinates.append(value)
    return tuple(coordinate.astype(np.float32) for coordinate in coordinates)
