"""Edits of roughness: the light they go by, their bounds, what cannot be told; and the limits of anchored edits."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from synthetic_shards import sphere

from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender.pipelines.derived_light import derived_specular
from unirender.pipelines.editing import (
    ANCHOR_FLOOR,
    ANCHOR_GAIN,
    LOBE_RATIO,
    anchor,
    specular_for_roughness,
    too_coarse,
    trust,
    under_light,
)
from unirender.pipelines.masked_maps import constant_map, masked_mean


def polished(roughness: float, light: np.ndarray) -> Intrinsics:
    """A metal ball of one roughness, whose picture is its specular light alone."""
    shape = sphere(24, np.random.default_rng(0))
    mask = shape.require("mask")["mask"]
    bare = shape.replace(albedo=np.repeat(mask, 3, -1), metallic=mask, roughness=roughness * mask, environment=light)
    return bare.replace(specular=derived_specular(bare, light), diffuse=0 * np.repeat(mask, 3, -1))


def lamp() -> np.ndarray:
    """Strong, before a dim sky."""
    directions = environment_directions(16, 32)
    strength = 0.1 + 60 * np.exp(40 * (directions @ np.array([0.36, 0.48, 0.8]) - 1))
    return np.repeat(strength[..., None], 3, axis=-1).astype(np.float32)


def specular(intrinsics: Intrinsics) -> np.ndarray:
    return intrinsics.require("specular")["specular"]


def test_an_edit_goes_by_the_light_that_s_reveals() -> None:
    """A predicted light that is blurred says less of what a wider lobe does to the highlight than s itself."""
    true, mask = polished(0.45, lamp()), polished(0.45, lamp()).require("mask")["mask"]
    flat = gaussian_filter(lamp(), (3, 6, 0), mode="nearest").astype(np.float32)
    edited, _ = specular_for_roughness(true.replace(environment=flat), 0.9 * mask)
    old, new = (derived_specular(true.replace(roughness=r * mask), flat) for r in (0.45, 0.9))
    by_the_blurred = specular(true) * (new + 0.02) / (old + 0.02)
    error, twin = (np.abs(s - specular(polished(0.9, lamp()))).mean() for s in (edited, by_the_blurred))
    assert error < 0.7 * twin


def test_no_edit_changes_s_by_more_than_its_bound() -> None:
    """Either way; and the share of the object where it was held is told."""
    for old, new, bound in ((0.9, 0.15, LOBE_RATIO), (0.15, 0.9, 1 / LOBE_RATIO)):
        before = polished(old, lamp())
        mask = before.require("mask")["mask"]
        edited, held = specular_for_roughness(before, new * mask)
        change = (edited / np.maximum(specular(before), 1e-9))[np.repeat(mask > 0, 3, axis=-1)]
        above, below = np.isclose(change, LOBE_RATIO, rtol=1e-4), np.isclose(change, 1 / LOBE_RATIO, rtol=1e-4)
        assert np.isclose(change, bound, rtol=1e-4).any()
        assert ((change > 1 / LOBE_RATIO) & (change < LOBE_RATIO) | above | below).all()
        assert held == pytest.approx((above | below).mean(), abs=1e-3)
        assert held < 0.9


def test_the_trust_in_a_sharper_lobe_is_bounded() -> None:
    """c(r) = clip(0.2 + 3 r, 0.5, 1.7), of a change that is far larger than the small one."""
    old = np.full((1, 1, 1), 1.0, np.float32)
    for new, per_share in ((0.0, 0.5), (0.05, 0.5), (0.2, 0.8), (0.6, 1.7)):
        square = (1 - new) ** 2
        expected = per_share * 0.3 * square / (square + 0.1**2)
        assert trust(old, np.full_like(old, new), 0.3).item() == pytest.approx(expected, rel=1e-5), new


def decomposition(roughness: float, rows: int) -> Intrinsics:
    mask = np.ones((4, 4, 1), np.float32)
    mask[0] = 0
    light = np.ones((rows, 2 * rows, 3), np.float32)
    return Intrinsics(roughness=roughness * mask, environment=light, mask=mask)


def test_a_light_is_too_coarse_for_lobes_narrower_than_its_texels() -> None:
    """16 rows are texels of 12 degrees, which is the width of the lobe of roughness 0.285."""
    before = decomposition(0.5, 16)
    assert before.mask is not None
    inside = before.mask > 0
    assert np.array_equal(too_coarse(before, 0.28 * before.mask), inside)
    assert not too_coarse(before, 0.29 * before.mask).any()
    assert np.array_equal(too_coarse(decomposition(0.1, 16), 0.9 * before.mask), inside), "the old lobe counts, too"
    assert not too_coarse(decomposition(0.5, 64), 0.28 * before.mask).any(), "a finer light says it"
    smooth = decomposition(0.1, 16)
    assert not too_coarse(smooth, smooth.require("roughness")["roughness"]).any(), "nothing was changed"


def test_an_exposure_is_chosen_by_the_light_also_where_d_is_given() -> None:
    """What is given stays; s and the light are scaled by what the whole d of that light would be."""
    before = polished(0.5, lamp())
    given = np.full_like(specular(before), 0.3)
    plain, chosen = under_light(before, lamp(), "auto"), under_light(before, lamp(), "auto", diffuse=given)
    assert np.array_equal(chosen.require("diffuse")["diffuse"], given)
    for name in ("specular", "environment"):
        np.testing.assert_allclose(getattr(chosen, name), getattr(plain, name), rtol=1e-6)
    assert not np.allclose(specular(plain), specular(under_light(before, lamp(), "keep")), rtol=0.05)


def test_a_number_as_a_map_is_not_weighed_by_coverage() -> None:
    """Every pixel that is covered at all has it, as the contract's maps do; the background is 0."""
    mask = np.array([[1, 0.3, 0]], np.float32)[..., None]
    assert constant_map(0.5, mask).ravel().tolist() == [0.5, 0.5, 0]


def test_a_mean_over_the_object_counts_pixels_by_their_coverage() -> None:
    mask = np.array([[1, 0.5, 0]], np.float32)[..., None]
    value = np.array([[0.2, 0.8, 9]], np.float32)[..., None]
    assert masked_mean(value, mask) == pytest.approx((0.2 + 0.5 * 0.8) / 1.5)


def test_an_anchored_edit_is_the_ratio_where_light_is_and_the_difference_in_the_dark() -> None:
    shape = (2, 2, 3)
    seen, before, after = (np.full(shape, value, np.float32) for value in (0.6, 0.5, 0.8))
    np.testing.assert_allclose(anchor(seen, before, after), seen * after / before, rtol=0.02)
    dark = np.zeros(shape, np.float32)
    np.testing.assert_allclose(anchor(dark, dark, after), after, rtol=1e-6)  # the difference form, gain 1
    unseen = anchor(seen, dark, np.full(shape, 0.1, np.float32))
    np.testing.assert_allclose(unseen, seen + ANCHOR_GAIN * 0.1, rtol=1e-6)  # the bound; without it the gain is 31
    assert (seen[0, 0, 0] + ANCHOR_FLOOR) / ANCHOR_FLOOR > 30
    too_bright = anchor(dark, seen, seen + np.float32(0.1))  # a change shows on what is far darker than its rendering
    np.testing.assert_allclose(too_bright, 0.1 / ANCHOR_GAIN, rtol=1e-5)
