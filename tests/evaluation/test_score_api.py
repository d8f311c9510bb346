"""`unirender_evaluation.score`: the benchmark's own numbers, without a suite, and a sentence for what it refuses."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

import unirender_evaluation
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation import Variant, lpips, score
from unirender_evaluation.light_metrics import score_light
from unirender_evaluation.scoring import score_image, score_maps

rng = np.random.default_rng(0)
MASK = (rng.random((16, 16, 1)) > 0.3).astype(np.float32)


def maps(level: float, **changes: Any) -> Intrinsics:
    normal = np.zeros((16, 16, 3), np.float32)
    normal[..., 2] = MASK[..., 0]
    given = {
        "albedo": level * MASK * rng.random((16, 16, 3)),
        "roughness": level * MASK,
        "normal": normal,
        "mask": MASK,
    }
    return Intrinsics(**{name: value.astype(np.float32) for name, value in (given | changes).items()})


TRUE, FOUND = maps(0.8), maps(0.5)
PICTURES = [(level * rng.random((16, 16, 3)) * MASK).astype(np.float32) for level in (0.5, 0.8)]


def test_it_is_what_the_benchmark_computes() -> None:
    assert score(FOUND, TRUE) == score_maps(FOUND, TRUE)
    found, true = PICTURES
    assert score(found, true, mask=MASK, quantity="relit") == score_image(found, true, MASK)
    assert len(score(FOUND, TRUE)) > 25
    assert score(TRUE, TRUE)["albedo.psnr@masked-srgb-raw"] == float("inf")


def test_a_protocol_chooses_among_the_same_numbers() -> None:
    everything = score(FOUND, TRUE)
    chosen = score(FOUND, TRUE, "masked-linear-aligned")
    assert chosen == score(FOUND, TRUE, Variant("masked", "linear", "aligned"))
    assert chosen.keys() == {
        *(f"albedo.{name}@masked-linear-aligned" for name in ("psnr", "ssim")),
        *("albedo.ciede2000@aligned", "roughness.mse@masked", "roughness.mse_object"),
        *("normal.cosine", "normal.angle_deg"),
    }
    assert chosen.items() <= everything.items()
    assert chosen.keys() & score(FOUND, TRUE, "whole").keys() == {
        "roughness.mse_object",
        "normal.cosine",
        "normal.angle_deg",
    }


def test_a_light_is_scored_as_the_benchmark_scores_it_and_not_by_the_texels_of_its_map() -> None:
    light = np.full((16, 32, 3), 0.1, np.float32)
    light[4, 9], light[12, 3] = 50, 0
    true = TRUE.replace(environment=light)
    flat = {shape: FOUND.replace(environment=np.full((*shape, 3), 0.4, np.float32)) for shape in ((2, 2), (16, 32))}
    coarse, fine = (score(found, true) for found in flat.values())
    assert fine == score(FOUND, TRUE) | score_light(flat[16, 32], true)
    assert coarse == pytest.approx(fine, rel=0.02)  # 0.51 and 0.79 where each was compared on its own map
    assert score(flat[2, 2], true, "aligned").keys() - score(FOUND, TRUE, "aligned").keys() == {
        *("environment.log_rmse_scaled", "environment.peak_deg"),
        *("ball_matte.rmse_relative@aligned", "ball_glossy.rmse_relative@aligned"),
    }
    assert score(FOUND.replace(environment=0 * light), true) == score(FOUND, TRUE)  # black


def test_the_methods_own_mask_counts_in_the_whole_frame() -> None:
    own = FOUND.replace(mask=np.ones_like(MASK))
    key = "albedo.psnr@whole-srgb-raw"
    assert score(own, TRUE, "whole")[key] < score(FOUND, TRUE, "whole")[key]


@pytest.mark.skipif("alex" not in lpips.available(), reason="the AlexNet weights ship with the package")
def test_lpips_on_request_at_the_protocols_scale() -> None:
    large = [np.repeat(np.repeat(x, 4, 0), 4, 1) for x in (*PICTURES, MASK)]
    found = score(large[0], large[1], "masked-srgb-aligned", mask=large[2], lpips=["alex"])
    assert 0 < found["image.lpips_alex@masked-aligned"] < 2
    assert not any("lpips" in key for key in score(large[0], large[1], mask=large[2]))


def bytes_of(picture: np.ndarray) -> np.ndarray:
    return (255 * picture).astype(np.uint8)


@pytest.mark.parametrize(
    ("arguments", "options", "said"),
    [
        ((FOUND, PICTURES[1]), {}, "got Intrinsics and ndarray, expected two unirender.Intrinsics or two pictures"),
        (PICTURES, {}, "pictures need mask=, the true coverage"),
        ((FOUND, TRUE), {"mask": MASK}, "got maps and mask="),
        (
            (bytes_of(PICTURES[0]), PICTURES[1]),
            {"mask": MASK},
            "the prediction is uint8 of shape .16, 16, 3., expected f",
        ),
        ((torch.zeros(3, 16, 16), PICTURES[1]), {"mask": MASK}, "the prediction is a torch tensor, expected a numpy"),
        ((PICTURES[0].transpose(2, 0, 1), PICTURES[1]), {"mask": MASK}, "the channels come last"),
        ((PICTURES[0][None], PICTURES[1][None]), {"mask": MASK}, "score one picture at a time"),
        ((PICTURES[0][:8], PICTURES[1]), {"mask": MASK}, "expected the same .h, w, c.; resample the prediction"),
        (PICTURES, {"mask": MASK[:8]}, "got a mask of .8, 16. and a truth of .16, 16. pixels"),
        (PICTURES, {"mask": 255 * MASK}, r"mask is in \[0, 255\], expected coverage in \[0, 1\]"),
        (PICTURES, {"mask": 0 * MASK}, "the truth has an empty mask"),
        ((255 * PICTURES[0], PICTURES[1]), {"mask": MASK}, r"other units than the truth: its median .* \(0 to 255\?\)"),
        ((2 * PICTURES[0] - 1, PICTURES[1]), {"mask": MASK}, r"a tenth of its values .* \(-1 to 1\?\)"),
        (PICTURES, {"mask": MASK, "lpips": "alex"}, r"got lpips='alex', expected a list of names: lpips=\['alex'\]"),
        (PICTURES, {"mask": MASK, "lpips": ["squeeze"]}, "got backbone 'squeeze', expected one of"),
        ((FOUND, TRUE), {"protocol": "mask"}, "got 'mask', expected one word per axis"),
        ((FOUND, maps(1.0).replace(mask=None)), {}, "the truth has no mask"),
        ((Intrinsics(metallic=MASK), TRUE), {}, "no map that both sides have, expected at least one number"),
        ((PICTURES[0] * np.nan, PICTURES[1]), {"mask": MASK}, "the prediction has NaN or infinite values"),
        ((PICTURES[0], PICTURES[1] * np.nan), {"mask": MASK}, "the truth has NaN or infinite values"),
        ((PICTURES[0], PICTURES[1] * np.float64(1e300)), {"mask": MASK}, "the truth has NaN or infinite values"),
        (PICTURES, {"mask": np.where(MASK > 0, MASK, np.nan)}, "mask has NaN or infinite values, expected .* coverage"),
    ],
)
def test_what_it_refuses(arguments: tuple[Any, Any], options: dict[str, Any], said: str) -> None:
    with pytest.raises(UnirenderError, match=said):
        score(*arguments, **options)


def test_bright_pictures_are_scored_where_the_truth_is_bright() -> None:
    """Light and its maps are HDR, and may be of any exposure."""
    values = score(60 * PICTURES[0], 50 * PICTURES[1], mask=MASK, quantity="specular")
    assert values["specular.psnr@masked-linear-aligned"] > 0


def test_the_package_is_light_and_knows_its_names() -> None:
    code = "import sys, unirender_evaluation as u; u.Variant; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
    assert dir(unirender_evaluation) == sorted(unirender_evaluation.__all__)
    with pytest.raises(AttributeError, match="no attribute 'scores'"):
        unirender_evaluation.scores  # noqa: B018 - looked up to be refused
