"""s and d from an environment with the shadows that the picture's own surfaces cast (`self_shadow`).

    d = d_0 (integral of V L n.l) / (integral of L n.l),    s = s_0 (integral of V L D n.l) / (integral of L D n.l)

Notation: d_0, s_0 without shadows (`unirender.surface_light`); L the light; V = 1 - `TRUST` in hidden directions and
else 1; D the GGX distribution at the half vector, of a roughness of `LEAST_ROUGHNESS` or more. Up to `SHADOW_SIDE`
pixels d is linear in the light; s is only as far as a lobe has one light.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from unirender.intrinsics import Intrinsics
from unirender.lobes import texels
from unirender.pipelines.framing import Frame
from unirender.pipelines.self_shadow import SelfShadow
from unirender.surface_light import QUADRATURE_SHAPE

SHADOW_SIDE = 128  # pixels along the longer side at which shadows of larger pictures are found
TRUST = 0.75  # of what seems hidden so much is taken away: depth from normals is a guess where surfaces overlap
LEAST_ROUGHNESS = 0.3  # below it a lobe is narrower than the texels over which shadows are integrated


def visible_shares(
    intrinsics: Intrinsics, environment: Float[np.ndarray, "eh ew 3"]
) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """What of s and d without shadows is left where the picture's own surfaces stand in the light's way; [0, 1].

    Args:
        intrinsics: with normal, roughness and mask.
        environment: lat-long radiance in camera axes, any resolution.
    """
    surface = Intrinsics(**intrinsics.require("normal", "roughness", "mask"), camera=intrinsics.camera)
    if max(surface.height, surface.width) <= SHADOW_SIDE:
        return _shares(surface, environment)
    mask = surface.require("mask")["mask"]
    frame = Frame(surface.height, surface.width, SHADOW_SIDE)
    small = _shares(frame.enter_intrinsics(surface), environment)
    # what is lost, and not what is left: where the small size has no coverage nothing is known to be
    return {name: 1 - frame.leave_map(1 - share, mask) for name, share in small.items()}


def _shares(surface: Intrinsics, environment: Float[np.ndarray, "eh ew 3"]) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """The same at the size that the surface has."""
    normal, roughness, mask = surface.require("normal", "roughness", "mask").values()
    everywhere = SelfShadow.of(normal, mask, surface.camera)
    edge, nearest = _edge(everywhere.where, mask[..., 0] > 0)
    shadow = everywhere.where_hidden()
    n, alpha = normal[shadow.where], np.square(np.maximum(roughness[shadow.where], LEAST_ROUGHNESS))
    view = -shadow.ray / np.linalg.norm(shadow.ray, axis=1, keepdims=True)
    directions, radiance = texels(environment, QUADRATURE_SHAPE)
    found = {name: np.ones_like(n) for name in ("specular", "diffuse")}
    for part in shadow.parts(directions.shape[1]):
        cosine = np.maximum(n[part] @ directions, 0)
        visible = shadow.visible(part, directions)
        lobe = cosine * _distribution(n[part], view[part], alpha[part], directions)
        for name, weight in (("specular", lobe), ("diffuse", cosine)):
            total, left = weight @ radiance, np.where(visible, weight, (1 - TRUST) * weight) @ radiance
            found[name][part] = np.clip(np.divide(left, total, out=np.ones_like(left), where=total > 0), 0, 1)
    shares = {name: np.ones_like(normal) for name in found}
    for name, share in shares.items():
        share[shadow.where] = found[name]
        share[edge] = share[nearest]
    return shares


def _edge(
    surface: Bool[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Indices of the pixels that are covered by less than a surface, and of the surface's pixel nearest to each."""
    if not surface.any():
        nowhere = np.nonzero(surface)
        return nowhere, nowhere
    edge = np.nonzero(inside & ~surface)
    indices = np.asarray(distance_transform_edt(~surface, return_distances=False, return_indices=True))
    return edge, (indices[0][edge], indices[1][edge])


def _distribution(
    n: Float[np.ndarray, "q 3"],
    v: Float[np.ndarray, "q 3"],
    alpha: Float[np.ndarray, "q 1"],
    directions: Float[np.ndarray, "3 m"],
) -> Float[np.ndarray, "q m"]:
    """GGX at the half vectors, but for a factor of each pixel."""
    n_h = n @ directions + (n * v).sum(axis=1, keepdims=True)  # times the length of the half vector, n.h
    squared = np.square(n_h) / np.maximum(2 + 2 * (v @ directions), 1e-6)
    return 1 / np.square(1 - np.minimum(squared, 1) * (1 - np.square(alpha)))
