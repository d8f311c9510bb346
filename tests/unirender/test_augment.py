"""The augmentation functions by themselves: group laws, closed forms and errors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from unirender.errors import UnirenderError
from unirender.light.symmetries import permute_channels, scale_light
from unirender.training.augmentations.augment import (
    DEFAULT_AUGMENTATION,
    draw,
    from_maps,
    interpolate_metallic,
    mix_lights,
    to_maps,
)


def equal(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def test_maps_and_intrinsics_are_two_views_of_one_sample(maps: dict[str, np.ndarray]) -> None:
    assert equal(to_maps(*from_maps(maps)), maps)


def test_a_permutation_has_its_inverse(maps: dict[str, np.ndarray]) -> None:
    order = (1, 2, 0)
    inverse = tuple(int(i) for i in np.argsort(order))
    permuted = permute_channels(maps, order)
    assert equal(permute_channels(permuted, inverse), maps)  # pyright: ignore[reportArgumentType] - argsort gives three of them
    assert not equal(permute_channels(permuted, order), maps)
    for name in ("normal", "roughness", "metallic", "mask"):
        assert np.array_equal(permuted[name], maps[name])


def test_mixing_is_the_weighted_sum(maps: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(0)
    lights = [scale_light(maps, factor) for factor in (1.0, 3.0)]
    stacked = maps | {
        name: np.stack([light[name] for light in lights]) for name in ("image", "specular", "diffuse", "environment")
    }
    weights = rng.uniform(0, 1, (2, 3)).astype(np.float32)
    mixed = mix_lights(stacked, weights)
    for name in ("image", "specular", "diffuse", "environment"):
        np.testing.assert_allclose(mixed[name], maps[name] * (weights[0] + 3 * weights[1]), rtol=1e-5)
    assert np.array_equal(mixed["albedo"], maps["albedo"])
    assert np.array_equal(stacked["image"][0], maps["image"])  # the inputs are not written to


@pytest.mark.parametrize(
    "weights", [np.array([[1, 1, 1], [1, -0.1, 1]]), np.full((2, 3), np.nan), np.ones((3, 3)), np.ones((2, 1))]
)
def test_bad_weights_are_refused(weights: np.ndarray) -> None:
    with pytest.raises(Exception, match=r"weights|lights") as caught:
        mix_lights({"image": np.ones((2, 4, 4, 3), np.float32)}, weights.astype(np.float32))
    assert isinstance(caught.value, UnirenderError) or "jaxtyping" in type(caught.value).__module__


def test_metallic_interpolation_is_exact_for_quadratics() -> None:
    a, b, c = np.random.default_rng(0).normal(size=(3, 5, 5, 3)).astype(np.float32)
    nodes = np.stack([a + b * m + c * m**2 for m in (0.0, 0.5, 1.0)])
    for m in (0.0, 0.1, 0.3, 0.5, 0.77, 1.0):
        np.testing.assert_allclose(interpolate_metallic(nodes, m), a + b * m + c * m**2, atol=1e-5)
    linear = nodes[0] * 0.4 + nodes[1] * 0.6  # between the two nearest nodes
    assert np.abs(linear - (a + b * 0.3 + c * 0.09)).max() > 1e-2
    with pytest.raises(UnirenderError, match="metallic"):
        interpolate_metallic(nodes, 1.1)


def test_draws_fill_the_ranges_that_are_stated_and_no_more() -> None:
    rng, config = np.random.default_rng(0), replace(DEFAULT_AUGMENTATION, move=1.0)
    draws = [draw(rng, config, 4, 3) for _ in range(2000)]
    moves = [one.move for one in draws if one.move is not None]
    assert len(moves) == len(draws)
    for found, most in (
        ([math.degrees(move.roll) for move in moves], 25),
        ([math.log(move.zoom) for move in moves], 0.18),
        ([move.shift[0] for move in moves], 0.06),
        ([move.shift[1] for move in moves], 0.06),
    ):
        assert -most <= min(found) < -0.98 * most
        assert 0.98 * most < max(found) <= most
    metallic = np.array([one.metallic for one in draws])
    assert (metallic.min(), metallic.max()) == (0, 1)
    for end in (0, 1):
        assert 0.03 < (metallic == end).mean() < 0.06  # 5 of 110
    assert {one.roughness_index for one in draws} == {0, 1, 2}
    np.testing.assert_allclose(np.mean([one.weights.sum(axis=0) for one in draws], axis=0), 1, atol=0.1)


def test_wrong_orders_are_refused() -> None:
    with pytest.raises(UnirenderError, match="permutation"):
        permute_channels({"image": np.ones((4, 4, 3), np.float32)}, (0, 0, 2))
