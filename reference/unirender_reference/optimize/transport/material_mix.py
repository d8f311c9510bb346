"""Transport matrices of pixels with materials: what is linear in the base colour, and what is not.

With the lobes of `matrices` at a pixel's roughness r and its metallic m, a pixel's radiance under a light E is

    I = b (U E) + V E,     U = (1-m) D + m (G - W),     V = (1-m) (F0 G + (1-F0) W) + m W          b: base colour
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from unirender_reference.optimize.transport.bsdf_lobes import F0
from unirender_reference.optimize.transport.matrices import Matrix, Transport
from unirender_reference.optimize.transport.roughness_nodes import node_weights


class Lobes(NamedTuple):
    """The matrices of D, G and W at each pixel's roughness."""

    diffuse: Matrix
    gloss: Matrix
    schlick: Matrix


class Mixed(NamedTuple):
    """The matrices of a material: I = b (U E) + V E."""

    u: Matrix
    v: Matrix


def lobes_at(transport: Transport, roughness: Float[np.ndarray, " n"]) -> Lobes:
    """The lobes at the pixels' roughness."""
    r = roughness.astype(np.float32)[:, None]
    diffuse = transport.diffuse[1] * r
    diffuse += transport.diffuse[2] * r**2
    diffuse += transport.diffuse[0]
    weights = node_weights(roughness)[0].astype(np.float32)
    return Lobes(diffuse, _weighted(weights, transport.gloss), _weighted(weights, transport.schlick))


def mixed(lobes: Lobes, metallic: Float[np.ndarray, " n"]) -> Mixed:
    """U and V."""
    m = metallic.astype(np.float32)[:, None]
    u = lobes.diffuse * (1 - m)
    u += m * (lobes.gloss - lobes.schlick)
    v = lobes.gloss * ((1 - m) * F0)
    v += lobes.schlick * ((1 - m) * (1 - F0) + m)
    return Mixed(u, v)


def material_slopes(
    transport: Transport,
    roughness: Float[np.ndarray, " n"],
    metallic: Float[np.ndarray, " n"],
    base: Float[np.ndarray, "n 3"],
    radiance: Float[np.ndarray, "j 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Derivatives of the pixels' radiance by roughness and by metallic.

    Args:
        transport: matrices.
        roughness, metallic: of each pixel.
        base: b.
        radiance: E.
    """
    r, m = roughness[:, None], metallic[:, None]
    value, slope = node_weights(roughness)
    lit = [np.stack([matrix @ radiance for matrix in part]) for part in (transport.gloss, transport.schlick)]
    gloss, schlick = (np.einsum("nk,knc->nc", value, part) for part in lit)
    d_gloss, d_schlick = (np.einsum("nk,knc->nc", slope, part) for part in lit)
    constant, linear, square = (matrix @ radiance for matrix in transport.diffuse)
    diffuse, d_diffuse = constant + r * linear + r**2 * square, linear + 2 * r * square
    fresnel, d_fresnel = F0 * gloss + (1 - F0) * schlick, F0 * d_gloss + (1 - F0) * d_schlick
    by_roughness = base * ((1 - m) * d_diffuse + m * (d_gloss - d_schlick)) + (1 - m) * d_fresnel + m * d_schlick
    by_metallic = base * (gloss - schlick - diffuse) + schlick - fresnel
    return by_roughness, by_metallic


def _weighted(weights: Float[np.ndarray, "n nodes"], matrices: tuple[Matrix, ...]) -> Matrix:
    used = [k for k in range(len(matrices)) if weights[:, k].any()]
    total = weights[:, used[0], None] * matrices[used[0]]
    for k in used[1:]:
        total += weights[:, k, None] * matrices[k]
    return total
