"""What a hidden direction shows instead of the light."""

from collections.abc import Collection

import numpy as np
import pytest
from seen_shapes import SIZE, as_maps, ball, gutter

from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.bounced_light import AROUND, REFLECTED, WHITE_SKY, _mean_radiance, bounced_light
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.editing import under_light
from unirender.pipelines.rendered_maps import ready_to_render
from unirender.pipelines.shadowed_light import visible_shares

LIGHT = ("specular", "diffuse")
SKY = np.ones((16, 32, 3), np.float32)
MIDDLE = slice(SIZE // 4, -SIZE // 4)


def bounced(maps: Intrinsics, names: Collection[str]) -> dict[str, np.ndarray]:
    return bounced_light(maps, visible_shares(maps, WHITE_SKY, names))


def painted(normal: np.ndarray, mask: np.ndarray, albedo: float = 0.8, metallic: float = 0.0) -> Intrinsics:
    colour = (albedo * mask * np.array([1, 0.5, 0.25])).astype(np.float32)
    return as_maps(normal, mask).replace(albedo=colour, metallic=(metallic * mask).astype(np.float32))


def lit(maps: Intrinsics, specular: float = 1.0) -> Intrinsics:
    one = np.ones((maps.height, maps.width, 3), np.float32)
    return maps.replace(specular=specular * one, diffuse=one)


def test_a_corner_shows_its_own_colour_where_it_hides_the_sky() -> None:
    normal, mask, _ = gutter()
    maps = lit(painted(normal, mask))
    found = bounced(maps, LIGHT)
    hidden = {name: 1 - share for name, share in visible_shares(maps, SKY, LIGHT).items()}
    for name in LIGHT:
        assert found[name].min() >= 0
        assert found[name][MIDDLE, MIDDLE].mean() > 0.02, name
        black = bounced(lit(painted(normal, mask, albedo=0.0), specular=0.5), [name])[name]
        ratio = black[MIDDLE, MIDDLE] / hidden[name][MIDDLE, MIDDLE] / REFLECTED
        assert ratio.max() < 0.06, name  # what a black one sends out: its gloss alone
    red, green, blue = found["diffuse"][MIDDLE, MIDDLE].mean(axis=(0, 1))
    assert red > 1.5 * green > 2 * blue


def test_b_is_the_mean_around_a_pixel() -> None:
    normal, mask, _ = gutter()
    even = lit(painted(normal, mask, albedo=0.5, metallic=1.0))  # a metal sends out F s: nearly albedo where s is 1
    found = bounced(even, ["specular"])["specular"]
    hidden = 1 - visible_shares(even, SKY, ("specular",))["specular"]
    radiance = found[MIDDLE, MIDDLE] / hidden[MIDDLE, MIDDLE] / REFLECTED
    assert radiance[..., 0].mean() == pytest.approx(0.5, abs=0.1)
    assert radiance[..., 2].mean() == pytest.approx(0.125, abs=0.1)
    # the left half black: less and less of the right one's light towards the left edge
    right = np.broadcast_to((np.arange(SIZE) >= SIZE // 2)[:, None], normal.shape).astype(np.float32)
    half = even.replace(specular=right)
    beside = bounced(half, ["specular"])["specular"] / found
    assert beside[SIZE // 2, SIZE // 2 - 12, 0] < beside[SIZE // 2, SIZE // 2, 0] < beside[SIZE // 2, SIZE // 2 + 12, 0]


@pytest.mark.parametrize("side", [96, 48])
def test_how_far_around_a_pixel_goes_with_the_size_of_the_object(side: int) -> None:
    """One bright pixel of a square: the standard deviation of what its neighbours see of it, whatever the frame is."""
    mask, specular = np.zeros((96, 96, 1), np.float32), np.zeros((96, 96, 3), np.float32)
    mask[:side, :side] = 1
    specular[side // 2, side // 2] = 1
    facing = (mask * np.array([0, 0, 1])).astype(np.float32)
    maps = painted(facing, mask, 1.0, 1.0)
    even = lit(maps)
    image, mean = split_sum_image(even)[mask[..., 0] > 0], _mean_radiance(even)
    assert (mean[mask[..., 0] > 0] >= image.min(axis=0) - 1e-5).all(), "what is beside the object is not dark"
    assert not mean[mask[..., 0] == 0].any()
    seen = _mean_radiance(maps.replace(specular=specular, diffuse=0 * specular))[..., 0]
    away = np.arange(96) - side // 2
    for axis in (0, 1):
        spread = np.sqrt((seen.sum(axis=axis) * away**2).sum() / seen.sum())
        assert spread == pytest.approx(AROUND * side, rel=0.05)


@pytest.mark.long
def test_nothing_is_added_where_nothing_is_hidden_or_known() -> None:
    normal, mask, _ = ball()
    found = bounced(lit(painted(normal, mask)), LIGHT)
    inside = mask[..., 0] > 0
    for name in LIGHT:
        assert np.abs(found[name][~inside]).max() == 0
        assert found[name][inside].mean() < 0.02, name
    maps = painted(*gutter()[:2]).replace(environment=SKY)
    direct = derived_light(maps, SKY, LIGHT)
    unknown = ready_to_render(maps.replace(albedo=None)).require(*LIGHT)
    assert all(np.array_equal(unknown[name], direct[name]) for name in LIGHT)


@pytest.mark.long
def test_rendering_adds_it_to_what_is_derived_and_to_nothing_that_is_given() -> None:
    maps = painted(*gutter()[:2]).replace(environment=SKY)
    direct = derived_light(maps, SKY, LIGHT)
    added = bounced(maps.replace(**direct), LIGHT)
    ready = ready_to_render(maps).require(*LIGHT)
    for name in LIGHT:
        assert np.array_equal(ready[name], direct[name] + added[name])
        assert added[name].max() > 0.02
    told = ready_to_render(maps.replace(**direct), derived=LIGHT).require(*LIGHT)
    assert all(np.array_equal(told[name], ready[name]) for name in LIGHT)
    given = ready_to_render(maps.replace(**direct)).require(*LIGHT)
    assert all(np.array_equal(given[name], direct[name]) for name in LIGHT)
    without = ready_to_render(maps, shadows=False).require(*LIGHT)
    plain = derived_light(maps, SKY, LIGHT, shadows=False)
    assert all(np.array_equal(without[name], plain[name]) for name in LIGHT)


def test_a_given_map_says_what_the_object_sends_out() -> None:
    maps = painted(*gutter()[:2], metallic=0.5).replace(environment=SKY)
    s = derived_light(maps, SKY, ["specular"])["specular"]
    dim, bright = (ready_to_render(maps.replace(specular=f * s)).require(*LIGHT) for f in (1, 10))
    assert np.array_equal(bright["specular"], 10 * s)
    assert (bright["diffuse"] - dim["diffuse"])[MIDDLE, MIDDLE].mean() > 0.1


@pytest.mark.long
def test_what_is_kept_is_direct_light_and_knows_no_material() -> None:
    """An edit keeps its light, its exposure included: `docs/data_contract.md`."""
    dark, light = (painted(*gutter()[:2], albedo=a) for a in (0.05, 0.9))
    for exposure in ("auto", "keep"):
        one, other = (under_light(maps, SKY, exposure, shadows=True) for maps in (dark, light))
        for name in (*LIGHT, "environment"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_it_doubles_with_the_light() -> None:
    maps = painted(*gutter()[:2])
    once, twice = (ready_to_render(maps.replace(environment=f * SKY)).require(*LIGHT) for f in (1, 2))
    for name in LIGHT:
        np.testing.assert_allclose(twice[name], 2 * once[name], rtol=1e-4, atol=1e-5)


@pytest.mark.long
def test_a_larger_picture_has_the_same() -> None:
    small, large = (bounced(lit(painted(*gutter(size)[:2])), LIGHT) for size in (SIZE, 4 * SIZE))
    for name in LIGHT:
        assert large[name].shape == (4 * SIZE, 4 * SIZE, 3)
        few, many = (np.stack(np.array_split(found[name][..., 0], 6, axis=1)) for found in (small, large))
        np.testing.assert_allclose(many.mean(axis=(1, 2)), few.mean(axis=(1, 2)), rtol=0.3, atol=0.01)
    half = ball(4 * SIZE)
    outside = half[1][..., 0] == 0
    for value in bounced(lit(painted(half[0], half[1])), LIGHT).values():
        assert not value[outside].any()
