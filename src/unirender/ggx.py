"""The GGX lobe of a rough mirror: shadowing, frames, and normals drawn as a viewer sees them.

Notation: n normal, v view direction, h half vector, alpha = roughness^2. In the *surface's frame* z is the normal.
"""

import functools

import numpy as np
from jaxtyping import Float


def facing_normal(n: Float[np.ndarray, "p 3"], v: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Shading normals that point away from the viewer are bent to graze the view ray (predicted maps have them)."""
    cosine = np.sum(n * v, axis=-1, keepdims=True)
    bent = n + np.maximum(1e-2 - cosine, 0) * v
    return bent / np.linalg.norm(bent, axis=-1, keepdims=True)


def smith_g1(cosine: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Smith's shadowing of one direction by its cosine to the normal; the two broadcast."""
    squared = np.square(cosine)
    return 2 / (1 + np.sqrt(1 + np.square(alpha) * (1 - squared) / np.maximum(squared, 1e-8)))


def visible_normals(
    view: Float[np.ndarray, "m 3"],
    alpha: Float[np.ndarray, " m"],
    u1: Float[np.ndarray, " m"],
    u2: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "m 3"]:
    """GGX normals that a viewer sees, in the surface's frame, from two uniform numbers each (Heitz 2018)."""
    stretched = unit(np.stack([alpha * view[:, 0], alpha * view[:, 1], view[:, 2]], axis=-1))
    radius, angle = np.sqrt(u1), np.float32(2 * np.pi) * u2
    t1 = radius * np.cos(angle)
    blend = np.float32(0.5) * (1 + stretched[:, 2])
    t2 = (1 - blend) * np.sqrt(np.maximum(1 - np.square(t1), 0)) + blend * radius * np.sin(angle)
    t3 = np.sqrt(np.maximum(1 - np.square(t1) - np.square(t2), 0))
    h = np.einsum("mk,mki->mi", np.stack([t1, t2, t3], axis=-1), _visible_disc(stretched))
    return unit(np.stack([alpha * h[:, 0], alpha * h[:, 1], np.maximum(h[:, 2], np.float32(1e-6))], axis=-1))


def frames(z: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """Rotation matrices whose rows are x, y, z of a right-handed frame (Duff et al. 2017)."""
    sign = np.where(z[:, 2] >= 0, 1.0, -1.0).astype(z.dtype)
    a = -1 / (sign + z[:, 2])
    b = z[:, 0] * z[:, 1] * a
    x = np.stack([1 + sign * np.square(z[:, 0]) * a, sign * b, -sign * z[:, 0]], axis=-1)
    y = np.stack([b, sign + np.square(z[:, 1]) * a, -z[:, 1]], axis=-1)
    return np.stack([x, y, z], axis=1)


def _visible_disc(v: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """Rows t1, t2, v of Heitz's frame around the stretched view direction; t1 lies in the surface."""
    t1 = np.stack([-v[:, 1], v[:, 0], np.zeros_like(v[:, 0])], axis=-1)
    length = np.linalg.norm(t1, axis=-1, keepdims=True)
    t1 = np.where(length > 1e-6, t1 / np.maximum(length, 1e-6), np.array([1, 0, 0], v.dtype))
    return np.stack([t1, np.cross(v, t1), v], axis=1)


def unit(vectors: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """The vectors at length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


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
