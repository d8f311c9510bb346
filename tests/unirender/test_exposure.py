"""The gauge: closed forms of the rule, and what it must not depend on."""

import numpy as np
import pytest

from unirender.errors import UnirenderError
from unirender.light.exposure import TARGET_RANGE, draw_target, exposure_factor
from unirender.pipelines.editing import RELIGHT_TARGET


@pytest.fixture
def diffuse() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 3, (12, 10, 3)).astype(np.float32)


@pytest.fixture
def mask() -> np.ndarray:
    mask = np.zeros((12, 10, 1), dtype=np.float32)
    mask[2:9, 3:8] = 1
    return mask


def test_grey_light_is_brought_to_the_target(mask: np.ndarray) -> None:
    assert exposure_factor(np.full((12, 10, 3), 0.2, np.float32), mask, 0.8) == pytest.approx(4.0, rel=1e-5)


def test_nine_tenths_of_the_object_lie_below_the_target(diffuse: np.ndarray, mask: np.ndarray) -> None:
    exposed = diffuse * exposure_factor(diffuse, mask, 0.7)
    luminance = exposed[mask[..., 0] > 0] @ np.array([0.2126, 0.7152, 0.0722])
    assert np.mean(luminance < 0.7) == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("scale", [0.5, 2.0, 1000.0])
def test_the_scale_of_the_light_cancels(diffuse: np.ndarray, mask: np.ndarray, scale: float) -> None:
    factor = exposure_factor(diffuse, mask, 0.7)
    assert exposure_factor(diffuse * np.float32(scale), mask, 0.7) * scale == pytest.approx(factor, rel=1e-5)
    assert exposure_factor(diffuse * np.float32(scale), mask, 0.7) != pytest.approx(factor, rel=0.1)


def test_pixels_outside_the_mask_do_not_count(diffuse: np.ndarray, mask: np.ndarray) -> None:
    changed = np.where(mask > 0, diffuse, 100).astype(np.float32)
    assert exposure_factor(changed, mask, 0.7) == exposure_factor(diffuse, mask, 0.7)
    assert exposure_factor(changed, np.ones_like(mask), 0.7) != pytest.approx(
        exposure_factor(diffuse, mask, 0.7), rel=0.1
    )


def test_pixels_count_by_half_their_coverage_or_not_at_all() -> None:
    """d is not premultiplied: what is covered by more than half counts whole, a rim that is covered less does not."""
    d, mask = np.full((1, 20, 3), 0.2, np.float32), np.full((1, 20, 1), 0.6, np.float32)
    d[:, 10:], mask[:, 10:] = 5.0, 0.4
    assert exposure_factor(d, mask, 0.8) == pytest.approx(0.8 / 0.2, rel=1e-5)
    assert exposure_factor(d, mask + np.float32(0.2), 0.8) == pytest.approx(0.8 / 5.0, rel=1e-5)


def test_a_light_from_elsewhere_is_brought_to_the_middle_of_the_range() -> None:
    assert np.mean(TARGET_RANGE) == RELIGHT_TARGET == 0.75


def test_targets_fill_their_range() -> None:
    rng = np.random.default_rng(0)
    targets = [draw_target(rng) for _ in range(500)]
    assert TARGET_RANGE[0] <= min(targets) < TARGET_RANGE[0] + 0.02
    assert TARGET_RANGE[1] - 0.02 < max(targets) <= TARGET_RANGE[1]


def test_an_empty_mask_and_a_black_light_are_refused(diffuse: np.ndarray, mask: np.ndarray) -> None:
    with pytest.raises(UnirenderError, match="coverage"):
        exposure_factor(diffuse, np.zeros_like(mask), 0.7)
    with pytest.raises(UnirenderError, match="light"):
        exposure_factor(np.zeros_like(diffuse), mask, 0.7)


def test_a_light_on_the_rim_alone_is_said_to_be_there() -> None:
    """It was said that there is none."""
    diffuse = np.zeros((10, 10, 3), np.float32)
    diffuse[:, 0] = 0.5
    diffuse[:5, 0] = 0
    with pytest.raises(UnirenderError, match=r"on more than 10% of the object, got it on 5%; .*--exposure 0"):
        exposure_factor(diffuse, np.ones((10, 10, 1), np.float32), 0.7)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_level_that_is_not_finite_is_said_to_be_that(diffuse: np.ndarray, mask: np.ndarray) -> None:
    """It was said that light is missing, on up to 1e+02% of the object."""
    for value in (np.nan, np.inf):
        with pytest.raises(UnirenderError, match="expected finite radiance"):
            exposure_factor(np.full_like(diffuse, value), mask, 0.7)
