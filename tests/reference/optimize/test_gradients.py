"""Mitsuba's derivatives as the optimiser uses them, against central differences of its pictures.

A loss here is L = sum(W * picture) with fixed random weights W: linear, so that Monte Carlo noise does not bias it.
Both derivatives along a direction are estimated with several seeds. They agree if their means differ by at most
`TOLERANCE` of the central difference and three standard errors; every estimate has to be sharp enough to tell.
"""

from collections.abc import Callable

import numpy as np
import pytest
import refine_problems as problems

from unirender_reference.optimize.refine.parameters import NAMES, Name
from unirender_reference.optimize.refine.scene import TexturedScene, maps_of

TOLERANCE = 0.03  # of the central difference; of the curvature over the step, and of float32
SHARP = 0.03  # standard error of either estimate, of the central difference
SEEDS = 6


def compare(central: np.ndarray, derived: np.ndarray, tolerance: float = TOLERANCE) -> tuple[bool, str]:
    """Whether two samples of a derivative have the same mean, and the figures."""
    mean, other = central.mean(), derived.mean()
    error = np.hypot(central.std(ddof=1), derived.std(ddof=1)) / np.sqrt(len(central))
    text = f"central difference {mean:.5g}, derivative {other:.5g}, standard error {error:.2g}"
    assert error < SHARP * abs(mean), f"too noisy to tell: {text}"
    return bool(abs(mean - other) <= tolerance * abs(mean) + 3 * error), text


def sampled(estimate: Callable[[int], float]) -> np.ndarray:
    return np.array([estimate(seed) for seed in range(SEEDS)])


def weights(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform(0.2, 1, (count, problems.SIDE, problems.SIDE, 3)).astype(np.float32)


def direction_of(name: Name, shape: tuple[int, ...]) -> tuple[np.ndarray, float]:
    """Where to and how far a parameter moves."""
    rng = np.random.default_rng(5)
    if name == "environment":  # one texel of the first column, which the emitter stores twice
        move = np.zeros(shape, np.float32)
        move[2, 0] = 1
        return move, 0.3
    return rng.uniform(0.3, 1, shape).astype(np.float32), 0.04


@pytest.fixture(scope="module")
def scene() -> TexturedScene:
    return TexturedScene(problems.solution(), problems.blank_views(2), depth=3)


def central_difference(scene: TexturedScene, name: Name, move: np.ndarray, step: float, spp: int) -> np.ndarray:
    maps, weight = maps_of(problems.solution()), weights(scene.count)

    def at(scale: float, seed: int) -> float:
        images = scene.image({**maps, name: maps[name] + scale * move}, spp, seed)
        return float((images[..., :3].astype(np.float64) * weight).sum())

    return sampled(lambda seed: (at(step, seed) - at(-step, seed)) / (2 * step))


@pytest.fixture(scope="module")
def gradients(scene: TexturedScene) -> list[dict[str, np.ndarray]]:
    """Derivatives with respect to textures and light, of each seed."""
    maps = maps_of(problems.solution())
    return [scene.gradients(maps, weights(2), 256, 100 + seed) for seed in range(SEEDS)]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_textures_and_light_agree_with_central_differences(
    scene: TexturedScene, gradients: list[dict[str, np.ndarray]], name: Name
) -> None:
    move, step = direction_of(name, gradients[0][name].shape)
    central = central_difference(scene, name, move, step, spp=512)
    estimates = sampled(lambda seed: float((gradients[seed][name].astype(np.float64) * move).sum()))
    agree, text = compare(central, estimates)
    assert agree, text
    twin, _ = compare(central, 1.15 * estimates)
    assert not twin, f"a derivative that is 15 % off passes, too: {text}"


def test_different_samples_remove_the_bias_of_a_squared_error(scene: TexturedScene) -> None:
    """E[2 (x - t) dx] is not 2 (E[x] - t) E[dx] if x and dx share their noise. Here dx is along the light itself."""
    maps, target, seeds = maps_of(problems.solution()), 0.25, 16
    image = scene.image(maps, 1024, 7)[..., :3].astype(np.float64)
    expected = float((2 * (image - target) * image).sum())  # the picture is linear in the light

    def derived(seed: int, other: int) -> float:
        images = scene.image(maps, 1, seed)[..., :3]
        found = scene.gradients(maps, 2 * (images - target), 1, other)["environment"]
        return float((found.astype(np.float64) * maps["environment"]).sum())

    apart = np.array([derived(seed, 1000 + seed) for seed in range(seeds)])
    same = np.array([derived(seed, seed) for seed in range(seeds)])
    scores = [(found.mean() - expected) / (found.std(ddof=1) / np.sqrt(seeds)) for found in (apart, same)]
    assert abs(scores[0]) < 3.5, f"expected {expected:.4g}, got {apart.mean():.4g}, {scores[0]:.1f} standard errors"
    assert abs(scores[1]) > 7, f"equal samples: expected {expected:.4g}, got {same.mean():.4g}, no bias found"
