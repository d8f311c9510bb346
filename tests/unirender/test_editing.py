"""Where the light of a decomposition is too coarse for an edit, and the two limits of an anchored edit."""

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender.pipelines.editing import ANCHOR_FLOOR, ANCHOR_GAIN, anchor, too_coarse


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
