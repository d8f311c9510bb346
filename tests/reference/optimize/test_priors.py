"""Priors: derivatives against central differences, and what each of them leaves alone."""

from collections.abc import Callable

import numpy as np
import pytest

from unirender_reference.optimize.refine.priors import anchor, smoothness, white_light

Prior = Callable[[np.ndarray], tuple[float, np.ndarray]]
FIRST = np.random.default_rng(1).uniform(0.1, 1, (4, 6, 3)).astype(np.float32)
PRIORS: dict[str, Prior] = {
    "smooth": lambda x: smoothness(x, 0.1),
    "white": white_light,
    "anchor": lambda x: anchor(x, FIRST),
}


@pytest.mark.parametrize("name", PRIORS)
def test_derivative_is_that_of_the_value(name: str) -> None:
    prior, rng = PRIORS[name], np.random.default_rng(0)
    x, move = rng.uniform(0.1, 1, (4, 6, 3)), rng.normal(size=(4, 6, 3))
    slope = prior(x.astype(np.float32))[1]
    step = 1e-3
    central = (prior((x + step * move).astype(np.float32))[0] - prior((x - step * move).astype(np.float32))[0]) / (
        2 * step
    )
    along = float((slope * move).sum())
    assert along == pytest.approx(central, rel=0.01)
    assert 1.05 * along != pytest.approx(central, rel=0.01)


def test_what_costs_nothing() -> None:
    rng = np.random.default_rng(3)
    grey = np.repeat(rng.uniform(0.1, 5, (4, 6, 1)), 3, -1).astype(np.float32)
    colored = grey * np.array([1, 0.5, 0.2], np.float32)
    assert smoothness(np.full((4, 6, 3), 0.3, np.float32), 0.1)[0] == 0
    assert white_light(grey)[0] == pytest.approx(0, abs=1e-6)
    assert white_light(colored)[0] > 0.01
    assert white_light(2 * colored)[0] == pytest.approx(2 * white_light(colored)[0], rel=1e-4)
    assert anchor(FIRST, FIRST)[0] == 0


def test_edges_cost_less_than_their_square() -> None:
    step = np.zeros((4, 6), np.float32)
    step[:, 3:] = 1
    one, two = smoothness(step, 0.02)[0], smoothness(2 * step, 0.02)[0]
    assert two == pytest.approx(2 * one, rel=0.05)
    small = smoothness(0.001 * step, 0.02)[0]
    assert smoothness(0.002 * step, 0.02)[0] == pytest.approx(4 * small, rel=0.05)
