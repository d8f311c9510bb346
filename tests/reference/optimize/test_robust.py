"""Robust losses: weights are their derivatives, and what cannot be explained decides nothing."""

import numpy as np
import pytest

from unirender_reference.optimize.numerics.robust import HUBER, Cauchy, Loss, cauchy

LOSSES = [HUBER, Cauchy(1.0), Cauchy(0.3)]


@pytest.mark.parametrize("loss", LOSSES)
def test_the_weight_times_the_residual_is_half_the_slope(loss: Loss) -> None:
    size, step = np.array([1e-3, 0.2, 1.0, 3.9, 4.1, 30.0]), 1e-5
    slope = (loss.cost(size + step) - loss.cost(size - step)) / (2 * step)
    np.testing.assert_allclose(2 * loss.weight(size) * size, slope, rtol=1e-5)


@pytest.mark.parametrize(("loss", "at_zero"), list(zip(LOSSES, (1.0, 1.0, 1 / 0.09), strict=True)))
def test_small_residuals_count_as_squares(loss: Loss, at_zero: float) -> None:
    np.testing.assert_allclose(loss.weight(np.zeros(1)), at_zero)
    np.testing.assert_allclose(loss.cost(np.array([1e-3])), at_zero * 1e-6, rtol=1e-4)


def test_cauchy_leaves_the_wrong_tenth_alone() -> None:
    """A mean under each loss, by its weights, of values of which a tenth is far off."""
    rng = np.random.default_rng(0)
    values = np.where(rng.random(5000) < 0.1, 40.0, rng.normal(0, 0.2, 5000))

    def mean(loss: Loss) -> float:
        found = float(np.median(values)) + 1
        for _ in range(50):
            weight = loss.weight(np.abs(values - found))
            found = float((weight * values).sum() / weight.sum())
        return found

    assert abs(mean(cauchy(np.abs(values - np.median(values)), 0.05))) < 0.02
    assert mean(HUBER) > 0.3


def test_the_scale_is_the_standard_deviation_of_normal_residuals_and_has_a_floor() -> None:
    size = np.abs(np.random.default_rng(1).normal(0, 3.0, 20000))
    assert cauchy(size, 0.2).scale == pytest.approx(3.0, rel=0.03)
    assert cauchy(size / 100, 0.2).scale == 0.2
    assert cauchy(np.zeros(0), 0.2).scale == 0.2  # all pixels saturated
