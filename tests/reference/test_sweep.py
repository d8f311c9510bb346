"""The sweep of metallic x roughness: its weights in closed form, and against brute force, with twins that must fail."""

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_scenes import environment

from unirender.errors import UnirenderError
from unirender_reference import sweep_check
from unirender_reference.measure.sweep import SweepMeasure
from unirender_reference.render import Renderer
from unirender_reference.shapes import make_object
from unirender_reference.sweep import CUBIC, GRID, QUADRATIC, lagrange_weights, node_shares, render_sweep

LINEAR = (0.0, 1.0)
ROUGHNESS, METALLIC = (0.6, 0.8, 0.95), (0.0, 0.25, 0.5, 0.75, 1.0)
SPP, BATCHES = 512, 8


@pytest.mark.parametrize("nodes", [LINEAR, QUADRATIC, CUBIC])
def test_weights_reproduce_polynomials_of_their_degree(nodes: tuple[float, ...]) -> None:
    """A polynomial of degree K - 1 exactly; twin: one degree more is off."""
    coefficients = np.random.default_rng(0).uniform(0.5, 1, len(nodes) + 1)
    weights = lagrange_weights(nodes, GRID)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-12)
    own, higher = coefficients[1:], coefficients
    np.testing.assert_allclose(weights @ np.polyval(own, nodes), np.polyval(own, GRID), rtol=1e-12)
    assert np.abs(weights @ np.polyval(higher, nodes) - np.polyval(higher, GRID)).max() > 0.01


@pytest.mark.parametrize("nodes", [LINEAR, QUADRATIC, CUBIC])
def test_shares_give_brute_forces_error_with_the_fewest_samples(nodes: tuple[float, ...]) -> None:
    """The mean over the pairs of sum_k L_k^2 / n_k is 1; twins: equal shares of the same error, and shares changed a
    little at equal error, take more."""
    squares = np.square(lagrange_weights(nodes, GRID)).mean(axis=0)
    shares = node_shares(nodes, GRID)
    assert (squares / shares).sum() == pytest.approx(1, rel=1e-12)
    equal = np.full(len(nodes), squares.sum())
    changed = shares * np.linspace(0.9, 1.1, len(nodes))
    changed *= (squares / changed).sum()
    assert changed.sum() > shares.sum() * (1 + 1e-4)
    assert equal.sum() >= shares.sum() * (1 - 1e-12)
    expected = {LINEAR: 1.40, QUADRATIC: 2.32, CUBIC: 3.44}[nodes]
    assert shares.sum() == pytest.approx(expected, abs=0.01), "of 11"


@pytest.mark.parametrize("nodes", [(0.5,), (0.0, 1.0, 0.0)])
def test_too_few_nodes_are_refused(nodes: tuple[float, ...]) -> None:
    with pytest.raises(UnirenderError, match="expected at least two different ones"):
        lagrange_weights(nodes, GRID)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    """A shell, white: light that bounces inside it makes radiance anything but linear in metallic."""
    obj = make_object(2089, "test")
    assert obj.family == "shell"
    return Renderer(replace(obj, albedo=np.full_like(obj.albedo, 0.95)), resolution=24)


@pytest.mark.long
def test_a_sweep_equals_brute_force(renderer: Renderer) -> None:
    """z-test over all values of all pairs, and the same total error. Twins: linear interpolation, and roughness 12 %
    off."""
    light = np.ones((8, 16, 3), np.float32) * np.linspace(0, 2, 8, dtype=np.float32)[:, None, None]
    mask = renderer.geometry(256).require("mask")["mask"]
    brute = sweep_check.brute_force(renderer, light, ROUGHNESS, METALLIC, SPP, 1, BATCHES)
    sweep = render_sweep(renderer, light, ROUGHNESS, METALLIC, SPP, 2, BATCHES)
    assert sweep.renders == 9
    test = sweep_check.compare(sweep, brute, mask, BATCHES)
    assert test.passed, str(test)
    assert test.values == 3 * 5 * 3 * int((mask > 0.5).sum())
    for ratio in sweep_check.error_ratios(sweep, brute, mask):
        assert 0.7 < ratio < 1.2
    linear = render_sweep(renderer, light, ROUGHNESS, METALLIC, SPP, 2, BATCHES, nodes=LINEAR)
    rougher = render_sweep(renderer, light, [1.12 * r for r in ROUGHNESS[:2]], METALLIC, SPP, 2, BATCHES)
    some = sweep_check.Pairs(brute.mean[:2], brute.variance[:2])
    for twin in (sweep_check.compare(linear, brute, mask, BATCHES), sweep_check.compare(rougher, some, mask, BATCHES)):
        assert not twin.passed, str(twin)


def test_pairs_come_from_their_nodes(renderer: Renderer) -> None:
    """A node's own pair is its render; a pair between is the weighted sum, its variance by the squares."""
    light = environment(5)
    sweep = render_sweep(renderer, light, (0.4,), METALLIC, 256, 3, 4)  # 64 a pass, as below: one kernel
    variance = sweep.variance
    assert variance is not None
    assert sweep.node_variance is not None
    assert sweep.mean.shape == variance.shape == (1, 5, 24, 24, 4)
    taken = sweep.node_spp / node_shares(QUADRATIC, METALLIC) / 256
    assert ((taken >= 1) & (taken < 2)).all(), "rounded up to the sampler's grid"
    np.testing.assert_allclose(sweep.mean[:, ::2], sweep.node_mean, rtol=1e-6)
    weights = np.array([0.375, 0.75, -0.125])  # of m = 0.25
    np.testing.assert_allclose(sweep.mean[0, 1], np.tensordot(weights, sweep.node_mean[0], 1), atol=1e-6)
    spread = np.tensordot(np.square(weights), sweep.node_variance[0], 1)
    np.testing.assert_allclose(variance[0, 1], spread, rtol=1e-5)
    pair = sweep.estimate(0, 1)
    assert pair.variance is not None
    np.testing.assert_allclose(pair.mean, sweep.mean[0, 1], atol=1e-6)
    np.testing.assert_allclose(pair.variance, variance[0, 1], rtol=1e-5)
    assert render_sweep(renderer, light, (0.4,), METALLIC, 64, 3, 1).variance is None


def test_common_seeds_quieten_the_difference_between_neighbours(renderer: Renderer) -> None:
    """And nothing else: pairs at the same roughness keep seeds of their own."""
    light, mask = environment(5), renderer.geometry(64).require("mask")["mask"]
    noise = [
        sweep_check.difference_noise(renderer, light, (0.5, 0.6), METALLIC, mask, 64, common_seeds=value)
        for value in (True, False)
    ]
    assert noise[0] < 0.9 * noise[1]
    sweep = render_sweep(renderer, light, (0.5, 0.5), METALLIC, 64, 3, 1, common_seeds=True)
    np.testing.assert_array_equal(sweep.node_mean[0], sweep.node_mean[1])
    independent = render_sweep(renderer, light, (0.5, 0.5), METALLIC, 64, 3, 1)
    assert np.abs(independent.node_mean[0] - independent.node_mean[1]).max() > 0.01


@pytest.mark.parametrize(
    ("roughness", "metallic", "nodes"),
    [
        ((0.5,), (0.0, 1.5), QUADRATIC),
        ((0.5,), (math.nan,), QUADRATIC),
        ((), (0.5,), QUADRATIC),
        ((0.5,), (0.5,), (0, 2)),
    ],
)
def test_values_outside_the_range_are_refused(
    renderer: Renderer, roughness: tuple, metallic: tuple, nodes: tuple
) -> None:
    with pytest.raises(UnirenderError, match=r"sweep: got .* expected values in \[0, 1\]"):
        render_sweep(renderer, environment(), roughness, metallic, 16, nodes=nodes)


@pytest.mark.long
def test_the_command_compares_renders_time_error_and_values() -> None:
    rows = {row.quantity: row for row in SweepMeasure(resolution=16, spp=16, levels=2, batches=4).measure()}
    assert rows["renders"].found == "6 for 4 pairs"
    assert rows["object"].found.startswith("train-000000")
    assert "+-" in rows["cubic term, of mean radiance (roughness 0.9)"].found
    assert rows["minimum p"].passed
    assert rows["share of p >= 0.05"].passed
    assert float(rows["seconds, sweep"].found) > 0
    assert float(rows["time ratio"].found) > 0
