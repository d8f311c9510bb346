"""Interpolation in roughness."""

import numpy as np

from unirender_reference.optimize.transport.roughness_nodes import NODES, node_weights


def test_nodes_are_met_and_smooth_functions_followed() -> None:
    nodes = np.array(NODES)
    assert np.allclose(node_weights(nodes)[0], np.eye(len(nodes)))
    r = np.linspace(nodes[0], 1, 301)
    value, _ = node_weights(r)
    for function, bound in ((lambda x: 3 - 2 * x, 1e-12), (lambda x: np.exp(-2 * x), 2e-3)):
        assert np.abs(value @ function(nodes) - function(r)).max() < bound
    linear = np.stack([np.interp(r, nodes, row) for row in np.eye(len(nodes))], axis=1)
    curved = np.exp(-4 * nodes)
    assert np.abs(value @ curved - np.exp(-4 * r)).max() < 0.5 * np.abs(linear @ curved - np.exp(-4 * r)).max()


def test_slopes_are_derivatives() -> None:
    rng = np.random.default_rng(0)
    r, step, values = rng.uniform(0.06, 0.99, 200), 1e-6, rng.random(len(NODES))
    finite = (node_weights(r + step)[0] - node_weights(r - step)[0]) @ values / (2 * step)
    np.testing.assert_allclose(node_weights(r)[1] @ values, finite, atol=1e-6)


def test_outside_the_nodes_the_value_stays() -> None:
    value, slope = node_weights(np.array([0.0, 0.01]))
    assert np.array_equal(value, node_weights(np.array([NODES[0]] * 2))[0])
    assert not slope.any()
