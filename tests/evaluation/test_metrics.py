"""Metrics: against other implementations, in closed form, and with twins that must fail."""

import inspect
import math
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from unirender.color import srgb_encode
from unirender.errors import UnirenderError
from unirender_evaluation import metrics
from unirender_evaluation.metrics import ALL_VARIANTS, METRICS, Variant, chosen_variants, metric_key
from unirender_evaluation.ssim import _similarity, crop_border, ssim, ssim_map


def images(seed: int, height: int = 40, width: int = 33, distance: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a, b = rng.random((2, height, width, 3), dtype=np.float32)
    return a, (1 - distance) * a + distance * b


def disc(height: int = 40, width: int = 33) -> np.ndarray:
    """Coverage with soft edges."""
    y, x = np.mgrid[0:height, 0:width]
    return np.clip(12 - np.hypot(y - height / 2, x - width / 2), 0, 1).astype(np.float32)[..., None]


@pytest.mark.parametrize("seed", range(3))
def test_psnr_is_scikit_images(seed: int) -> None:
    p, t = images(seed)
    assert metrics.psnr(p, t) == pytest.approx(peak_signal_noise_ratio(t, p, data_range=1), abs=1e-6)


def test_psnr_of_identical_images_is_infinite_and_of_the_smallest_difference_is_not() -> None:
    p, _ = images(0)
    changed = p.copy()
    changed[0, 0, 0] += 2**-12
    assert metrics.psnr(p, p) == math.inf
    assert 100 < metrics.psnr(changed, p) < 120  # no hidden floor


@pytest.mark.parametrize("size", [(40, 33), (64, 64), (300, 280)])
def test_ssim_is_scikit_images(size: tuple[int, int]) -> None:
    """Both blur paths: the dense product up to 256 pixels, the separable filter beyond."""
    p, t = (x.astype(np.float64) for x in images(1, *size))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    scikit_image: Any = structural_similarity  # what it returns depends on `full`, which its types do not know
    theirs, their_map = scikit_image(t, p, channel_axis=-1, full=True, **options)
    assert ssim(p, t) == pytest.approx(theirs, rel=0, abs=1e-12)
    np.testing.assert_allclose(ssim_map(p, t), their_map.mean(axis=-1), rtol=0, atol=1e-12)
    uniform = scikit_image(t, p, channel_axis=-1, data_range=1.0)
    assert abs(ssim(p, t) - uniform) > 1e-4  # the twin: another window is another number


def test_ssim_needs_a_pixel_inside_the_border() -> None:
    assert ssim(*images(1, 11, 11)) < 1
    for size in ((10, 40), (40, 10)):
        with pytest.raises(UnirenderError, match="expected more than 10 a side"):
            ssim(*images(1, *size))


def test_ssim_is_torchmetrics_inside_the_border() -> None:
    """torchmetrics averages the border too (mirrored input); scikit-image and we leave it out."""
    p, t = images(2, 64, 64)
    preds, target = (torch.from_numpy(x).permute(2, 0, 1)[None].double() for x in (p, t))
    result = structural_similarity_index_measure(preds, target, data_range=1.0, sigma=1.5, return_full_image=True)
    theirs = result[1][0].mean(dim=0).numpy()
    np.testing.assert_allclose(crop_border(ssim_map(p, t)), crop_border(theirs), atol=1e-9)


def test_ssim_of_many_images_is_that_of_each() -> None:
    pairs = [images(seed, 24, 24) for seed in range(4)]
    together = ssim_map(np.stack([p for p, _ in pairs]), pairs[0][1][None])
    for one, (p, _) in zip(together, pairs, strict=True):
        np.testing.assert_allclose(one, ssim_map(p, pairs[0][1]), rtol=0, atol=1e-13)


def test_large_pictures_have_the_same_values_in_less_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """All variants of a picture of 8 megapixels took 7 GiB."""
    rng = np.random.default_rng(0)
    p, t = (rng.random((n, 260, 270, 3), np.float32) for n in (3, 1))
    tracemalloc.start()
    found = ssim_map(p, t)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert taken < 200 * p[0, ..., 0].size  # bytes; at once they take 720
    assert np.array_equal(found, _similarity(p, t).mean(axis=-1))
    expected = metrics.ciede2000(p[0], t[0], p[1, ..., :1])
    monkeypatch.setattr(metrics, "BLOCK", 20_000)
    assert metrics.ciede2000(p[0], t[0], p[1, ..., :1]) == expected


def test_weighted_error_by_hand() -> None:
    p = np.array([[[0.5], [0.2]]], np.float32)
    t = np.zeros((1, 2, 1), np.float32)
    w = np.array([[[1.0], [0.5]]], np.float32)
    assert metrics.mse(p, t, w) == pytest.approx((0.25 + 0.5 * 0.04) / 1.5)
    assert metrics.mse(p, t, w / 8) == metrics.mse(p, t, w)  # a mask of less than a pixel, too


def test_whole_frame_exceeds_masked_by_the_coverage() -> None:
    """DESIGN: whole exceeds masked by -10 log10(coverage) where the background is right."""
    p, t = images(4)
    w = (disc() > 0.5).astype(np.float32)
    whole = metrics.psnr(p * w + 1 - w, t * w + 1 - w)
    assert whole - metrics.psnr(p, t, w) == pytest.approx(-10 * math.log10(w.mean()), abs=1e-4)


def test_an_empty_mask_is_an_error() -> None:
    p, t = images(5)
    with pytest.raises(UnirenderError, match="mask is empty"):
        metrics.mse(p, t, np.zeros((40, 33, 1), np.float32))


def test_a_mask_or_several_pictures_that_would_broadcast_are_an_error() -> None:
    """As another project calls it: a mask [h, w] of a square picture gave a number, and it was a wrong one."""
    pictures = np.random.default_rng(0).random((2, 16, 16, 3))
    with pytest.raises(UnirenderError, match=r"got a mask of shape \(16, 16\), expected \(16, 16, 1\)"):
        inspect.unwrap(metrics.weighted_mean)(pictures[0, ..., :1], np.ones((16, 16)))
    with pytest.raises(UnirenderError, match=r"got shape \(2, 16, 16, 3\), expected one picture"):
        inspect.unwrap(metrics.mse)(pictures, pictures)


@pytest.mark.parametrize("metric", [metrics.mse, ssim, metrics.ciede2000])
def test_whole_numbers_and_other_sizes_are_an_error(metric: Callable[..., float]) -> None:
    """PSNR of 8-bit pictures was 48 dB too low, their SSIM that of another range, and a grey truth was broadcast."""
    picture, w = np.full((16, 16, 3), 0.5), np.ones((16, 16, 1))
    for truth, message in (
        (np.full((16, 16, 3), 128, np.uint8), "got uint8 values, expected floats whose white is 1; divide by 255"),
        (picture[..., :1], r"got shapes \(16, 16, 3\) and \(16, 16, 1\), expected equal ones"),
    ):
        with pytest.raises(UnirenderError, match=message):
            inspect.unwrap(metric)(picture, truth, w)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.05, 8.0), st.integers(0, 1000))
def test_alignment_finds_any_scale(factor: float, seed: int) -> None:
    t, _ = images(seed, 8, 8)
    w = np.ones((8, 8, 1), np.float32)
    np.testing.assert_allclose(metrics.align_scale(t * np.float32(factor), t, w, "aligned"), t, rtol=1e-4)


def test_alignment_per_channel_finds_a_tint_and_per_image_does_not() -> None:
    t, _ = images(6)
    tinted = t * np.array([0.5, 1.0, 2.0], np.float32)
    np.testing.assert_allclose(metrics.align_scale(tinted, t, disc(), "aligned_rgb"), t, rtol=1e-4)
    assert metrics.mse(metrics.align_scale(tinted, t, disc(), "aligned"), t, disc()) > 1e-3


def test_alignment_leaves_black_alone() -> None:
    t, _ = images(7)
    black = np.zeros_like(t)
    assert np.array_equal(metrics.align_scale(black, t, disc(), "aligned"), black)


def test_cosine_in_closed_form() -> None:
    t = np.array([[[0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.0]]], np.float32)
    p = np.array([[[0, 0, 2.0], [0, 1.0, 1.0], [0, 0, 0]]], np.float32)
    np.testing.assert_allclose(metrics.cosine(p, t)[0, :, 0], [1, math.sqrt(0.5), 0], atol=1e-7)


def test_rounding_takes_no_cosine_beyond_one() -> None:
    """There an angle would be NaN; of 1320 vectors beside themselves, some are beyond without the clip."""
    p, _ = images(9)
    assert metrics.cosine(p, p).max() == 1
    assert metrics.cosine(p, -p).min() == -1


def test_log_rmse_of_a_factor_is_its_logarithm() -> None:
    t = np.full((4, 4, 3), 50.0, np.float32)
    w = np.ones((4, 4, 1), np.float32)
    assert metrics.log_rmse(t * 2, t, w) == pytest.approx(math.log(2), rel=1e-3)


def test_radiance_below_zero_is_none_in_logarithms() -> None:
    t = np.full((4, 4, 3), 50.0, np.float32)
    assert metrics.log_rmse(-t, 0 * t, np.ones((4, 4, 1), np.float32)) == 0


def test_relative_rmse_by_hand() -> None:
    t = np.array([[[0.5, 1, 1.5], [2, 3, 4]]], np.float32)  # of mean 1 and 3
    w = np.array([1, 0.5], np.float32).reshape(1, 2, 1)
    assert metrics.rmse_relative(t + 1, t, w) == pytest.approx(1 / ((1 + 0.5 * 3) / 1.5))
    with pytest.raises(UnirenderError, match="the truth is black"):
        metrics.rmse_relative(t, 0 * t, w)


def test_ciede2000_is_scikit_images() -> None:
    p, t = images(8, 12, 12)
    w = np.ones((12, 12, 1), np.float32)
    theirs = deltaE_ciede2000(rgb2lab(srgb_encode(t)), rgb2lab(srgb_encode(p))).mean()
    assert metrics.ciede2000(p, t, w) == pytest.approx(theirs, rel=2e-3)  # they round the sRGB matrix elsewhere
    assert metrics.ciede2000(t, t, w) == 0.0


def test_keys_name_only_the_axes_that_a_metric_has() -> None:
    variant = Variant("whole", "linear", "aligned")
    assert metric_key("albedo", "psnr", variant) == "albedo.psnr@whole-linear-aligned"
    assert metric_key("albedo", "lpips_vgg", variant) == "albedo.lpips_vgg@whole-aligned"
    assert metric_key("roughness", "mse", variant) == "roughness.mse@whole"
    assert metric_key("normal", "cosine", variant) == "normal.cosine"


def test_variants_are_read_from_text() -> None:
    assert Variant.parse("whole-linear") == Variant("whole", "linear", "raw")
    assert Variant.parse(Variant("masked", "srgb", "aligned_rgb").label) == Variant(scale="aligned_rgb")
    for bad in ("whole-blue", "whole-masked"):
        with pytest.raises(UnirenderError, match="expected one word per axis"):
            Variant.parse(bad)


def test_what_the_option_asks_for() -> None:
    assert chosen_variants([]) is None
    assert chosen_variants(["all"]) == ALL_VARIANTS
    assert len({variant.label for variant in ALL_VARIANTS}) == 12
    assert chosen_variants(["linear", "masked-linear"]) == (Variant("masked", "linear"),)  # the same one, once
    found = chosen_variants(["whole", "all"])
    assert found is not None
    assert found[0] == Variant("whole")
    assert set(found) == set(ALL_VARIANTS)
    assert len(found) == 12
    with pytest.raises(UnirenderError, match="got 'none', expected one word per axis"):
        chosen_variants(["all", "none"])


def test_what_is_nearer_to_perfect_is_better() -> None:
    higher = {"psnr", "ssim", "iou", "cosine"}
    for name, metric in METRICS.items():
        near, far = (30.0, 20.0) if math.isinf(metric.perfect) else (abs(metric.perfect - x) for x in (0.1, 0.5))
        assert metric.better(near, far), name
        assert not metric.better(far, near), name
        assert not metric.better(near, near), name
        assert metric.arrow == ("↑" if name in higher else "↓")
