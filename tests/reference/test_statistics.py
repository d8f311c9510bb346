"""The z-test: right on simulated estimates of equal expectation, and it fails on each kind of error it is made for."""

import numpy as np
import pytest
from scipy.stats import binom, ttest_ind

from unirender.errors import UnirenderError
from unirender_reference.statistics import LEVEL, PASS_SHARE, p_values, share_bar, z_test

SHAPE = (64, 64, 3)


def estimate(mean: np.ndarray, sigma: float, seed: int, batches: int = 8) -> tuple[np.ndarray, np.ndarray]:
    draws = mean + np.random.default_rng(seed).normal(0, sigma, (batches, *mean.shape))
    return draws.mean(axis=0), draws.var(axis=0, ddof=1) / batches


TRUTH = np.random.default_rng(0).uniform(0.1, 1, SHAPE)


@pytest.mark.parametrize("seed", range(5))
def test_equal_expectations_pass(seed: int) -> None:
    result = z_test(*estimate(TRUTH, 0.1, seed), *estimate(TRUTH, 0.1, seed + 100))
    assert result.passed, str(result)
    assert abs(result.pass_share - 0.95) < 0.012
    assert result.values == TRUTH.size


def test_p_values_are_those_of_welchs_test() -> None:
    """Of unequal batches; the twin exchanges their numbers."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(1, 0.2, (4, 50)), rng.normal(1.1, 0.4, (12, 50))
    (mean_a, var_a), (mean_b, var_b) = ((x.mean(axis=0), x.var(axis=0, ddof=1) / len(x)) for x in (a, b))
    expected = np.asarray(ttest_ind(a, b, equal_var=False))[1]
    found, twin = (p_values(mean_a, var_a, mean_b, var_b, *batches) for batches in ((4, 12), (12, 4)))
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert np.abs(twin / expected - 1).max() > 0.01


def test_one_wrong_pixel_fails() -> None:
    mean, variance = estimate(TRUTH, 0.02, 3)
    mean[10, 10, 0] += 0.5
    result = z_test(mean, variance, *estimate(TRUTH, 0.02, 4))
    assert not result.passed
    assert result.min_p < result.threshold
    assert result.pass_share > 0.92


def test_small_error_everywhere_fails() -> None:
    result = z_test(*estimate(TRUTH * 1.08, 0.1, 3), *estimate(TRUTH, 0.1, 4))
    assert not result.passed
    assert result.min_p > result.threshold
    assert result.pass_share < 0.92


@pytest.mark.parametrize("alpha", [0.01, 5e-4])
@pytest.mark.parametrize("pixels", [1, 20, 150, 250])
def test_share_bar_is_the_binomial_quantile(pixels: int, alpha: float) -> None:
    """That more pixels fail than the bar allows has at most the chance alpha; of one fewer it has not."""
    most = round((1 - share_bar(pixels, alpha)) * pixels)
    assert binom.sf(most, pixels, LEVEL) <= alpha < binom.sf(most - 1, pixels, LEVEL)


def test_share_bar_of_a_large_picture_leaves_room_for_skewed_noise() -> None:
    assert share_bar(20_000, 0.01) == PASS_SHARE
    assert share_bar(150, 0.01) < PASS_SHARE


def test_small_equal_pictures_with_equal_channels_rarely_fail() -> None:
    """Of 600 pairs of equal grey pictures of 150 pixels; with the bar of large pictures many would fail."""
    shares, passed = [], []
    for seed in range(600):
        (a, var_a), (b, var_b) = (estimate(np.ones((1, 150, 1)), 0.1, 2 * seed + i, 16) for i in (0, 1))
        grey = (np.repeat(array, 3, axis=-1) for array in (a, var_a, b, var_b))
        result = z_test(*grey, batches_a=16, batches_b=16, alpha=5e-4)
        shares.append(result.pass_share)
        passed.append(result.passed)
    assert passed.count(False) <= 3  # 0.6 are expected at most
    assert sum(share < PASS_SHARE for share in shares) > 10


def test_message_names_the_bar_in_use() -> None:
    arguments = estimate(np.ones((10, 15, 1)), 0.1, 1), estimate(np.ones((10, 15, 1)), 0.1, 2)
    result = z_test(*arguments[0], *arguments[1])
    assert result.share_threshold == share_bar(150, 0.01)
    assert f"(threshold {result.share_threshold:.4g})" in str(result)


def test_identical_pictures_pass_and_the_mask_restricts() -> None:
    mean, variance = estimate(TRUTH, 0.1, 3)
    assert z_test(mean, variance, mean, variance).min_p == 1
    wrong = mean.copy()
    wrong[:32] += 10
    mask = np.zeros((64, 64, 1))
    mask[32:] = 1
    assert z_test(mean, variance, wrong, variance, mask).passed
    assert not z_test(mean, variance, wrong, variance, 1 - mask).passed


def test_rounding_is_no_difference() -> None:
    """It is relative: of a radiance of thousands it is larger."""
    zero = np.zeros(SHAPE)
    for truth in (0.1 * TRUTH, TRUTH, 1e4 * TRUTH):
        assert z_test(truth, zero, truth * (1 + 1e-5), zero).passed
        assert not z_test(truth, zero, truth * (1 + 3e-3), zero).passed


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(UnirenderError, match="empty mask"):
        z_test(TRUTH, TRUTH, TRUTH, TRUTH, np.zeros((64, 64, 1)))


def test_a_family_level_that_is_no_chance_is_refused() -> None:
    with pytest.raises(UnirenderError, match="alpha 2, expected"):
        z_test(TRUTH, TRUTH, TRUTH, TRUTH, alpha=2.0)


def test_a_stricter_family_level_lowers_the_threshold() -> None:
    arguments = (*estimate(TRUTH, 0.1, 1), *estimate(TRUTH, 0.1, 2))
    assert z_test(*arguments, alpha=1e-3).threshold < z_test(*arguments).threshold / 5
