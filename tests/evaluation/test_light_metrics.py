"""Lights whose scale is free: the best factor, and the direction that the light comes from."""

import math

import numpy as np
import pytest
from reference_scenes import environment

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions, rotate_environment, texel_solid_angles
from unirender.light.resampling import resample_environment
from unirender_evaluation import metrics
from unirender_evaluation.light_balls import ball_values
from unirender_evaluation.light_metrics import (
    SHAPE,
    brightest_direction,
    light_values,
    peak_angle_deg,
    scaled_log_rmse,
    score_light,
)


def lamp(row: float, column: float, width_deg: float = 8.0, radiance: float = 20.0) -> np.ndarray:
    """Dim light with one round lamp, a Gaussian of the angle, at fractional texels of a 16 x 32 map."""
    cosine = environment_directions(*SHAPE) @ direction(row, column)
    apart = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    shape = np.exp(-np.square(apart / width_deg) / 2)
    return (0.1 + radiance * shape[..., None] * np.ones(3)).astype(np.float32)


def direction(row: float, column: float) -> np.ndarray:
    theta, phi = math.pi * row / (SHAPE[0] - 1), 2 * math.pi * (column + 0.5) / SHAPE[1]
    return np.array([math.sin(theta) * math.sin(phi), math.cos(theta), -math.sin(theta) * math.cos(phi)])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip(a @ b, -1, 1)))


def test_scale_is_free_and_colour_is_not() -> None:
    true = 2 + environment(3)  # bright against the epsilon of the logarithm
    assert scaled_log_rmse(7.3 * true, true) < 1e-4
    assert max(scaled_log_rmse(k * true, true) for k in (0.02, 1e-7, 1e7)) < 1e-4
    tinted = true * np.array([2.0, 1.0, 0.5], np.float32)
    assert scaled_log_rmse(tinted, true) == pytest.approx(math.log(2) * math.sqrt(2 / 3), rel=0.02)


def test_the_best_scale_is_the_best() -> None:
    """No factor of a dense grid does better, nor does the least-squares factor, which follows the brightest texel."""
    found, true = environment(4), environment(5)
    w = texel_solid_angles(*SHAPE)[..., None]
    best = scaled_log_rmse(found, true)
    factors = np.geomspace(1e-3, 1e3, 2001)
    dense = min(metrics.log_rmse((found * k).astype(np.float32), true, w) for k in factors)
    assert best == pytest.approx(dense, rel=1e-4)
    assert best <= metrics.log_rmse(metrics.align_scale(found, true, w, "aligned"), true, w)


@pytest.mark.parametrize(("row", "column"), [(7.5, 3.0), (4.3, 31.6), (1.0, 12.0), (11.2, 20.4)])
def test_the_lamp_is_found_between_texels_too(row: float, column: float) -> None:
    found = brightest_direction(lamp(row, column))
    assert found is not None
    assert angle(found, direction(row, column)) < 2.5


def test_angle_is_that_of_the_turn() -> None:
    """A quarter of the equator is a quarter; a mirrored light is caught."""
    light = lamp(7.5, 8.0)
    assert peak_angle_deg(light, light) == pytest.approx(0, abs=1e-6)
    assert peak_angle_deg(np.roll(light, 8, axis=1), light) == pytest.approx(90, abs=2)
    a = math.radians(35)
    turn = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]], np.float32)
    # Either lamp is found within 2.5 degrees (above); of cones that hold as much of it, rounding chooses.
    assert peak_angle_deg(rotate_environment(lamp(7.5, 15.5), turn), lamp(7.5, 15.5)) == pytest.approx(35, abs=5)
    assert peak_angle_deg(light[:, ::-1].copy(), light) > 80


def test_a_lamp_counts_by_the_light_in_its_cone() -> None:
    """One hot texel against a larger lamp of less radiance and more light; a whole polar row against a smaller lamp of
    more: solid angles count, not texels."""
    wide = lamp(7.5, 8.0, width_deg=16.0, radiance=5.0)
    wide[8, 24] = 7.0
    found = brightest_direction(wide)
    assert found is not None
    assert angle(found, direction(7.5, 8.0)) < 5
    pole = np.full((*SHAPE, 3), 0.1, np.float32)
    pole[0], pole[6:9, 8:11] = 3.0, 4.0
    found = brightest_direction(pole)
    assert found is not None
    assert angle(found, direction(7, 9)) < 5


def test_the_brightest_direction_is_by_luminance_in_a_cone_of_10_degrees() -> None:
    """Red of 10 against blue of 20; one lamp against two that are 24 degrees apart, each of two thirds of it."""
    for lamps, brightest in (
        (((20, (10, 0, 0)), (60, (0, 0, 20))), 20),
        (((20, (0, 0, 20)), (60, (0, 4, 0))), 60),
        (((20, (1, 1, 1)), (26, (1, 1, 1)), (60, (1.5, 1.5, 1.5))), 60),
    ):
        light = np.zeros((46, 90, 3), np.float32)
        for column, colour in lamps:
            light[22, column] = colour
        found = brightest_direction(light)
        assert found is not None
        assert angle(found, environment_directions(46, 90)[22, brightest]) < 2


def test_the_balls_are_scored_against_those_of_the_true_light() -> None:
    """In parts of the true one: the wrong way round, an error would count as many times less."""
    found, true = (Intrinsics(environment=light) for light in (3 * environment(4), environment(5)))
    values = score_light(found, true)
    expected = ball_values(found.require("environment")["environment"], true.require("environment")["environment"])
    assert expected.items() <= values.items()


def test_a_light_that_is_not_there_has_no_scores_and_ringing_counts_as_black() -> None:
    true, none = Intrinsics(environment=environment(5)), Intrinsics()
    assert (
        score_light(None, true) == score_light(none, true) == score_light(true, none) == score_light(true, None) == {}
    )
    found, ringing = lamp(7.5, 8.0), lamp(7.5, 8.0)
    found[0], ringing[0] = 0, -5e-4
    scores = [score_light(Intrinsics(environment=light), true) for light in (ringing, found)]
    assert scores[0] == scores[1]


def test_a_uniform_light_has_no_direction() -> None:
    uniform = np.full((*SHAPE, 3), 0.3, np.float32)
    assert brightest_direction(uniform) is None
    assert peak_angle_deg(uniform, lamp(7.5, 8.0)) == 90.0


def test_resolutions_are_brought_together() -> None:
    light = environment(6, (64, 128), peaks=2)
    small = resample_environment(light, SHAPE)
    values = light_values(3 * small, light)
    assert values["environment.log_rmse_scaled"] < 0.01
    assert values["environment.peak_deg"] < 0.1
    assert light_values(environment(7), light)["environment.log_rmse_scaled"] > 0.1


def test_a_black_light_is_refused() -> None:
    """And one so dim that the factor which makes it the true one is no float32."""
    for radiance in (0, 1e-38):
        with pytest.raises(UnirenderError, match="the found light is black"):
            light_values(np.full((*SHAPE, 3), radiance, np.float32), lamp(7.5, 8.0))


def test_no_angle_is_taken_from_a_light_without_direction() -> None:
    around, aside = (Intrinsics(environment=light) for light in (np.ones((*SHAPE, 3)), lamp(7.5, 8.0)))
    assert "environment.peak_deg" not in score_light(aside, around)
    assert score_light(around, aside)["environment.peak_deg"] == 90


def test_a_light_that_is_the_same_all_around_has_no_direction() -> None:
    """And one with a broad lamp, or with two alike, has one: its own, exactly."""
    rows = np.linspace(2, 0.1, SHAPE[0], dtype=np.float32)
    around = np.broadcast_to(rows[:, None, None], (*SHAPE, 3)).copy()
    assert brightest_direction(around) is None
    assert peak_angle_deg(around, lamp(7.5, 8.0)) == 90
    for light in (lamp(7.5, 8.0, width_deg=40), lamp(7.5, 8.0) + lamp(7.5, 24.0)):
        assert peak_angle_deg(light, light) == 0
