"""`unirender reference shade-ceiling`: the score, and the command on one small object."""

import math

import numpy as np
import pytest

from unirender.color import srgb_encode
from unirender_evaluation.metrics import psnr
from unirender_reference.measure.shade_ceiling import MODES, ShadeCeiling, masked_psnr, measure


def test_the_score_is_the_benchmarks() -> None:
    rng = np.random.default_rng(0)
    mask = rng.uniform(0, 1, (8, 8, 1)).astype(np.float32)
    a, b = (rng.uniform(0, 1.2, (8, 8, 3)).astype(np.float32) for _ in range(2))
    expected = psnr(srgb_encode(np.clip(a, 0, 1)), srgb_encode(np.clip(b, 0, 1)), mask)
    assert masked_psnr(a * mask, b * mask, mask) == pytest.approx(expected, abs=1e-3)
    assert masked_psnr(a, a, mask) == math.inf


@pytest.mark.slow
def test_shadows_bring_the_shaded_maps_closer() -> None:
    config = ShadeCeiling(objects=1, resolution=24, spp=64, truth_spp=64, roughness=(0.6,), metallic=(0.5,))
    scores = measure(config, 0)[0.6, 0.5]
    assert set(scores) == {*MODES, "floor"}
    assert scores["alone"] < scores["shadows"] < scores["one bounce"] < scores["floor"] + 3
