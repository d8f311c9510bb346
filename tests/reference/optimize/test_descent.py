"""Adam on a pyramid: against Adam written out, what coarse levels and the uniform step change, and its operators."""

import numpy as np
import pytest

from unirender_reference.optimize.numerics.descent import BETA_1, PyramidAdam, interpolation


@pytest.mark.parametrize("beta_2", [0.99, 0.999])
def test_one_level_is_adam(beta_2: float) -> None:
    rng, rate = np.random.default_rng(0), 0.1
    gradients = rng.normal(size=(5, 3, 4, 2))
    adam = PyramidAdam((3, 4, 2), beta_2=beta_2)
    first = second = expected = np.zeros((3, 4, 2))
    for count, gradient in enumerate(gradients, start=1):
        first = BETA_1 * first + (1 - BETA_1) * gradient
        second = beta_2 * second + (1 - beta_2) * gradient**2
        expected = -rate * (first / (1 - BETA_1**count)) / np.sqrt(second / (1 - beta_2**count))
        np.testing.assert_allclose(adam.step(gradient, rate), expected, rtol=1e-5)
    other = PyramidAdam((3, 4, 2), beta_2=1.989 - beta_2)
    assert not np.allclose([other.step(gradient, rate) for gradient in gradients][-1], expected, rtol=1e-3)
    assert not np.allclose(PyramidAdam((3, 4, 2), uniform=True).step(gradients[0], rate), expected, rtol=0.1)


def test_interpolation_reproduces_ramps_and_closes_circles() -> None:
    matrix = interpolation(16, 4, circular=False)
    np.testing.assert_allclose(matrix.sum(1), 1)
    ramp = matrix @ ((np.arange(4) + 0.5) / 4)
    np.testing.assert_allclose(ramp[2:-2], ((np.arange(16) + 0.5) / 16)[2:-2])
    circle = interpolation(16, 4, circular=True)
    np.testing.assert_allclose(circle[0, [0, 3]], [0.625, 0.375])
    assert matrix[0, 3] == 0


def test_coarse_levels_follow_what_neighbours_share() -> None:
    """Of a weak common gradient under strong noise, Adam sees little and the pyramid most."""
    rng = np.random.default_rng(1)
    moved = {}
    for levels in (1, 3):
        adam, at = PyramidAdam((16, 16, 1), levels), np.zeros((16, 16, 1))
        for _ in range(20):
            at += adam.step(1 + 10 * rng.normal(size=at.shape), 0.01)
        moved[levels] = -at.mean() / 0.2  # of the way that a noise-free Adam goes
    assert moved[1] < 0.3
    assert moved[3] > 0.8


def test_uniform_steps_keep_proportions() -> None:
    gradient = np.array([[[1.0], [0.01], [0.0]]])
    each, uniform = (PyramidAdam((1, 3, 1), uniform=flag).step(gradient, 0.1)[0, :, 0] for flag in (False, True))
    np.testing.assert_allclose(each, [-0.1, -0.1, 0], rtol=1e-5)
    assert uniform[0] / uniform[1] == pytest.approx(100, rel=1e-4)
    assert uniform[2] == 0


def test_moments_are_restored() -> None:
    rng = np.random.default_rng(2)
    adam, other = (PyramidAdam((8, 8, 3), 2, circular=True, uniform=True) for _ in range(2))
    for gradient in rng.normal(size=(3, 8, 8, 3)):
        adam.step(gradient, 0.1)
    other.restore([array.copy() for array in adam.arrays()], 3)
    gradient = rng.normal(size=(8, 8, 3))
    np.testing.assert_array_equal(other.step(gradient, 0.1), adam.step(gradient, 0.1))
    assert not np.array_equal(PyramidAdam((8, 8, 3), 2, True, True).step(gradient, 0.1), adam.step(gradient, 0.1))
