"""A flat albedo: even between its edges, which stay; patterns in colour stay; the closed form of the maps stays."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from tiny_models import make_pipeline

from unirender.color import image_srgb
from unirender.composite import composite_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.closure import MAX_GAIN
from unirender.pipelines.flat_albedo import flattened, patterned, with_flat_albedo
from unirender.pipelines.framing import Frame

SIZE = 64
LEFT, RIGHT = np.array([[0.6, 0.3, 0.2], [0.1, 0.2, 0.4]], np.float32)
Y, X = np.mgrid[0:SIZE, 0:SIZE]
MASK = (np.hypot(X - 31.5, Y - 31.5) < 26)[..., None].astype(np.float32)
GREY = np.full((SIZE, SIZE, 3), 0.3, np.float32)


def halves(size: int = SIZE) -> np.ndarray:
    """Two colours with an edge between them."""
    return np.where(np.arange(size)[None, :, None] < size // 2, LEFT, RIGHT) * np.ones((size, 1, 1), np.float32)


def shading(amplitude: float = 0.2, seed: int = 0) -> np.ndarray:
    """Detail in brightness alone."""
    noise = np.random.default_rng(seed).uniform(-1, 1, (SIZE, SIZE, 1))
    return np.exp(amplitude * noise).astype(np.float32)


def maps(albedo: np.ndarray, mask: np.ndarray = MASK) -> Intrinsics:
    size = len(mask)
    one = np.ones((size, size, 3), np.float32)
    metallic = np.full((size, size, 1), 0.3, np.float32)
    return Intrinsics(albedo=albedo * (mask > 0), metallic=metallic, specular=0.8 * one, diffuse=0.5 * one, mask=mask)


def rms(a: np.ndarray, b: np.ndarray, mask: np.ndarray = MASK) -> float:
    return float(np.sqrt((mask * np.square(a - b)).sum() / mask.sum() / 3))


def test_shading_leaves_the_albedo_and_its_edge_stays() -> None:
    true, inner = halves(), (np.hypot(X - 31.5, Y - 31.5) < 20)[..., None].astype(np.float32)
    seen = true * shading()
    flat = flattened(seen, np.clip(seen, 0, 1), MASK)
    assert rms(flat, true, inner) < 0.4 * rms(seen, true, inner)
    step = np.abs(flat[32, 34] - flat[32, 29])
    assert np.all(step > 0.7 * np.abs(LEFT - RIGHT))
    assert not flat[MASK[..., 0] == 0].any()


def test_a_pattern_in_colour_stays_and_one_in_brightness_goes() -> None:
    stripes = ((X // 2) % 2)[..., None]
    red, green = np.array([[0.5, 0.25, 0.2], [0.2, 0.45, 0.2]], np.float32)
    coloured, bright = (
        np.where(stripes, red, green).astype(np.float32),
        (GREY * np.where(stripes, 0.8, 1.2)).astype(np.float32),
    )
    moved = {name: rms(flattened(a, a, MASK), a) / a.std() for name, a in (("coloured", coloured), ("bright", bright))}
    assert moved["coloured"] < 0.2
    assert moved["bright"] > 0.3
    assert patterned(image_srgb(coloured), 1.0).mean() > 0.7
    assert patterned(image_srgb(bright), 1.0).max() < 1e-3


def test_what_the_albedo_loses_goes_into_the_light() -> None:
    before = maps(halves() * shading())
    picture = composite_image(before)
    after = with_flat_albedo(before, picture, Frame(SIZE, SIZE, SIZE))
    old, new = (x.require("albedo", "specular", "diffuse", "metallic", "mask") for x in (before, after))
    assert rms(new["albedo"], old["albedo"]) > 0.01
    assert rms(composite_image(after), picture) < 0.03 * rms(old["albedo"], new["albedo"])
    gains = [new[name] / old[name] for name in ("specular", "diffuse")]
    np.testing.assert_allclose(*gains, rtol=1e-5)
    assert all(np.all(gain[MASK[..., 0] == 0] == 1) for gain in gains)
    for name in ("metallic", "mask"):
        np.testing.assert_array_equal(old[name], new[name])


@pytest.mark.parametrize(("point", "ground", "gain"), [(0.0, 0.9, 1 / MAX_GAIN), (0.05, 0.0, MAX_GAIN)])
def test_the_light_of_a_point_that_goes_changes_within_bounds(point: float, ground: float, gain: float) -> None:
    """Of a black one nothing would be left of the ratio, and a bright one on black would make a lamp."""
    size = 2 * SIZE
    albedo = np.full((size, size, 3), ground, np.float32)
    albedo[SIZE, SIZE] = point
    before = maps(albedo, np.ones((size, size, 1), np.float32))
    before = before.replace(metallic=np.ones((size, size, 1), np.float32))
    after = with_flat_albedo(before, composite_image(before), Frame(size, size, size))
    for name in ("specular", "diffuse"):
        found = after.require(name)[name] / before.require(name)[name]
        np.testing.assert_allclose(found[SIZE, SIZE], gain, rtol=1e-6)


def test_an_even_albedo_stays_and_what_lies_outside_the_object_does_not_matter() -> None:
    even = np.ones((SIZE, SIZE, 1), np.float32) * LEFT
    np.testing.assert_allclose(flattened(even, even, MASK), even * MASK, atol=2e-4)
    seen, outside = halves() * shading(), np.random.default_rng(1).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    other = np.where(MASK > 0, seen, outside).astype(np.float32)
    first, second = (flattened(a, np.clip(a, 0, 1), MASK) for a in (seen, other))
    np.testing.assert_array_equal(first, second)


def test_detail_finer_than_the_networks_pixels_stays() -> None:
    size, checker = 4 * SIZE, np.indices((4 * SIZE, 4 * SIZE)).sum(axis=0) % 2
    mask = np.kron(MASK[..., 0], np.ones((4, 4), np.float32))[..., None]
    coarse = gaussian_filter(np.random.default_rng(0).normal(size=(size, size)), 6)
    true = halves(size) * np.where(checker, 1.1, 0.9)[..., None]
    before = maps((true * np.exp(0.15 * coarse / coarse.std())[..., None]).astype(np.float32), mask)
    after = with_flat_albedo(before, composite_image(before), Frame(size, size, SIZE))
    old, new = (x.require("albedo")["albedo"] for x in (before, after))
    assert rms(new, true, mask) < 0.8 * rms(old, true, mask)
    inside = new[96:160, 96:120]
    assert np.abs(np.diff(inside, axis=0)).mean() / inside.mean() == pytest.approx(0.2, rel=0.15)


def test_a_picture_is_taken_apart_with_it_and_without() -> None:
    pipeline = make_pipeline()
    size = pipeline.size_multiple * 2
    rng = np.random.default_rng(0)
    image = np.clip(0.4 + 0.2 * rng.uniform(-1, 1, (size, size, 1)) * np.ones(3), 0, 1).astype(np.float32)
    mask = np.ones((size, size, 1), np.float32)
    plain, flat = (pipeline.decompose(image, mask, flat=on).intrinsics for on in (False, True))
    first, second = (x.require("albedo", "normal", "roughness", "metallic") for x in (plain, flat))
    detail = [np.abs(np.diff(x["albedo"], axis=0)).mean() for x in (first, second)]
    assert detail[1] < 0.95 * detail[0]
    for name in ("normal", "roughness", "metallic"):
        np.testing.assert_array_equal(first[name], second[name])
    given = pipeline.decompose(image, mask, flat=True)
    edited = pipeline.edit(image, mask, metallic=1.0, decomposition=given, flat=True)
    np.testing.assert_array_equal(edited.image_linear, pipeline.edit(image, mask, metallic=1.0, flat=True).image_linear)
