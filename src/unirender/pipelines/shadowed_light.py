"""s and d from an environment with the shadows that the picture's own surfaces cast (`self_shadow`).

    d = d_0 (1 - H / E),    s = s_0 (integral of V L D n.l) / (integral of L D n.l)

Notation: d_0, s_0 without shadows (`unirender.surface_light`); L the light, V 0 in hidden directions and else 1; E the
integral of L n.l and H that of (1 - V) L n.l; D the GGX distribution at the half vector. d stays linear in the light; s
nearly: a lobe's share that is hidden is that of its brightest part.
"""

import numpy as np
from jaxtyping import Float

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
    return {name: np.where(mask > 0, frame.leave_map(share, mask), 1) for name, share in small.items()}


def _shares(surface: Intrinsics, environment: Float[np.ndarray, "eh ew 3"]) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """The same at the size that the surface has."""
    normal, roughness, mask = surface.require("normal", "roughness", "mask").values()
    shadow = SelfShadow.of(normal, mask, surface.camera).where_hidden()
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
    return shares


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
