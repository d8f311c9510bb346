"""How Stanford-ORB is compared: maps in linear light, relit pictures in display values, and inside of the rim."""

import numpy as np
import pytest

from unirender.color import srgb_encode
from unirender.intrinsics import Intrinsics
from unirender_evaluation.lpips import load
from unirender_evaluation.public.orb_scoring import score_maps, score_relit
from unirender_evaluation.public.sets import Answer

WHOLE = np.ones((32, 32, 1), np.float32)
TRUE = np.random.default_rng(0).uniform(0.2, 0.6, (32, 32, 3)).astype(np.float32)
TINTED = TRUE * np.array([1.1, 0.9, 0.8], np.float32)


def db(p: np.ndarray, t: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean(np.square(p.astype(np.float64) - t))))


def test_an_albedo_is_compared_in_linear_light_and_a_relit_picture_as_it_is_shown() -> None:
    albedo = score_maps(Answer(maps=Intrinsics(albedo=TINTED)), {"albedo": TRUE}, WHOLE, [])
    relit = score_relit(TINTED, TRUE, WHOLE, [])
    assert albedo["albedo.psnr_l@raw"] == pytest.approx(db(TINTED, TRUE), abs=1e-4)
    assert relit["relit.psnr_l@raw"] == pytest.approx(db(srgb_encode(TINTED), srgb_encode(TRUE)), abs=1e-4)
    lift = srgb_encode(TRUE).mean() / TRUE.mean()
    assert relit["relit.psnr_h@raw"] == pytest.approx(db(lift * TINTED, lift * TRUE), abs=1e-4)


def test_only_the_scaled_numbers_take_a_factor_for_each_channel() -> None:
    albedo = score_maps(Answer(maps=Intrinsics(albedo=TINTED)), {"albedo": TRUE}, WHOLE, [])
    relit = score_relit(TINTED, TRUE, WHOLE, [])
    for values, name in ((albedo, "albedo.psnr_l"), (relit, "relit.psnr_l"), (relit, "relit.psnr_h")):
        assert values[f"{name}@raw"] < 40 < 100 < values[f"{name}@aligned_rgb"]


def test_the_rim_of_the_object_does_not_count() -> None:
    """Two pixels of it, by which the mask shrinks."""
    mask = np.zeros_like(WHOLE)
    mask[8:-8, 8:-8] = 1
    rim = mask.copy()
    rim[10:-10, 10:-10] = 0
    right = score_relit(TINTED, TRUE, mask, [])
    assert score_relit(TINTED + rim, TRUE, mask, []) == right
    assert score_relit(TINTED + np.roll(rim, 1, axis=0), TRUE, mask, []) != right
    maps, spoiled = (Answer(maps=Intrinsics(albedo=np.clip(TINTED + x, 0, 1))) for x in (0, rim))
    assert score_maps(spoiled, {"albedo": TRUE}, mask, []) == score_maps(maps, {"albedo": TRUE}, mask, [])


def test_lpips_sees_pictures_encoded_twice_and_an_albedo_once() -> None:
    network = load("alex")
    albedo = score_maps(Answer(maps=Intrinsics(albedo=TINTED)), {"albedo": TRUE}, WHOLE, [network])
    relit = score_relit(TINTED, TRUE, WHOLE, [network])
    once = [srgb_encode(x)[None] for x in (TINTED, TRUE)]
    twice = [srgb_encode(x) for x in once]
    assert albedo["albedo.lpips_alex@raw"] == pytest.approx(float(network.distance(*once)[0]), rel=1e-4)
    assert relit["relit.lpips_alex@raw"] == pytest.approx(float(network.distance(*twice)[0]), rel=1e-4)
    assert albedo["albedo.lpips_alex@raw"] != pytest.approx(relit["relit.lpips_alex@raw"], rel=0.01)


def test_a_psnr_at_the_floor_is_marked() -> None:
    worse = score_relit(np.zeros_like(TRUE), TRUE, WHOLE, [])
    assert worse["relit.psnr_l_floored@raw"] == worse["relit.psnr_h_floored@raw"] == 1
    better = score_relit(TINTED, TRUE, WHOLE, [])
    assert better["relit.psnr_l_floored@raw"] == better["relit.psnr_h_floored@raw"] == 0
