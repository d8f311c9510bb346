"""Metallic x roughness under one light from a few renders: radiance is a polynomial in metallic.

The principled BSDF is linear in `metallic`, so that radiance after n bounces is a polynomial of degree n: three nodes
give every metallic value after two bounces exactly, four after three (depth 4). The cubic term is small; how small, and
what the sweep saves, `docs/noise.md` says. With L_k the Lagrange polynomials of the nodes m_k,

    I(r, m) = sum_k L_k(m) I(r, m_k),    var I(r, m) = sum_k L_k(m)^2 var I(r, m_k),

since all renders have seeds of their own.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.shown import short_repr
from unirender_reference.noise import full_spp
from unirender_reference.passes import TRUTH_BATCHES, Estimate, derive_seed
from unirender_reference.render import IMAGE_DEPTH, Renderer

QUADRATIC = (0.0, 0.5, 1.0)
CUBIC = (0.0, 0.25, 0.75, 1.0)  # Chebyshev-Lobatto: less noise than evenly spaced ones
GRID = tuple(i / 10 for i in range(11))


@dataclass(frozen=True)
class Sweep:
    """A rendered sweep.

    Attributes:
        roughness_values: R of them.
        metallic_values: M of them.
        node_values: K metallic values that were rendered.
        node_mean: their images, premultiplied linear RGBA.
        node_variance: of `node_mean`; None for one batch.
        node_spp: samples per pixel of each node's images.
        renders: images rendered, R * K.
        nan_pixels: rendered again with another seed.
    """

    roughness_values: tuple[float, ...]
    metallic_values: tuple[float, ...]
    node_values: tuple[float, ...]
    node_mean: Float[np.ndarray, "r k h w 4"]
    node_variance: Float[np.ndarray, "r k h w 4"] | None
    node_spp: tuple[int, ...]
    renders: int
    nan_pixels: int

    __repr__ = short_repr

    def estimate(self, roughness_index: int, metallic_index: int) -> Estimate:
        """One pair; a pixel with little light and much noise can come out below 0, and stays unbiased so."""
        weights = lagrange_weights(self.node_values, [self.metallic_values[metallic_index]])[0]
        mean = np.tensordot(weights, self.node_mean[roughness_index], 1).astype(np.float32)
        if self.node_variance is None:
            return Estimate(mean, None, 0)
        variance = np.tensordot(np.square(weights), self.node_variance[roughness_index], 1)
        return Estimate(mean, variance.astype(np.float32), 0)

    @functools.cached_property
    def mean(self) -> Float[np.ndarray, "r m h w 4"]:
        """All pairs."""
        weights = lagrange_weights(self.node_values, self.metallic_values).astype(np.float32)
        return np.einsum("mk,rkhwc->rmhwc", weights, self.node_mean)

    @functools.cached_property
    def variance(self) -> Float[np.ndarray, "r m h w 4"] | None:
        """Variance of `mean`. The pairs of one roughness share their nodes: their noise is correlated."""
        if self.node_variance is None:
            return None
        weights = lagrange_weights(self.node_values, self.metallic_values).astype(np.float32)
        return np.einsum("mk,rkhwc->rmhwc", np.square(weights), self.node_variance)


def lagrange_weights(nodes: Sequence[float], values: Sequence[float]) -> Float[np.ndarray, "m k"]:
    """L_k(m): the weight of node k in the interpolation polynomial at value m.

    Raises:
        UnirenderError: fewer than two nodes, or one occurs twice.
    """
    if len(nodes) < 2 or len(set(nodes)) < len(nodes):
        raise UnirenderError(f"metallic nodes: got {list(nodes)}, expected at least two different ones")
    m = np.asarray(values, np.float64)
    weights = np.ones((len(m), len(nodes)))
    for k, node in enumerate(nodes):
        for other in nodes:
            if other != node:
                weights[:, k] *= (m - other) / (node - other)
    return weights


def node_shares(nodes: Sequence[float], values: Sequence[float]) -> Float[np.ndarray, " k"]:
    """Samples of each node, in those that a pair of a brute-force sweep has, for the same mean variance of all pairs.

    A pair's variance is sum_k L_k(m)^2 v / n_k if a sample's variance v does not depend on metallic. With W_k the mean
    of L_k(m)^2 over the values, n_k = sqrt(W_k) sum_j sqrt(W_j) gives the mean variance v of one sample each with the
    fewest samples in all: (sum_k sqrt(W_k))^2.
    """
    root = np.sqrt(np.square(lagrange_weights(nodes, values)).mean(axis=0))
    return root * root.sum()


def render_sweep(
    renderer: Renderer,
    environment: Float[np.ndarray, "h w 3"],
    roughness_values: Sequence[float] = GRID,
    metallic_values: Sequence[float] = GRID,
    spp: int = 256,
    seed: int = 0,
    batches: int = TRUTH_BATCHES,
    *,
    nodes: Sequence[float] = QUADRATIC,
    common_seeds: bool = False,
    depth: int = IMAGE_DEPTH,
) -> Sweep:
    """All pairs of the two lists of values, with the error of a render of each pair at `spp` samples per pixel.

    Args:
        renderer: its scene is reused; only parameters change.
        environment: linear radiance, exposure folded in.
        roughness_values: perceptual; each is rendered.
        metallic_values: interpolated between the nodes.
        spp: samples per pixel of a brute-force sweep with the same mean variance; the nodes' follow from it.
        seed: another seed gives an independent sweep.
        batches: passes of each render; 1: no variance.
        nodes: metallic values that are rendered.
        common_seeds: the same random numbers at every roughness, so that the noise of neighbours cancels in their
            difference. Their noise is then correlated, which is wrong for pairs that are to be independent.
        depth: of the path tracer.

    Raises:
        UnirenderError: a value lies outside [0, 1], or there are too few nodes.
    """
    for name, values in (("roughness", roughness_values), ("metallic", metallic_values), ("nodes", nodes)):
        wrong = [float(value) for value in values if not 0 <= value <= 1]
        if wrong or not len(values):
            raise UnirenderError(f"sweep: got {name} {wrong or 'without values'}, expected values in [0, 1]")
    shares = node_shares(nodes, metallic_values)
    node_spp = [full_spp(share * spp, batches, renderer.resolution**2) for share in shares]
    estimates = [
        [
            renderer.image(
                environment,
                roughness,
                node,
                count,
                derive_seed(seed, "sweep", k, *(() if common_seeds else (i,))),
                depth,
                batches,
            )
            for k, (node, count) in enumerate(zip(nodes, node_spp, strict=True))
        ]
        for i, roughness in enumerate(roughness_values)
    ]
    variances = [[found.variance for found in row if found.variance is not None] for row in estimates]
    return Sweep(
        roughness_values=tuple(map(float, roughness_values)),
        metallic_values=tuple(map(float, metallic_values)),
        node_values=tuple(map(float, nodes)),
        node_mean=np.array([[found.mean for found in row] for row in estimates]),
        node_variance=np.array(variances) if batches > 1 else None,
        node_spp=tuple(node_spp),
        renders=len(nodes) * len(roughness_values),
        nan_pixels=sum(found.nan_pixels for row in estimates for found in row),
    )
