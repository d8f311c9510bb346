"""The network of shadows: its bins and windows, and what the one that ships says of shapes whose answer is known."""

import math

import numpy as np
import torch
from seen_shapes import CAMERA, as_maps, ball, gutter

from unirender.light.lobes import texel_directions
from unirender.models.visibility import (
    AZIMUTHS,
    BANDS,
    BINS,
    CLASSES,
    MARGIN,
    VisibilityNet,
    at_pixels,
    bin_weights,
    direction_bins,
    hidden_chance,
    net_input,
)
from unirender.pipelines.self_shadow import SelfShadow

DIRECTIONS = texel_directions((64, 128))


def test_bins_turn_with_the_directions() -> None:
    x, y, z = DIRECTIONS
    bins = direction_bins(DIRECTIONS)
    assert sorted(set(bins)) == list(range(BINS))
    turned = direction_bins(np.stack([-y, x, z]))
    assert np.array_equal(turned // AZIMUTHS, bins // AZIMUTHS)
    off_border = np.abs((np.arctan2(y, x) / (2 * math.pi) * AZIMUTHS + 0.5) % 1 - 0.5) > 1e-3
    assert np.array_equal((bins + AZIMUTHS // 4)[off_border] % AZIMUTHS, turned[off_border] % AZIMUTHS)
    towards_viewer, away = np.array([[0.01], [0.01], [1]]), np.array([[0.01], [0.01], [-1]])
    assert direction_bins(towards_viewer)[0] // AZIMUTHS == 0
    assert direction_bins(away)[0] // AZIMUTHS == BANDS - 1


def test_the_cosine_is_integrated_over_all_bins() -> None:
    """Over the hemisphere it is pi; a texel is worth its solid angle."""
    rng = np.random.default_rng(0)
    n = rng.normal(size=(20, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    classes = rng.integers(len(CLASSES), size=(20, DIRECTIONS.shape[1]))
    weight = bin_weights(np.maximum(n @ DIRECTIONS, 0), classes, DIRECTIONS)
    assert weight.shape == (20, len(CLASSES), BINS)
    texel = 4 * math.pi / DIRECTIONS.shape[1]
    np.testing.assert_allclose(weight.sum(axis=(1, 2)) * texel, math.pi, rtol=0.02)
    band = np.arccos(n[:, 2] / 1) < 0.2
    assert np.abs(weight.sum(axis=1)[band].reshape(-1, BANDS, AZIMUTHS)[:, -1]).max(initial=0) < 1e-3


def scene(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, depth and weights of a surface, all different."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(*surface.shape, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    weight = rng.random((int(surface.sum()), len(CLASSES), BINS)).astype(np.float32)
    return normal, 1 + rng.random(surface.shape), weight


def test_a_window_shows_each_pixel_what_is_its_own() -> None:
    surface = np.zeros((50, 61), bool)  # sides that the network cannot halve
    surface[3:20, 40:61] = surface[30, 45] = True
    normal, depth, weight = scene(surface)
    x, window = net_input(normal, surface, depth, weight)
    assert all(side % 8 == 0 for side in x.shape[1:])
    assert window[0].start == 0
    assert window[1].start <= 40 - MARGIN + 7
    found = at_pixels(x, surface, window)
    np.testing.assert_array_equal(found[:, :3], normal[surface])
    assert (found[:, 3] == 1).all()
    total = weight.sum(axis=1)
    np.testing.assert_allclose(found[:, 5 : 5 + BINS], weight[:, 0] / total, rtol=1e-4)
    np.testing.assert_allclose(found[:, 5 + BINS :], weight[:, 1] / total, rtol=1e-4)
    assert x[3].sum() == surface.sum()
    x_deeper, _ = net_input(normal, surface, 7 * depth, weight)
    np.testing.assert_allclose(x_deeper[4], x[4], atol=1e-4)  # depth is known up to a factor


def test_an_untrained_network_says_what_is_usual_of_each_class() -> None:
    surface = np.zeros((16, 16), bool)
    surface[4:12, 4:12] = True
    normal, depth, weight = scene(surface)
    x, window = net_input(normal, surface, depth, weight)
    with torch.no_grad():
        chance = at_pixels(VisibilityNet()(torch.from_numpy(x)[None])[0].sigmoid(), surface, window)
    means = chance.reshape(-1, len(CLASSES), BINS).mean(dim=(0, 2))
    assert means[0] > means[1] > means[2] > 0


def chances(normal: np.ndarray, mask: np.ndarray) -> tuple[SelfShadow, np.ndarray, np.ndarray]:
    """What is seen of a surface, what share of its sky is hidden, and how likely each class and bin is."""
    shadow = SelfShadow.of(normal, mask, CAMERA)
    n = normal[shadow.where]
    directions = texel_directions((16, 32))
    weight = np.concatenate(
        [
            bin_weights(np.maximum(n[part] @ directions, 0), shadow.classes(part, directions), directions)
            for part in shadow.parts(directions.shape[1])
        ]
    )
    chance = hidden_chance(normal, shadow.where, shadow.depth, weight)
    return shadow, (weight * chance).sum(axis=(1, 2)) / weight.sum(axis=(1, 2)), chance


def test_a_ball_hides_next_to_nothing_and_a_gutter_what_it_must() -> None:
    shadow, sky, chance = chances(*ball(64)[:2])
    assert chance.shape == (shadow.where.sum(), len(CLASSES), BINS)
    assert 0 < chance.min() <= chance.max() < 1
    assert sky.mean() < 0.02
    normal, mask, _ = gutter(64)
    shadow, sky, _ = chances(normal, mask)
    picture = np.zeros(shadow.where.shape)
    picture[shadow.where] = sky
    middle = picture[24:40]
    assert middle[:, 28:36].mean() > middle[:, 8:16].mean() > 0.03
    assert 0.1 < middle[:, 28:36].mean() < 0.6


def test_the_answer_turns_with_the_picture() -> None:
    """It learned that from examples: what it says of a turned picture is nearly what it says of the picture."""
    maps = as_maps(*gutter(48)[:2]).require("normal", "mask")
    _, sky, _ = chances(maps["normal"], maps["mask"])
    n = np.rot90(maps["normal"])
    turned = np.ascontiguousarray(np.stack([-n[..., 1], n[..., 0], n[..., 2]], axis=-1))
    _, found, _ = chances(turned, np.ascontiguousarray(np.rot90(maps["mask"])))
    expected = np.rot90(sky.reshape(48, 48))
    assert np.abs(found.reshape(48, 48) - expected).mean() < 0.05
    assert np.abs(sky.reshape(48, 48) - expected).mean() > 0.05  # the twin
