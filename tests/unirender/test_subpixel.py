"""Normals inside a pixel: means kept, edges kept apart, gaps continued; and the lookup that reads the light there."""

import numpy as np
from environments import random_directions, smooth_environment

from unirender.light.environment import sample_environment
from unirender.light.ggx import halton
from unirender.light.lobes import MipPyramid
from unirender.light.subpixel import MEAN_WEIGHTS, Surroundings, inside

EVERY = slice(None)


def ridge() -> np.ndarray:
    """Normals of a rounded edge one pixel wide: flat, half way, flat."""
    angle = np.array([-0.4, -0.4, -0.4, 0.0, 0.4, 0.4, 0.4])
    row = np.stack([np.sin(angle), np.zeros(7), np.cos(angle)], axis=-1)
    return np.repeat(row[None], 5, axis=0).astype(np.float32)


def turned(vectors: np.ndarray) -> np.ndarray:
    """The angle about the vertical."""
    return np.arctan2(vectors[0], vectors[2])


def test_means_over_pixels_are_kept_and_the_edge_is_sharpened() -> None:
    normal = ridge()
    around = Surroundings(normal, np.ones((5, 7), bool)).of(EVERY)
    x, y, *_ = halton(64)
    mean = inside(around, x - np.float32(0.5), y - np.float32(0.5)).mean(axis=-1)
    np.testing.assert_allclose(mean, around @ MEAN_WEIGHTS, atol=0.01)
    error = np.abs(turned(mean).reshape(5, 7) - turned(np.moveaxis(normal, -1, 0))).max()
    plain = turned(np.moveaxis(normal, -1, 0))
    twin = np.abs((plain[:, :-2] + 6 * plain[:, 1:-1] + plain[:, 2:]) / 8 - plain[:, 1:-1]).max()
    assert error < 0.3 * twin, "without refinement the means of the bilinear interpolant are not the map's"


def test_a_gap_is_continued_and_a_smooth_map_is_read_as_it_is() -> None:
    angle = 0.05 * np.arange(6)
    normal = np.repeat(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)[None], 6, axis=0).astype(np.float32)
    there = np.ones((6, 6), bool)
    there[:, 3:] = False
    gap = Surroundings(normal * there[..., None], there)
    half = np.array([0.5], np.float32)
    edge = inside(gap.of(EVERY), half, 0 * half).reshape(3, 6, 3)[:, :, 2]
    np.testing.assert_allclose(turned(edge), 0.125, atol=0.003)
    view = gap.of_smooth(normal, EVERY).reshape(3, 6, 3, 9)
    np.testing.assert_allclose(turned(view[:, :, 2, 5]), 0.15, atol=1e-5)
    np.testing.assert_allclose(turned(view[:, :, 0, 3]), -0.05, atol=2e-3)


def test_beyond_an_end_that_leans_inwards_is_nothing_either() -> None:
    """The rim is continued into the gap, at its corners too; the map's next value is the zero of the background."""
    angle = -0.05 * np.arange(6) - 0.01 * np.arange(12)[:, None]
    normal = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1).astype(np.float32)
    there = np.ones((12, 6), bool)
    there[:, 3:] = False
    half = np.array([0.5], np.float32)
    around = Surroundings(normal * there[..., None], there).of(EVERY)
    edge = inside(around, half, 0 * half).reshape(3, 12, 3)[:, 2:-2, 2]
    np.testing.assert_allclose(np.linalg.norm(edge, axis=0), 1, atol=0.01)
    np.testing.assert_allclose(turned(edge), angle[2:-2, 2] - 0.025, atol=0.003)
    for row, beyond in ((-1, 2), (0, 5), (1, 8)):
        found = turned(around).reshape(12, 3, 9)[2:-2, 2, beyond]
        np.testing.assert_allclose(found, angle[2 + row : 10 + row, 3], atol=0.003)


def test_the_finest_level_is_the_map_and_coarser_ones_are_smoother() -> None:
    environment = (smooth_environment() + np.random.default_rng(2).random((32, 64, 3))).astype(np.float32)
    directions = random_directions(2000).astype(np.float32)
    pyramid = MipPyramid(environment)
    fine, coarse = (pyramid.sample(directions.T, np.full(2000, level, np.float32)) for level in (0, 2))
    np.testing.assert_allclose(fine, sample_environment(environment, directions), rtol=1e-4, atol=1e-4)
    assert coarse.std() < 0.97 * fine.std()
    between = pyramid.sample(directions.T, np.full(2000, 1.25, np.float32))
    one, two = (pyramid.sample(directions.T, np.full(2000, level, np.float32)) for level in (1, 2))
    np.testing.assert_allclose(between, 0.75 * one + 0.25 * two, rtol=1e-4)
    poles = np.array([[0, 1, 0], [0, -1, 0], [0, 0, -1], [-1e-9, 0, -1]], np.float32)
    np.testing.assert_allclose(
        pyramid.sample(poles.T, np.zeros(4, np.float32)), sample_environment(environment, poles), rtol=1e-3
    )
    below = pyramid.sample(poles[1:2].T, np.full(1, 99, np.float32))  # the last row of the coarsest level
    assert environment.min() < below.min() < below.max() < environment.max()


def test_some_pixels_have_the_surroundings_they_have_among_all() -> None:
    rng = np.random.default_rng(3)
    normal = rng.normal(0, 0.15, (12, 12, 3)).astype(np.float32) + np.array([0, 0, 1], np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    there, wanted = rng.random((12, 12)) < 0.9, np.zeros((12, 12), bool)
    wanted[5, 4:7] = wanted[0, 0] = True
    every, some = Surroundings(normal, there).of(EVERY), Surroundings(normal, there, wanted).of(EVERY)
    np.testing.assert_allclose(some, every[:, wanted[there]], atol=1e-6)
    alone = Surroundings(normal, there & wanted).of(EVERY)
    assert np.abs(some - alone).max() > 0.1
