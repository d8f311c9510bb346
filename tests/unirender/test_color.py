"""Colour: against colour-science, and the HDR curve's round trip."""

import colour
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unirender.color import HdrCurve, display_slope, image_srgb, luminance, srgb_decode, srgb_encode, unpremultiply


def test_srgb_agrees_with_colour_science() -> None:
    x = np.linspace(0, 1, 1001, dtype=np.float32)
    np.testing.assert_allclose(srgb_encode(x), colour.cctf_encoding(x, function="sRGB"), rtol=0, atol=2e-6)
    np.testing.assert_allclose(srgb_decode(x), colour.cctf_decoding(x, function="sRGB"), rtol=0, atol=2e-6)


def test_srgb_twin_a_plain_gamma_is_told_apart() -> None:
    x = np.linspace(0, 1, 1001, dtype=np.float32)
    assert np.abs(x ** (1 / 2.2) - colour.cctf_encoding(x, function="sRGB")).max() > 1e-2


def test_luminance_agrees_with_colour_science() -> None:
    rgb = np.random.default_rng(0).random((100, 3)).astype(np.float32)
    matrix = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    np.testing.assert_allclose(luminance(rgb), rgb @ matrix[1], rtol=0, atol=2e-4)


@given(st.floats(0, 1, width=32))
def test_srgb_round_trip(x: float) -> None:
    assert float(srgb_decode(srgb_encode(np.array(x)))) == pytest.approx(x, abs=1e-5)


@given(st.floats(0, 1000, width=32))
def test_hdr_curve_round_trip_beyond_x_max(x: float) -> None:
    curve = HdrCurve()
    assert float(curve.decode(curve.encode(np.array([x])))[0]) == pytest.approx(x, rel=1e-4, abs=1e-6)


def test_hdr_curve_ends_and_overflow() -> None:
    curve = HdrCurve(k=10, x_max=50)
    assert curve.encode(np.array([0.0, 50.0])) == pytest.approx([0, 1])
    assert curve.overflow(np.array([1.0, 50.0, 51.0, 1000.0])) == 2
    assert curve.encode(np.array([60.0]))[0] > 1  # counted, not clipped


def test_image_srgb_clips_to_the_display() -> None:
    assert image_srgb(np.array([-1.0, 0.0, 1.0, 7.0])) == pytest.approx([0, 0, 1, 1])


def test_display_slope_is_the_derivative_of_what_is_shown() -> None:
    """Against central differences in float64; 0 where the display clips; twin: the slope of a plain gamma."""
    x, h = np.array([-0.5, 0.001, 0.002, 0.0035, 0.01, 0.2, 0.7, 0.99, 1.5]), 1e-6

    def shown(linear: np.ndarray) -> np.ndarray:
        clipped = np.clip(linear, 0, 1)
        return colour.cctf_encoding(clipped, function="sRGB")

    differences = (shown(x + h) - shown(x - h)) / (2 * h)
    np.testing.assert_allclose(display_slope(x), differences, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(display_slope(x, "linear"), [0, 1, 1, 1, 1, 1, 1, 1, 0])
    gamma = 1 / 2.2 * x[1:-1] ** (1 / 2.2 - 1)
    assert np.abs(gamma / differences[1:-1] - 1).max() > 0.1


def test_unpremultiply_undoes_coverage_and_leaves_the_background_black() -> None:
    rng = np.random.default_rng(0)
    colour_linear, mask = rng.random((4, 4, 3)).astype(np.float32), rng.random((4, 4, 1)).astype(np.float32)
    mask[:2] = 0
    straight = unpremultiply(colour_linear * mask, mask)
    np.testing.assert_allclose(straight[2:], colour_linear[2:], rtol=1e-6)
    assert not straight[:2].any()
    assert np.abs(colour_linear * mask - colour_linear)[2:].max() > 0.1  # twin: left premultiplied
    assert not unpremultiply(colour_linear, mask)[:2].any()  # a glow around the object has no coverage
    mask[3, 0] = np.nan
    assert np.isnan(unpremultiply(colour_linear, mask)).sum() == 3  # what is not known is not black
