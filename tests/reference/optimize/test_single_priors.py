"""Priors of single-view optimisation: what a pixel, a channel or a light may differ by, read off their precisions."""

import dataclasses

import numpy as np
import pytest

from unirender_reference.optimize.single.config import Priors
from unirender_reference.optimize.single.priors import (
    CHROMA,
    CROSSING,
    LIGHT_GRID,
    albedo_precision,
    gain_precision,
    level_freed,
    light_interpolation,
    light_precision,
)
from unirender_reference.optimize.transport.light_grid import LightGrid

PRIORS = Priors()
PAIRS = np.array([[0, 1], [1, 2]])  # of three pixels in a row


def albedo_cost(u: np.ndarray, display: np.ndarray, coverage: np.ndarray) -> float:
    return float(u @ albedo_precision(display, coverage, PAIRS, PRIORS) @ u)


def test_a_covariance_is_freed_by_its_level() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    precision = root @ root.T + np.eye(4)
    freed = np.linalg.inv(level_freed(precision, 1.7))
    np.testing.assert_allclose(freed, np.linalg.inv(precision) + 1.7**2, rtol=1e-9)


def test_the_mean_of_the_gains_has_one_width_and_what_they_differ_by_another() -> None:
    covariance = np.linalg.inv(gain_precision(PRIORS))
    even, tint = np.full(3, 1 / 3), np.array([1, -1, 0]) / np.sqrt(2)
    assert even @ covariance @ even == pytest.approx(PRIORS.brightness**2)
    assert tint @ covariance @ tint == pytest.approx(PRIORS.tint**2)


def test_an_albedo_costs_by_pixel_and_by_step_and_less_where_it_is_covered_less() -> None:
    grey, whole = np.full((3, 3), 0.4), np.ones((3, 1))
    own, step = PRIORS.albedo**-2, PRIORS.albedo_step**-2
    assert albedo_cost(np.ones(3), grey, whole) == pytest.approx(3 * own)
    assert albedo_cost(np.array([0.0, 0, 1]), grey, whole) == pytest.approx(own + step)
    part = np.array([[1.0], [1.0], [0.25]])
    assert albedo_cost(np.array([0.0, 0, 1]), grey, part) == pytest.approx(0.25 * (own + step))
    bright = grey * np.array([[1], [1], [2]])  # shading: a factor of all channels alike
    assert albedo_cost(np.array([0.0, 0, 1]), bright, whole) == pytest.approx(own + step, rel=0.01)


def test_one_colour_is_no_crossing_and_a_crossing_is_one_between_its_two_pixels() -> None:
    red, green, whole = [0.8, 0.2, 0.1], [0.1, 0.6, 0.2], np.ones((3, 1))
    own, step = PRIORS.albedo**-2, PRIORS.albedo_step**-2
    assert albedo_cost(np.array([0.0, 0, 1]), np.array([red] * 3), whole) == pytest.approx(own + step)
    assert albedo_cost(np.array([0.0, 0, 1]), np.array([green, red, red]), whole) == pytest.approx(own + step)


def test_a_step_costs_less_where_the_picture_changes_its_colour() -> None:
    """Of a ratio of channels that is CHROMA from even, a share of 1 / e of what a crossing does not leave anyway."""
    away = CHROMA / np.sqrt(2) * np.array([1, -1, 0])
    display = np.array([[0.4] * 3, [0.4] * 3, [0.4] * 3])
    display[2] = 0.45 * np.exp(away) - 0.05
    own, step = PRIORS.albedo**-2, PRIORS.albedo_step**-2
    share = CROSSING + (1 - CROSSING) / np.e
    whole = np.ones((3, 1))
    assert albedo_cost(np.array([0.0, 0, 1]), display, whole) == pytest.approx(own + share * step)
    display[2] = [0.9, 0.01, 0.01]
    assert albedo_cost(np.array([0.0, 0, 1]), display, whole) == pytest.approx(own + CROSSING * step, rel=1e-3)


def test_a_light_may_be_brighter_as_a_whole_and_has_its_colour() -> None:
    """The mean over directions, weighted by their area, of log light whose neighbours are tied hard."""
    stiff = dataclasses.replace(PRIORS, light_step=1e-3)
    covariance = np.linalg.inv(light_precision(stiff))
    count = LIGHT_GRID[0] * LIGHT_GRID[1]
    mean = np.kron(np.eye(3), np.full((1, count), 1 / count))  # of each channel
    channels = mean @ covariance @ mean.T
    even, tint = np.full(3, 1 / 3), np.array([1, -1, 0]) / np.sqrt(2)
    # one value for all directions: each of them says so with its own width, and the level moves them together
    assert even @ channels @ even == pytest.approx(stiff.light**2 / count + stiff.light_level**2, rel=1e-3)
    assert tint @ channels @ tint == pytest.approx(stiff.light_chroma**2 / count + stiff.light_tint**2, rel=1e-3)


def test_a_direction_of_light_has_its_own_width_where_nothing_ties_it() -> None:
    loose = dataclasses.replace(PRIORS, light_step=1e6, light_level=0.0, light_tint=0.0)
    precision = light_precision(loose).reshape(3, *LIGHT_GRID, 3, *LIGHT_GRID)
    horizon, pole = precision[:, 3, 5][:, :, 3, 5], precision[:, 0, 5][:, :, 0, 5]
    sine = np.maximum(np.sin(np.pi * np.arange(8) / 7), 0.1)
    for found, row in ((horizon, 3), (pole, 0)):
        area = sine[row] / sine.mean()
        assert np.ones(3) @ found @ np.ones(3) == pytest.approx(area / loose.light**2, rel=0.02)
        assert np.array([1, -1, 0]) @ found @ np.array([1, -1, 0]) / 2 == pytest.approx(
            area / loose.light_chroma**2, rel=0.02
        )


def test_a_light_is_tied_to_its_neighbours_and_its_colour_by_less() -> None:
    """One direction that differs, near the horizon: from two in its row and two in its column."""
    precision = light_precision(PRIORS).reshape(3, *LIGHT_GRID, 3, *LIGHT_GRID)[:, 3, 5][:, :, 3, 5]
    steps = (2 / np.sin(3 * np.pi / 7) + np.sin(2.5 * np.pi / 7) + np.sin(3.5 * np.pi / 7)) / PRIORS.light_step**2
    sine = np.maximum(np.sin(np.pi * np.arange(8) / 7), 0.1)
    area = sine[3] / sine.mean()
    assert precision.sum() == pytest.approx(area / PRIORS.light**2 + steps, rel=0.01)
    finer = PRIORS.light / (2 * PRIORS.light_chroma)
    tint = np.array([1, -1, 0]) / np.sqrt(2)
    assert tint @ precision @ tint == pytest.approx(area / PRIORS.light_chroma**2 + steps * finer**2, rel=0.01)


def test_the_coarse_light_is_interpolated() -> None:
    """A light of one value stays; a ramp from pole to pole stays one; its own grid gives it back."""
    fine = LightGrid(15, 32)
    matrix = light_interpolation(fine)
    np.testing.assert_allclose(matrix @ np.ones(128), 1)
    ramp = (matrix @ np.repeat(np.arange(8.0), 16)).reshape(15, 32)
    np.testing.assert_allclose(ramp, np.repeat(np.arange(15.0)[:, None] / 2, 32, axis=1), atol=1e-9)
    wave = (matrix @ np.tile(np.arange(16.0), 8)).reshape(15, 32)
    np.testing.assert_allclose(wave[4, [1, 2, 31, 0]], [0.25, 0.75, 11.25, 3.75])
    np.testing.assert_allclose((light_interpolation(LightGrid(*LIGHT_GRID))).toarray(), np.eye(128), atol=1e-12)
