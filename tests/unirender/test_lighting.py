"""Environment maps: their grid, orientation and energy."""

import math

import numpy as np
import pytest
from environments import random_directions, smooth_environment

from unirender.light.environment import (
    environment_directions,
    mean_radiance,
    mirror_environment,
    rotate_environment,
    sample_environment,
    texel_solid_angles,
)
from unirender.light.resampling import area_pixels, resample_environment

RNG = np.random.default_rng(3)


def test_solid_angles_sum_to_the_sphere() -> None:
    assert texel_solid_angles(16, 32).sum() == pytest.approx(4 * np.pi, rel=1e-6)


def test_named_directions() -> None:
    d = environment_directions(17, 32)
    np.testing.assert_allclose(d[0], np.broadcast_to([0, 1, 0], (32, 3)), rtol=0, atol=1e-6)  # first row: up
    np.testing.assert_allclose(d[8, 15] + d[8, 16], [0, 0, 2], rtol=0, atol=1e-2)  # the middle: behind the camera
    assert d[8, 8, 0] > 0.99  # a quarter: right


def test_texels_are_read_back_at_their_directions() -> None:
    environment = RNG.random((9, 12, 3), dtype=np.float32)
    inner = sample_environment(environment, environment_directions(9, 12))[1:-1]
    np.testing.assert_allclose(inner, environment[1:-1], rtol=0, atol=1e-5)


def test_mean_radiance_is_the_integral_of_the_interpolant() -> None:
    environment = RNG.random((6, 8, 3), dtype=np.float32)
    samples = sample_environment(environment, random_directions(400_000))
    np.testing.assert_allclose(mean_radiance(environment), samples.mean(axis=0), rtol=0, atol=3e-3)


@pytest.mark.parametrize("shape", [(16, 32), (9, 40), (4, 8), (64, 16)])
def test_shrinking_keeps_the_energy(shape: tuple[int, int]) -> None:
    environment = RNG.random((64, 128, 3), dtype=np.float32) ** 8
    small = resample_environment(environment, shape)
    assert small.shape == (*shape, 3)
    np.testing.assert_allclose(mean_radiance(small), mean_radiance(environment), rtol=2e-3)


def test_shrinking_twin_plain_pooling_does_not_keep_it() -> None:
    environment = np.zeros((64, 128, 3), dtype=np.float32)
    environment[3, 5] = 100.0
    pooled = environment.reshape(16, 4, 32, 4, 3).mean(axis=(1, 3))
    assert not np.allclose(mean_radiance(pooled), mean_radiance(environment), rtol=0.1)


@pytest.mark.parametrize(("height", "finer"), [(16, 4), (128, 2), (200, 1)])
def test_pixels_that_are_areas_have_the_energy_of_a_lamp(height: int, finer: int) -> None:
    """At their centres alone, a lamp in the first row was 1 % (16 rows) to 49 % (200) too bright."""
    borders = np.cos(np.arange(finer * height + 1) * np.pi / (finer * height))
    shares = -np.diff(borders)[:, None, None] / 2
    np.testing.assert_allclose(area_pixels(np.ones((height, 2 * height, 3), np.float32), finer), 1, rtol=1e-5)
    for row, column in ((0, 0), (1, 7), (height // 2, 2 * height - 1), (height - 1, 3)):
        lamp = np.zeros((height, 2 * height, 3), np.float32)
        lamp[row, column] = 1000
        seen = (area_pixels(lamp, finer) * shares).sum(axis=0).mean(axis=0)
        np.testing.assert_allclose(seen, mean_radiance(lamp), rtol=0.003)


def test_a_side_that_stays_is_not_blurred() -> None:
    lamp = np.zeros((17, 32, 3), dtype=np.float32)
    lamp[8, 5] = 1
    assert not np.delete(resample_environment(lamp, (9, 32)), 5, axis=1).any()
    assert not np.delete(resample_environment(lamp, (17, 16)), 8, axis=0).any()


def test_growing_reads_the_same_radiance() -> None:
    environment = smooth_environment(9, 16)
    grown = resample_environment(environment, (33, 64))
    d = random_directions(2000)
    error = sample_environment(grown, d) - sample_environment(environment, d)
    assert np.abs(error).max() < 0.04  # the knots of the two interpolants do not coincide
    assert np.abs(error).mean() < 0.003


def test_quarter_turns_about_each_axis_and_back() -> None:
    environment = smooth_environment()
    rotation = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=np.float32)  # +x -> +y
    turned = rotate_environment(environment, rotation)
    d = random_directions(500)
    error = sample_environment(turned, d @ rotation.T) - sample_environment(environment, d)
    assert np.abs(error).max() < 0.02
    wrong = sample_environment(turned, d @ rotation) - sample_environment(environment, d)
    assert np.abs(wrong).max() > 0.3  # the inverse turn is told apart


def test_mirror_flips_x() -> None:
    environment = RNG.random((8, 16, 3), dtype=np.float32)
    d = random_directions(500)
    flipped = d * np.array([-1, 1, 1], dtype=np.float32)
    np.testing.assert_allclose(
        sample_environment(mirror_environment(environment), flipped), sample_environment(environment, d), atol=1e-4
    )


@pytest.mark.parametrize("shape", [(20, 40), (31, 62), (13, 26)])
def test_growing_keeps_the_energy_of_a_lamp_wherever_it_stands(shape: tuple[int, int]) -> None:
    """Grids that do not lie on one another: samples of a lamp would say up to 13 % more or less than it has."""
    for row, column in ((1, 5), (shape[0] // 3, 3), (shape[0] // 3 + 1, 4), (shape[0] // 2, 7)):
        lamp = np.full((*shape, 3), 0.02, dtype=np.float32)
        lamp[row, column] = 50
        grown = resample_environment(lamp, (32, 64))
        np.testing.assert_allclose(mean_radiance(grown), mean_radiance(lamp), rtol=0.002, atol=0)
        np.testing.assert_allclose(resample_environment(np.ones_like(lamp), (32, 64)), 1, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("row", "most"), [(0, 0.05), (1, 0.012), (2, 0.005), (7, 0.005)])
def test_a_light_that_doubles_has_little_more_of_a_lamp_at_a_pole(row: int, most: float) -> None:
    lamp = np.zeros((16, 32, 3), np.float32)
    lamp[row, 5] = 50
    grown = resample_environment(lamp, (32, 64))
    np.testing.assert_allclose(mean_radiance(grown), mean_radiance(lamp), rtol=most, atol=0)


@pytest.mark.parametrize("height", [9, 14, 27])  # of some, the last row was turned by half
def test_a_turn_by_nothing_or_by_whole_columns_moves_no_texel(height: int) -> None:
    light = np.random.default_rng(3).random((height, 16, 3)).astype(np.float32)
    np.testing.assert_allclose(rotate_environment(light, np.eye(3)), light, atol=1e-5, rtol=0)
    cosine, sine = math.cos(3 * math.pi / 8), math.sin(3 * math.pi / 8)
    about_y = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    # What came from +z, the middle, comes from +x: u = 1/4, to the left.
    np.testing.assert_allclose(rotate_environment(light, about_y), np.roll(light, -3, axis=1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("texel", [(0, 3), (1, 0), (7, 31), (15, 9)])
def test_a_turn_about_the_vertical_keeps_the_energy_of_a_lamp(texel: tuple[int, int]) -> None:
    lamp = np.zeros((16, 32, 3), np.float32)
    lamp[texel] = 1000
    for turn_deg in (1.0, 11.25, 33.0, -123.4):
        c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turned = rotate_environment(lamp, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
        np.testing.assert_allclose(mean_radiance(turned), mean_radiance(lamp), rtol=1e-4)
