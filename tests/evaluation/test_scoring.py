"""Scores of whole predictions: compositing, pasted and own masks, absent maps, refusals."""

import math

import numpy as np
import pytest

from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation import metrics
from unirender_evaluation.metrics import OWN_MASK, SCALES
from unirender_evaluation.scoring import over_white, score_image, score_maps

SIZE = 32


def disc(radius: float = 11) -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE] - (SIZE - 1) / 2
    return np.clip(radius - np.hypot(y, x), 0, 1).astype(np.float32)[..., None]


def intrinsics(seed: int) -> Intrinsics:
    rng = np.random.default_rng(seed)
    mask = disc()
    inside = mask > 0
    normal = rng.normal(size=(SIZE, SIZE, 3)) + np.array([0, 0, 2])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Intrinsics(
        albedo=rng.random((SIZE, SIZE, 3)) * inside,
        normal=normal * inside,
        roughness=rng.random((SIZE, SIZE, 1)) * inside,
        metallic=rng.random((SIZE, SIZE, 1)) * inside,
        specular=3 * rng.random((SIZE, SIZE, 3)) * inside,
        diffuse=rng.random((SIZE, SIZE, 3)) * inside,
        environment=rng.random((16, 32, 3)),
        mask=mask,
    )


def test_the_truth_scores_perfectly() -> None:
    truth = intrinsics(0)
    for key, value in score_maps(truth, truth).items():
        metric = metrics.METRICS[key.partition(".")[2].partition("@")[0]]
        if metric.name in ("psnr", "angle_deg", "log_rmse", "ciede2000", "ssim", "cosine"):
            tolerant = metric.name == "psnr" and "aligned" in key  # a factor of 1 up to rounding
            assert value > 100 if tolerant else value == pytest.approx(metric.perfect, abs=1e-4), key
        else:
            assert value == metric.perfect, key


def test_every_variant_of_every_map_is_there() -> None:
    values = score_maps(intrinsics(1), intrinsics(0))
    for quantity in ("albedo", "specular", "diffuse"):
        found = [key for key in values if key.startswith(f"{quantity}.psnr@")]
        assert len(found) == 2 * 2 * len(SCALES)
    assert {"normal.cosine", "normal.angle_deg", "roughness.mse@masked", "metallic.mse_object"} <= values.keys()
    assert "environment.log_rmse@raw" in values


def test_absent_maps_have_no_values() -> None:
    prediction = intrinsics(1).replace(albedo=None, environment=None, normal=None)
    values = score_maps(prediction, intrinsics(0))
    assert values
    assert not [key for key in values if key.startswith(("albedo", "environment", "normal"))]


def test_masked_and_whole_by_hand() -> None:
    prediction, truth = intrinsics(1), intrinsics(0)
    values = score_maps(prediction, truth)
    assert prediction.albedo is not None
    assert truth.albedo is not None
    p, t, w = prediction.albedo, truth.albedo, truth.mask
    assert values["albedo.psnr@masked-srgb-raw"] == metrics.psnr(image_srgb(p), image_srgb(t), w)
    by_hand = metrics.psnr(image_srgb(over_white(p, disc())), image_srgb(over_white(t, disc())))
    assert values["albedo.psnr@whole-srgb-raw"] == pytest.approx(by_hand)
    linear = metrics.psnr(np.clip(p, 0, 1), np.clip(t, 0, 1), w)
    assert values["albedo.psnr@masked-linear-raw"] == linear != values["albedo.psnr@masked-srgb-raw"]


def test_a_mask_of_ones_own_changes_the_whole_frame_and_not_the_masked_figures() -> None:
    truth = intrinsics(0)
    pasted = score_maps(intrinsics(1).replace(mask=None), truth)
    same = score_maps(intrinsics(1), truth)
    small = intrinsics(1).replace(mask=disc(6))
    own = score_maps(small, truth)
    assert pasted == same
    assert own["albedo.psnr@whole-srgb-raw"] < pasted["albedo.psnr@whole-srgb-raw"]
    for key in ("albedo.psnr@masked-srgb-raw", "albedo.ssim@masked-linear-raw", "roughness.mse@masked"):
        assert own[key] == pasted[key]
    assert OWN_MASK not in pasted
    assert own[OWN_MASK] == pytest.approx(disc(6).sum() / disc().sum())  # one disc in the other


def test_the_given_mask_after_8_bits_is_no_mask_of_ones_own() -> None:
    truth = intrinsics(0)
    pasted = score_maps(intrinsics(1).replace(mask=None), truth)
    for stored in (np.round(disc() * 255) / 255, np.floor(disc() * 255) / 255, disc().astype(np.float16)):
        assert score_maps(intrinsics(1).replace(mask=stored.astype(np.float32)), truth) == pasted
    rough = score_maps(intrinsics(1).replace(mask=np.round(disc() * 15) / np.float32(15)), truth)
    assert 0.9 < rough[OWN_MASK] < 1


def test_scaled_albedo_scores_raw_badly_and_aligned_perfectly() -> None:
    truth = intrinsics(0)
    assert truth.albedo is not None
    values = score_maps(truth.replace(albedo=truth.albedo * 0.5), truth)
    assert values["albedo.psnr@masked-srgb-raw"] < 25
    assert values["albedo.psnr@masked-srgb-aligned"] > 100


def test_light_is_clipped_as_an_image_and_not_in_log_rmse() -> None:
    truth = intrinsics(0)
    assert truth.specular is not None
    bright = truth.replace(specular=truth.specular + 5 * (disc() > 0))
    brighter = truth.replace(specular=truth.specular + 50 * (disc() > 0))
    values = score_maps(brighter, bright)
    assert values["specular.psnr@masked-srgb-raw"] == math.inf
    assert values["specular.log_rmse@raw"] > 1


def test_images_are_premultiplied() -> None:
    truth = intrinsics(0)
    assert truth.diffuse is not None
    image = truth.diffuse * disc()
    np.testing.assert_allclose(unpremultiply(image, disc()), truth.diffuse, atol=1e-6)
    assert score_image(image, image, disc())["relit.psnr@masked-srgb-raw"] == math.inf
    noisy = image + 0.1 * disc()
    values = score_image(noisy, image, disc(), quantity="edit_metallic")
    expected = metrics.psnr(image_srgb(truth.diffuse + 0.1 * (disc() > 0)), image_srgb(truth.diffuse), disc())
    assert values["edit_metallic.psnr@masked-srgb-raw"] == pytest.approx(expected, abs=1e-3)


def test_a_tinted_picture_is_right_up_to_a_factor_per_channel() -> None:
    truth = intrinsics(0)
    assert truth.diffuse is not None
    image = (truth.diffuse * disc()).astype(np.float32)
    values = score_image(image * np.array([0.9, 0.6, 0.3], np.float32), image, disc())
    raw, aligned, per_channel = (values[f"relit.psnr@whole-linear-{scale}"] for scale in SCALES)
    assert raw < aligned < 30 < 100 < per_channel
    assert len([key for key in values if key.startswith("relit.ssim@")]) == 2 * 2 * len(SCALES)


def test_environment_is_compared_at_the_predictions_resolution() -> None:
    flat = np.full((32, 64, 3), 0.7, np.float32)
    prediction = Intrinsics(environment=flat[:16, :32], mask=disc())
    values = score_maps(prediction, Intrinsics(environment=flat, mask=disc()))
    assert values["environment.log_rmse@raw"] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("mask", [None, np.zeros((SIZE, SIZE, 1), np.float32)])
def test_a_truth_without_an_object_is_refused(mask: np.ndarray | None) -> None:
    with pytest.raises(UnirenderError, match="mask"):
        score_maps(intrinsics(1), intrinsics(0).replace(mask=mask))


def test_nan_is_refused() -> None:
    image = np.full((SIZE, SIZE, 3), np.nan, np.float32)
    with pytest.raises(UnirenderError, match="NaN"):
        score_image(image, np.zeros_like(image), disc())
