"""Each augmentation of the training data against a Mitsuba render of the augmented scene: z-tests, failing twins."""

import dataclasses

import numpy as np
import pytest
from lopsided_scene import ALBEDO, KEY, RIM, light, lopsided_object

from unirender.light.symmetries import Maps, mirror, permute_channels, quarter_turn, turn_rotation
from unirender.training.augmentations.augment import METALLIC_NODES, interpolate_metallic, mix_lights
from unirender_reference.passes import Estimate
from unirender_reference.render import Renderer
from unirender_reference.statistics import ZTest, z_test

pytestmark = pytest.mark.long  # test_augmentation_chain.py has all of them at once
SIZE = 24
SPP = 1024
ROUGHNESS = 0.4
ALPHA = 1e-3  # chance of a false alarm, of each of sixteen z-tests
BUFFERS = ("image", "diffuse", "specular")


def _rgb(image: Estimate) -> Estimate:
    assert image.variance is not None
    return dataclasses.replace(image, mean=image.mean[..., :3], variance=image.variance[..., :3])


def render(renderer: Renderer, environment: np.ndarray, seed: int, metallic: float = 0.5) -> dict[str, Estimate]:
    return {
        "image": _rgb(renderer.image(environment, ROUGHNESS, metallic, SPP, seed)),
        "diffuse": renderer.diffuse(environment, SPP, seed),
        "specular": renderer.specular(environment, ROUGHNESS, SPP, seed),
    }


def means(estimates: dict[str, Estimate], renderer: Renderer) -> Maps:
    """The buffers and the geometry."""
    geometry = renderer.geometry(1024, seed=4).require("albedo", "normal", "mask")
    return {name: estimate.mean for name, estimate in estimates.items()} | geometry


def variances(estimates: dict[str, Estimate]) -> Maps:
    return {name: np.asarray(estimate.variance) for name, estimate in estimates.items()}


def same(mean: np.ndarray, variance: np.ndarray, truth: Estimate, mask: np.ndarray) -> ZTest:
    """z-test over the pixels covered by half or more: s and d are ratios, which have no variance at a grazed pixel."""
    return z_test(mean, variance, truth.mean, np.asarray(truth.variance), mask, alpha=ALPHA)


def compare(mean: Maps, variance: Maps, truth: dict[str, Estimate]) -> dict[str, ZTest]:
    """z-tests of the augmented buffers against renders of the augmented scene; `mean` has the mask too."""
    return {name: same(mean[name], variance[name], truth[name], mean["mask"]) for name in BUFFERS}


def assert_same(results: dict[str, ZTest]) -> None:
    assert all(result.passed for result in results.values()), {n: str(r) for n, r in results.items()}


def assert_different(results: dict[str, ZTest]) -> None:
    assert not any(result.passed for result in results.values()), {n: str(r) for n, r in results.items()}


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(lopsided_object(), resolution=SIZE)


@pytest.fixture(scope="module")
def key(renderer: Renderer) -> dict[str, Estimate]:
    """The scene that is augmented, under its key light."""
    return render(renderer, KEY, seed=1)


def test_mixture_of_tinted_lights(renderer: Renderer, key: dict[str, Estimate]) -> None:
    weights = np.array([[0.5, 0.7, 1.1], [0.9, 0.6, 0.2]], np.float32)
    rim = render(renderer, RIM, seed=2)
    truth = render(renderer, mix_lights({"environment": np.stack([KEY, RIM])}, weights)["environment"], seed=3)

    def mixed(w: np.ndarray) -> tuple[Maps, Maps]:
        stacks = {name: np.stack([key[name].mean, rim[name].mean]) for name in BUFFERS}
        spread = {name: np.stack([variances(key)[name], variances(rim)[name]]) for name in BUFFERS}
        return mix_lights(means(key, renderer) | stacks, w), mix_lights(spread, w**2)

    assert_same(compare(*mixed(weights), truth))
    untinted = weights.copy()
    untinted[1] = untinted[1].mean()  # the tint on one light only
    assert_different(compare(*mixed(untinted), truth))


def test_metallic_between_the_nodes(renderer: Renderer) -> None:
    nodes = [_rgb(renderer.image(KEY, ROUGHNESS, m, 8 * SPP, seed=10 + i)) for i, m in enumerate(METALLIC_NODES)]
    truth = _rgb(renderer.image(KEY, ROUGHNESS, 0.3, 8 * SPP, seed=20))
    mask = renderer.geometry(1024, seed=4).require("mask")["mask"]
    means = np.stack([node.mean for node in nodes])
    variance = np.sum([w**2 * np.asarray(n.variance) for w, n in zip(_weights(0.3), nodes, strict=True)], axis=0)
    result = same(interpolate_metallic(means, 0.3), variance, truth, mask)
    assert result.passed, str(result)
    assert not same(interpolate_metallic(means, 0.25), variance, truth, mask).passed
    assert not same(0.7 * means[0] + 0.3 * means[2], variance, truth, mask).passed  # a line through two nodes


def _weights(metallic: float) -> list[float]:
    """The Lagrange weights, read off by interpolating unit pictures."""
    unit = np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1)
    return [float(w) for w in interpolate_metallic(unit, metallic).ravel()]


def test_channel_permutation(renderer: Renderer, key: dict[str, Estimate]) -> None:
    order = (2, 0, 1)
    permuted = Renderer(lopsided_object(albedo=ALBEDO[..., list(order)]), resolution=SIZE)
    truth = render(permuted, KEY[..., list(order)], seed=5)
    variance = permute_channels(variances(key), order)
    assert_same(compare(permute_channels(means(key, renderer), order), variance, truth))
    assert_different(compare(means(key, renderer), variance, truth))
    left = render(permuted, KEY, seed=6)  # the light's channels left as they were
    assert_different(compare(permute_channels(means(key, renderer), order), variance, left))


def geometry_errors(augmented: Maps, renderer: Renderer) -> dict[str, float]:
    """Mean absolute error of albedo, normal and mask over the pixels that both see whole."""
    truth = renderer.geometry(1024, seed=7).require("albedo", "normal", "mask")
    whole = (truth["mask"] > 0.999) & (augmented["mask"] > 0.999)
    return {
        n: float((np.abs(augmented[n] - truth[n]) * whole).sum() / whole.sum()) for n in ("albedo", "normal", "mask")
    }


@pytest.mark.parametrize(
    ("augment", "matrix"),
    [
        pytest.param(mirror, np.diag([-1.0, 1.0, 1.0]), id="mirror"),
        pytest.param(lambda maps: quarter_turn(maps, 1), turn_rotation(1).astype(float), id="turn 90"),
        pytest.param(lambda maps: quarter_turn(maps, 2), turn_rotation(2).astype(float), id="turn 180"),
    ],
)
def test_mirror_and_turns(renderer: Renderer, key: dict[str, Estimate], augment, matrix: np.ndarray) -> None:
    moved = Renderer(lopsided_object(matrix), resolution=SIZE)
    maps = means(key, renderer)
    augmented = augment(maps | {"environment": KEY})
    variance = augment(variances(key))

    # the whole chain: the render under the environment as augmented, of the object as moved
    assert_same(compare(augmented, variance, render(moved, augmented["environment"], seed=8)))
    np.testing.assert_allclose(augmented["environment"], light((0.8, 0.5, 0.6), (1.0, 0.6, 0.3), matrix), atol=0.01)
    errors = geometry_errors(augmented, moved)
    assert errors["albedo"] < 0.01, errors
    assert errors["normal"] < 0.01, errors

    # twins: the light left where it was; normals moved with their pixels but not turned
    assert_different(compare(augmented, variance, render(moved, KEY, seed=9)))
    unturned = augment({"albedo": maps["normal"]})
    assert geometry_errors(augmented | {"normal": unturned["albedo"]}, moved)["normal"] > 0.1
