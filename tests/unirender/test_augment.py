"""The augmentation functions by themselves: group laws, closed forms and errors."""

import numpy as np
import pytest
from synthetic_shards import sphere

from unirender.errors import UnirenderError
from unirender.lighting import diffuse_light, environment_directions
from unirender.training.augment import (
    from_maps,
    interpolate_metallic,
    mirror,
    mix_lights,
    permute_channels,
    quarter_turn,
    scale_light,
    to_maps,
    turn_rotation,
)


@pytest.fixture
def maps() -> dict[str, np.ndarray]:
    """A lopsided scene: no symmetry hides a mistake."""
    rng = np.random.default_rng(2)
    shape = sphere(16, rng)
    normal, mask = shape.require("normal", "mask").values()
    environment = rng.uniform(0, 2, (33, 64, 3)).astype(np.float32)
    environment *= 0.2 + np.maximum(environment_directions(33, 64) @ np.array([0.6, 0.5, 0.6]), 0)[..., None]
    environment[0], environment[-1] = environment[0].mean(axis=0), environment[-1].mean(axis=0)
    albedo = (rng.uniform(0, 1, (16, 16, 3)) * mask).astype(np.float32)
    diffuse = diffuse_light(normal, environment)
    intrinsics = shape.replace(
        albedo=albedo,
        roughness=mask * np.float32(0.3),
        metallic=mask * rng.uniform(0, 1, (16, 16, 1)).astype(np.float32),
        specular=diffuse[..., ::-1] * 0.5,
        diffuse=diffuse,
        environment=environment,
    )
    return to_maps(albedo * diffuse, intrinsics)


def equal(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def without_environment(maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: value for name, value in maps.items() if name != "environment"}


def test_maps_and_intrinsics_are_two_views_of_one_sample(maps: dict[str, np.ndarray]) -> None:
    assert equal(to_maps(*from_maps(maps)), maps)


def test_mirror_is_an_involution(maps: dict[str, np.ndarray]) -> None:
    assert equal(mirror(mirror(maps)), maps)
    assert not any(np.array_equal(mirror(maps)[name], maps[name]) for name in ("image", "albedo", "environment"))


def test_four_quarter_turns_are_the_identity(maps: dict[str, np.ndarray]) -> None:
    turned = without_environment(maps)
    for _ in range(4):
        turned = quarter_turn(turned, 1)
    assert equal(turned, without_environment(maps))
    assert equal(quarter_turn(turned, 4), turned)


@pytest.mark.parametrize("turns", [2, 3, 5, -1])
def test_turns_add_up(maps: dict[str, np.ndarray], turns: int) -> None:
    once = without_environment(maps)
    for _ in range(turns % 4):
        once = quarter_turn(once, 1)
    assert equal(quarter_turn(without_environment(maps), turns), once)


def test_mirror_reverses_a_turn(maps: dict[str, np.ndarray]) -> None:
    flat = without_environment(maps)
    assert equal(mirror(quarter_turn(flat, 1)), quarter_turn(mirror(flat), 3))
    assert not equal(mirror(quarter_turn(flat, 1)), quarter_turn(mirror(flat), 1))


def test_a_permutation_has_its_inverse(maps: dict[str, np.ndarray]) -> None:
    order = (1, 2, 0)
    inverse = tuple(int(i) for i in np.argsort(order))
    permuted = permute_channels(maps, order)
    assert equal(permute_channels(permuted, inverse), maps)  # pyright: ignore[reportArgumentType] - argsort gives three of them
    assert not equal(permute_channels(permuted, order), maps)
    for name in ("normal", "roughness", "metallic", "mask"):
        assert np.array_equal(permuted[name], maps[name])


def test_a_turn_takes_right_to_up(maps: dict[str, np.ndarray]) -> None:
    """Counter-clockwise for the viewer: the right edge of the ball, normal +x, becomes its top, normal +y."""
    turned = quarter_turn(maps, 1)
    right, top = maps["normal"][8, -3], turned["normal"][2, 8]
    assert right[0] > 0.7
    np.testing.assert_array_equal(top, [-right[1], right[0], right[2]])
    np.testing.assert_array_equal(turned["image"][2, 8], maps["image"][8, -3])
    np.testing.assert_allclose(turn_rotation(1) @ [1, 0, 0], [0, 1, 0], atol=1e-7)


@pytest.mark.parametrize("change", [lambda m: quarter_turn(m, 1), lambda m: quarter_turn(m, 2), mirror])
def test_normals_and_environment_move_together(maps: dict[str, np.ndarray], change) -> None:
    """The light arriving along each normal, and d, stay with their pixel."""
    changed = change(maps)
    pixel = change({"diffuse": maps["diffuse"]})["diffuse"]
    again = diffuse_light(changed["normal"], changed["environment"])
    np.testing.assert_allclose(again, pixel, atol=0.02)
    left = diffuse_light(change({"mask": maps["normal"]})["mask"], changed["environment"])  # normals moved, not turned
    assert np.abs(left - pixel).max() > 5 * 0.02


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


@pytest.mark.parametrize("weights", [-np.ones((2, 3)), np.full((2, 3), np.nan), np.ones((3, 3)), np.ones((2, 1))])
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


def test_wrong_frames_and_orders_are_refused() -> None:
    with pytest.raises(UnirenderError, match="square"):
        quarter_turn({"image": np.ones((4, 6, 3), np.float32)}, 1)
    with pytest.raises(UnirenderError, match="permutation"):
        permute_channels({"image": np.ones((4, 4, 3), np.float32)}, (0, 0, 2))
