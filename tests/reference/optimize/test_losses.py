"""Losses between pictures: derivatives against central differences, what is counted, and what noise does to them."""

from typing import get_args

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.color import srgb_decode, srgb_encode
from unirender_reference.optimize.refine.config import LossKind
from unirender_reference.optimize.refine.losses import ImageLoss, pixel_loss
from unirender_reference.optimize.views import View, Views

KINDS: tuple[LossKind, ...] = get_args(LossKind)


def pictures(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.02, 1.4, (2, 4, 4, 3)).astype(np.float32)


def views_of(displayed: np.ndarray, mask: np.ndarray | None = None, hdr: bool = False) -> Views:
    pose = np.eye(4, dtype=np.float32)
    full = np.ones((*displayed.shape[:3], 1), np.float32) if mask is None else mask
    return Views(tuple(View(displayed[k], full[k], Camera(), pose) for k in range(len(displayed))), hdr=hdr)


@pytest.mark.parametrize("kind", KINDS)
def test_derivative_is_that_of_the_value(kind: LossKind) -> None:
    x, t, step = pictures(0), pictures(1), 1e-3
    _, slope = pixel_loss(x, t, kind)
    central = (pixel_loss(x + step, t, kind)[0] - pixel_loss(x - step, t, kind)[0]) / (2 * step)
    np.testing.assert_allclose(slope, central, rtol=0.01, atol=2e-3)
    assert np.abs(1.1 * slope - central).max() > 0.02  # the tolerance can tell


@pytest.mark.parametrize("kind", KINDS)
def test_equal_pictures_have_no_loss(kind: LossKind) -> None:
    display = np.random.default_rng(2).uniform(0, 1, (2, 4, 4, 3)).astype(np.float32)
    loss = ImageLoss(views_of(display), kind)
    value, slope = loss(loss.target)
    assert value == 0
    assert not slope.any()
    assert loss(loss.target * 0.9)[0] > 1e-6
    assert loss.psnr(loss.target) > 100 > loss.psnr(loss.target * 0.9)


def test_slope_is_the_display_loss_to_first_order() -> None:
    t = pictures(3)
    x = t * 1.001
    slope, srgb = pixel_loss(x, t, "slope")[0], pixel_loss(x, t, "srgb")[0]
    np.testing.assert_allclose(slope, srgb, rtol=0.01, atol=1e-9)
    assert not np.allclose(pixel_loss(2 * t, t, "slope")[0], pixel_loss(2 * t, t, "srgb")[0], rtol=0.01)


@pytest.mark.parametrize(("kind", "biased"), [("slope", False), ("linear", False), ("srgb", True), ("log", True)])
def test_noise_biases_the_gradient_of_some(kind: LossKind, biased: bool) -> None:
    """Mean derivative over noisy estimates of x = t (which has derivative 0) in standard errors."""
    rng = np.random.default_rng(4)
    t = np.full(300_000, 0.3, np.float32)
    x = (t * rng.gamma(2.0, 0.5, t.shape)).astype(np.float32)  # mean t
    slope = pixel_loss(x.reshape(1, 1, -1, 3), t.reshape(1, 1, -1, 3), kind)[1].astype(np.float64)
    score = slope.mean() / (slope.std() / np.sqrt(t.size))
    assert (abs(score) > 10) == biased, f"{kind}: {score:.1f} standard errors"


def test_more_light_than_a_display_shows_is_no_error() -> None:
    display = np.full((1, 2, 2, 3), 0.5, np.float32)
    display[0, 0, 0] = 1
    views = views_of(display)
    for one_sided in (True, False):
        loss = ImageLoss(views, "slope", one_sided)
        bright, dark = loss.target.copy(), loss.target.copy()
        bright[0, 0, 0], dark[0, 0, 0] = 7, 0.5
        assert (loss(bright)[0] == 0) == one_sided
        assert loss(bright)[1].any() != one_sided
        assert loss(dark)[0] > 0  # less is
    hdr = ImageLoss(views_of(display, hdr=True), "slope", one_sided=True)
    bright = hdr.target.copy()
    bright[0, 0, 0] = 7
    assert hdr(bright)[0] > 0  # linear pictures do not saturate


def test_what_nothing_explains_counts_little_and_the_rest_as_before() -> None:
    views = views_of(np.full((1, 8, 8, 3), 0.5, np.float32))
    weighed, plain = ImageLoss(views, "slope"), ImageLoss(views, "slope")
    explained = plain.target + np.random.default_rng(0).normal(0, 2e-3, plain.target.shape).astype(np.float32)
    explained[0, 0, 0] += 0.5  # a highlight that the light's texels cannot make
    weighed.weigh(explained)
    x = plain.target + 0.1
    ratio = weighed(x)[1] / plain(x)[1]
    assert ratio[0, 0, 0].max() < 1e-3 * np.median(ratio)
    assert ratio.mean() == pytest.approx(1, rel=1e-5)  # rates and priors keep their meaning
    np.testing.assert_allclose(weighed(plain.target + 0.2)[1], 2 * weighed(x)[1], rtol=1e-3)  # fixed: no bias by noise


def test_pixels_that_say_one_or_more_have_no_say_in_the_scale() -> None:
    views = views_of(np.ones((1, 4, 4, 3), np.float32))
    loss = ImageLoss(views)
    loss.weigh(loss.target + 1)  # all are above what a display shows
    assert loss(loss.target - 0.1)[0] == ImageLoss(views)(loss.target - 0.1)[0] > 0


def test_only_covered_pixels_count() -> None:
    display = np.full((1, 2, 2, 3), 0.5, np.float32)
    mask = np.ones((1, 2, 2, 1), np.float32)
    mask[0, 0, 0] = 0
    loss = ImageLoss(views_of(display, mask), "linear")
    other = loss.target.copy()
    other[0, 0, 0] = 3
    assert loss(other)[0] == 0
    other[0, 1, 1] = 3
    assert loss(other)[0] > 0


def test_psnr_of_two_halves_is_free_of_their_noise() -> None:
    """Of pictures that are 0.02 off, with noise of 0.03: the product of both errors tells the first, the square not."""
    display = np.full((4, 64, 64, 3), 0.5, np.float32)
    loss, rng = ImageLoss(views_of(display)), np.random.default_rng(0)
    first, second = (
        srgb_decode((display + 0.02 + rng.normal(0, 0.03, display.shape)).astype(np.float32)) for _ in range(2)
    )
    true = -20 * np.log10(0.02)
    assert loss.psnr(first, second) == pytest.approx(true, abs=0.15)
    assert loss.psnr(first) < true - 4


def test_psnr_is_of_display_values_by_coverage() -> None:
    mask = np.array([1, 1, 0.25, 0], np.float32).reshape(1, 2, 2, 1)
    loss = ImageLoss(views_of(np.full((1, 2, 2, 3), 0.5, np.float32), mask))
    images = loss.target * np.array([1.2, 1, 1.4, 1], np.float32).reshape(mask.shape) + 7 * (mask == 0)
    off, far = (float(srgb_encode(srgb_decode(np.full(1, 0.5)) * np.float32(k))[0]) - 0.5 for k in (1.2, 1.4))
    error = (off**2 + 0.25 * far**2) / 2.25
    assert loss.psnr(images.astype(np.float32)) == pytest.approx(-10 * np.log10(error), abs=0.01)
