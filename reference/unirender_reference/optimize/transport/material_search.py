"""Roughness and metallic of every patch under a known light: a search over a grid, smoothed over the surface.

Under a known light the radiance for any (roughness, metallic) is cheap, so each patch's cost is tabled over a grid; its
base colour is the best one for each entry. A patch is seen by a few pixels only: neighbours are drawn to one another
(truncated absolute differences, by iterated conditional modes), from the object's one material on, so that another one
has to pay for itself.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from unirender_reference.optimize.transport.bsdf_lobes import F0
from unirender_reference.optimize.transport.pixel_fit import LEAST_ALBEDO, SCALE_SPREAD, Appearance, PixelFit
from unirender_reference.optimize.transport.roughness_nodes import NODES

METALLIC = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
NEIGHBOURS = 6
PULL = 40.0  # cost of a difference of 1 between two neighbours, in squared residuals
MOST_DIFFERENCE = 0.5  # beyond which a border costs no more
SWEEPS = 12


def search_materials(fit: PixelFit, appearance: Appearance, position: Float[np.ndarray, "n 3"]) -> Appearance:
    """The appearance with a roughness and a metallic for each patch.

    Args:
        fit: matrices and pixels.
        appearance: light and the present materials, which every patch starts from.
        position: of each pixel on the surface.
    """
    values = np.array([(r, m) for r in NODES for m in METALLIC])
    costs = _costs(fit, appearance)
    present = np.stack([_patch_means(fit, appearance.roughness), _patch_means(fit, appearance.metallic)], axis=1)
    chosen = np.abs(values[None] - present[:, None]).sum(axis=2).argmin(axis=1)
    around = _neighbours(np.stack([_patch_means(fit, position[:, k]) for k in range(3)], axis=1))
    distance = np.minimum(np.abs(values[:, None] - values[None]).sum(axis=2), MOST_DIFFERENCE)
    rng = np.random.default_rng(0)
    for _ in range(SWEEPS):
        best = (costs + PULL * distance[chosen[around]].sum(axis=1)).argmin(axis=1)
        turn = rng.random(len(chosen)) < 0.5  # not all at once: two neighbours that follow each other never settle
        chosen = np.where(turn, best, chosen)
    found = values[chosen]
    moved = np.abs(found - present).max(axis=1) > np.diff(METALLIC).max() / 2 + 1e-6  # more than the grid's own step
    found = np.where(moved[:, None], found, present)[fit.seen.patch]
    return replace(appearance, roughness=found[:, 0], metallic=found[:, 1])


def _costs(fit: PixelFit, appearance: Appearance) -> Float[np.ndarray, "p k"]:
    """Robust squared residuals of each patch for each (roughness, metallic), base colour eliminated."""
    t, light, seen, tie = fit.transport, appearance.radiance, fit.seen, SCALE_SPREAD**-2
    diffuse = [matrix @ light for matrix in t.diffuse]
    columns = []
    for k, roughness in enumerate(NODES):
        gloss, schlick = t.gloss[k] @ light, t.schlick[k] @ light
        lambert = diffuse[0] + roughness * diffuse[1] + roughness**2 * diffuse[2]
        fresnel = F0 * gloss + (1 - F0) * schlick
        for metallic in METALLIC:
            gain = ((1 - metallic) * lambert + metallic * (gloss - schlick)) * fit.pattern
            rest = (1 - metallic) * fresnel + metallic * schlick
            slope = seen.weight * gain
            scale = seen.sums @ (slope * seen.weight * (seen.radiance - rest)) + tie * fit.scale_prior
            scale = np.clip(scale / (seen.sums @ slope**2 + tie), LEAST_ALBEDO, 1 / np.maximum(LEAST_ALBEDO, 1e-9))
            scale = np.minimum(scale[seen.patch], 1 / np.maximum(fit.pattern, LEAST_ALBEDO))
            radiance = scale * gain + rest
            residual = np.abs(seen.weight * (radiance - seen.radiance))
            residual = np.where(seen.clipped & (radiance > seen.radiance), 0, residual)
            columns.append(seen.sums @ fit.loss.cost(residual).sum(axis=1).astype(np.float32))
    return np.stack(columns, axis=1)


def _patch_means(fit: PixelFit, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " p"]:
    ones = np.ones(len(values), np.float32)
    return (fit.seen.sums @ values) / (fit.seen.sums @ ones)


def _neighbours(centre: Float[np.ndarray, "p 3"]) -> Int[np.ndarray, "p k"]:
    count = min(NEIGHBOURS, len(centre) - 1)
    return KDTree(centre).query(centre, k=count + 1)[1].reshape(len(centre), -1)[:, 1:]
