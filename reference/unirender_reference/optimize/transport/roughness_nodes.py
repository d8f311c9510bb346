"""Interpolation in roughness: cubic Hermite splines through values at fixed nodes, tangents by finite differences."""

import numpy as np
from jaxtyping import Float

NODES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0)


def node_weights(
    roughness: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n nodes"], Float[np.ndarray, "n nodes"]]:
    """Weights of the nodes' values in the interpolated value, and in its derivative; outside the nodes constant.

    Args:
        roughness: perceptual, [0, 1].
    """
    nodes = np.array(NODES)
    last = len(nodes) - 1
    inside = np.clip(roughness, nodes[0], nodes[-1])
    lower = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, last - 1)
    step = nodes[lower + 1] - nodes[lower]
    t = (inside - nodes[lower]) / step
    rows = np.arange(len(inside))
    value, slope = np.zeros((len(rows), len(nodes))), np.zeros((len(rows), len(nodes)))
    for node, h, dh in (
        (lower, 2 * t**3 - 3 * t**2 + 1, (6 * t**2 - 6 * t) / step),
        (lower + 1, -2 * t**3 + 3 * t**2, (-6 * t**2 + 6 * t) / step),
    ):
        np.add.at(value, (rows, node), h)
        np.add.at(slope, (rows, node), dh)
    for node, h, dh in ((lower, t**3 - 2 * t**2 + t, 3 * t**2 - 4 * t + 1), (lower + 1, t**3 - t**2, 3 * t**2 - 2 * t)):
        before, after = np.maximum(node - 1, 0), np.minimum(node + 1, last)
        span = nodes[after] - nodes[before]  # the tangent at a node is the slope between its neighbours
        for neighbour, sign in ((after, 1), (before, -1)):
            np.add.at(value, (rows, neighbour), sign * h * step / span)
            np.add.at(slope, (rows, neighbour), sign * dh / span)
    outside = (roughness < nodes[0]) | (roughness > nodes[-1])
    slope[outside] = 0
    return value, slope
