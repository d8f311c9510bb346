"""The tone in which residuals are measured, and the exposure at which a picture is fitted."""

import colour
import numpy as np
import pytest

from unirender.intrinsics import Intrinsics
from unirender_reference.optimize.exposure import DARK_SHARE, MIDDLE, exposed, exposure_of
from unirender_reference.optimize.numerics.tone import tone_slope


def test_the_slope_is_that_of_the_srgb_curve_also_above_white() -> None:
    x, h = np.array([0.001, 0.02, 0.5, 0.99, 1.01, 2.0, 30.0]), 1e-6
    high, low = (colour.cctf_encoding(x + step, function="sRGB") for step in (h, -h))
    np.testing.assert_allclose(tone_slope(x), (high - low) / (2 * h), rtol=1e-5)


def test_the_exposure_is_the_logarithmic_mean_over_the_mask() -> None:
    """Of 1 and 4, whose mean is 2.5, with a little of that: about 2, their geometric mean. Coverage is a weight."""
    straight = np.array([[1.0, 4.0, 77.0]], np.float32)[..., None] * np.array([0.5, 1, 1.5], np.float32)
    mask = np.array([[1.0, 1.0, 0.0]], np.float32)[..., None]
    dark = DARK_SHARE * 2.5
    assert exposure_of(straight * mask, mask) == pytest.approx(np.sqrt((1 + dark) * (4 + dark)) / MIDDLE)
    part = np.array([[0.5, 1.0, 0.0]], np.float32)[..., None]
    dark = DARK_SHARE * (0.5 * 1 + 4) / 1.5
    assert exposure_of(straight * part, part) == pytest.approx(((1 + dark) * (4 + dark) ** 2) ** (1 / 3) / MIDDLE)
    assert exposure_of(0 * straight, mask) == 1


def test_a_brighter_light_is_one_of_all_radiance_maps_and_of_nothing_else() -> None:
    two = np.full((2, 2, 3), 0.25, np.float32)
    maps = Intrinsics(albedo=two, specular=two, diffuse=2 * two, mask=np.ones((2, 2, 1), np.float32))
    found = exposed(maps, 4.0).require("albedo", "specular", "diffuse", "mask")
    assert [float(found[name].max()) for name in ("albedo", "specular", "diffuse", "mask")] == [0.25, 1, 2, 1]
    assert exposed(maps, 4.0).environment is None
    light = exposed(maps.replace(environment=np.ones((4, 8, 3), np.float32)), 4.0).environment
    assert light is not None
    assert (light == 4).all()
