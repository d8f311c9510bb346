"""Metrics of public test sets: values computed by hand, and a twin of each that must score worse."""

import math

import numpy as np
import pytest

from unirender.color import srgb_encode
from unirender.errors import UnirenderError
from unirender_evaluation.public.metrics import (
    Judgement,
    channel_factors,
    chromaticity,
    cosine_distance,
    depth_si_mse,
    eroded,
    intensity,
    judgements,
    orb_ssim,
    psnr_h,
    psnr_l,
    segment_means,
    whdr,
)

ONES = np.ones((4, 4, 1), np.float32)


def display(linear: float) -> float:
    return float(srgb_encode(np.array(linear, np.float32)))


def flat(*rgb: float, side: int = 4) -> np.ndarray:
    return np.broadcast_to(np.array(rgb, np.float32), (side, side, 3)).copy()


def test_the_mask_shrinks_by_two_pixels_inside_the_frame_and_not_at_its_border() -> None:
    mask = np.zeros((9, 9, 1), np.float32)
    mask[1:8, 1:8] = 1
    assert eroded(mask)[..., 0].sum() == 9
    assert eroded(np.ones((9, 9, 1), np.float32)).sum() == 81
    assert eroded(mask * 0.5).sum() == 0  # half is not over half


def test_psnr_l_is_of_display_values_over_the_whole_frame() -> None:
    m = ONES.copy()
    m[2:] = 0  # half of the frame
    found = psnr_l(flat(0.7, 0.7, 0.7), flat(0.8, 0.8, 0.8), m, aligned=False)
    error = (display(0.8) - display(0.7)) ** 2 / 2
    assert found.value == pytest.approx(-10 * math.log10(error), abs=1e-4)
    linear = psnr_l(flat(0.7, 0.7, 0.7), flat(0.8, 0.8, 0.8), m, aligned=False, encode=False)
    assert linear.value == pytest.approx(-10 * math.log10(0.01 / 2), abs=1e-4)
    assert psnr_l(flat(0.7, 0.7, 0.7), flat(0.8, 0.8, 0.8), m, aligned=True).value == math.inf


def test_psnr_h_lifts_both_sides_and_clips_at_4() -> None:
    t = flat(0.8, 0.8, 0.8)
    lift = display(0.8) / 0.8
    found = psnr_h(flat(0.9, 0.8, 0.8), t, ONES, aligned=False)
    assert found.value == pytest.approx(-10 * math.log10((0.1 * lift) ** 2 / 3), abs=1e-3)
    bright = flat(9.0, 9.0, 9.0)
    assert psnr_h(bright, flat(7.0, 7.0, 7.0), ONES, aligned=False).value == math.inf  # both clipped
    found = psnr_h(flat(1.5, 1.5, 1.5), flat(2.0, 2.0, 2.0), ONES, aligned=False)
    assert found.value == pytest.approx(-10 * math.log10(0.25), abs=1e-3)  # lift 1: both means are of white


def test_no_psnr_is_below_that_of_the_constant_one_half() -> None:
    found = psnr_l(flat(1.0, 1.0, 1.0), flat(0.0, 0.0, 0.0), ONES, aligned=False)
    assert found.value == found.floor == pytest.approx(-10 * math.log10(0.25), abs=1e-4)
    close = psnr_l(flat(0.1, 0.1, 0.1), flat(0.0, 0.0, 0.0), ONES, aligned=False, encode=False)
    assert close.value == pytest.approx(20, abs=1e-3)
    assert close.value > close.floor


def test_a_factor_per_channel_undoes_a_tint_and_no_gradient() -> None:
    t = np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    tint = np.array([0.5, 2.0, 0.8], np.float32)
    assert channel_factors(t * tint, t, ONES) == pytest.approx(1 / tint, rel=1e-5)
    assert psnr_l(t * tint, t, ONES, aligned=True, encode=False).value > 100
    gradient = t * np.linspace(0.5, 1.5, 4, dtype=np.float32)[:, None, None]
    assert psnr_l(gradient, t, ONES, aligned=True, encode=False).value < 25
    assert channel_factors(np.zeros_like(t), t, ONES).tolist() == [1, 1, 1]


def test_ssim_of_constants_and_of_a_single_pixel_by_hand() -> None:
    a, b = flat(0.5, 0.5, 0.5), flat(0.25, 0.25, 0.25)
    expected = (2 * 0.5 * 0.25 + 1e-4) / (0.5**2 + 0.25**2 + 1e-4)  # means alone; variances are 0
    assert orb_ssim(a, b) == pytest.approx(expected, abs=1e-6)
    assert orb_ssim(a, a) == pytest.approx(1)
    # one bright pixel in the middle of 3 x 3, against black: the centre's window, weights g x g
    g = np.exp(-0.5 * np.array([1, 0, 1]) / 1.5**2)
    g /= g.sum()
    t = np.zeros((3, 3, 3), np.float32)
    t[1, 1] = 1
    mirrored = np.array([2 * g[0], g[1], 2 * g[0]])  # weight of the pixel as rows 0, 1, 2 see it
    mean = np.outer(mirrored, mirrored)
    variance = mean - mean**2
    by_hand = (1e-4 * 9e-4) / ((mean**2 + 1e-4) * (variance + 9e-4))
    assert orb_ssim(np.zeros_like(t), t) == pytest.approx(by_hand.mean(), rel=1e-5)


def test_cosine_distance_by_hand() -> None:
    t, p = flat(0, 0, 1), flat(0, 0, 5)
    p[:2] = (0, 1, 1)  # 45 degrees off in half of the frame
    assert cosine_distance(p, t, ONES) == pytest.approx((1 - math.sqrt(0.5)) / 2)
    assert cosine_distance(-t, t, ONES) == pytest.approx(2)
    assert cosine_distance(0 * t, t, ONES) == pytest.approx(1)


def test_depth_is_compared_up_to_a_factor() -> None:
    t = np.arange(1, 17, dtype=np.float32).reshape(4, 4, 1)
    assert depth_si_mse(t / 7, t, ONES) == pytest.approx(0, abs=1e-9)
    half = ONES.copy()
    half[2:] = 0
    ones = np.ones_like(t)
    expected = ((t[:2] - 4.5) ** 2).sum() / 16  # the mean of 1..8 is the best constant; over the whole frame
    assert depth_si_mse(ones, t, half) == pytest.approx(expected)
    for mask in (half, ONES):  # nothing predicted counts as a constant
        assert depth_si_mse(0 * t, t, mask) == pytest.approx(depth_si_mse(ones, t, mask))
    assert depth_si_mse(t[::-1], t, ONES) > 1


LEFT, RIGHT = (0.25, 0.5), (0.75, 0.5)


def halves(left: float, right: float) -> np.ndarray:
    albedo = np.full((4, 8, 3), left, np.float32)
    albedo[:, 4:] = right
    return albedo


def test_whdr_counts_weights_of_contradicted_judgements() -> None:
    judged = [Judgement(LEFT, RIGHT, "1", 3.0), Judgement(RIGHT, LEFT, "E", 1.0)]
    assert whdr(halves(0.2, 0.4), judged) == {"whdr": 0.25, "whdr_equal": 1.0, "whdr_unequal": 0.0}
    swapped = [Judgement(LEFT, RIGHT, "2", 3.0), Judgement(RIGHT, LEFT, "E", 1.0)]
    assert whdr(halves(0.2, 0.4), swapped)["whdr"] == 1.0
    assert whdr(halves(0.3, 0.3), judged)["whdr"] == 0.75
    assert whdr(halves(0.3, 0.3), []) == {}


def test_whdr_begins_at_ten_per_cent_of_the_channels_mean() -> None:
    judged = [Judgement(LEFT, RIGHT, "1", 1.0)]
    assert whdr(halves(0.5, 0.5 * 1.099), judged)["whdr"] == 1.0
    assert whdr(halves(0.5, 0.5 * 1.101), judged)["whdr"] == 0.0
    albedo = halves(0.3, 0.3)
    albedo[:, 4:] = (0.9, 0.0, 0.0)  # the mean of the channels is the same, the luminance is not
    assert whdr(albedo, judged)["whdr"] == 1.0
    assert whdr(halves(0.0, 0.0), [Judgement(LEFT, (1.0, 1.0), "E", 1.0)])["whdr"] == 0.0  # black, and at the border


def test_only_decided_opaque_judgements_with_a_weight_count() -> None:
    points = [{"id": i, "x": 0.5, "y": 0.5, "opaque": i != 2} for i in range(3)]

    def pair(first: int, second: int, darker: str | None, weight: float | None) -> dict:
        return {"point1": first, "point2": second, "darker": darker, "darker_score": weight}

    content = {
        "intrinsic_points": points,
        "intrinsic_comparisons": [
            pair(0, 1, "1", 0.5),
            pair(0, 2, "1", 0.5),
            pair(0, 1, None, 0.5),
            pair(0, 1, "2", 0.0),
            pair(0, 1, "2", -0.2),
            pair(0, 1, "E", None),
        ],
    }
    assert judgements(content) == [Judgement((0.5, 0.5), (0.5, 0.5), "1", 0.5)]


def changed_judgements(point: dict, weight: object = 1.0, opaque_points: bool = True) -> dict:
    """A file of one judgement, its first point changed."""
    points = [{"id": i, "x": 0.5, "y": 0.5, "opaque": opaque_points} for i in range(2)]
    points[0] |= point
    pairs = [{"point1": 0, "point2": 1, "darker": "1", "darker_score": weight}]
    return {"intrinsic_points": points, "intrinsic_comparisons": pairs}


@pytest.mark.parametrize(
    "value", [-0.01, 1.01, 40.0, math.nan, math.inf, "0.5", None, True, pytest.param(10**400, id="huge")]
)
@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_point_outside_its_photograph_is_refused(axis: str, value: object) -> None:
    with pytest.raises(UnirenderError, match=rf"^intrinsic_points, id 0: {axis} is .*, expected a fraction"):
        judgements(changed_judgements({axis: value}))
    assert len(judgements(changed_judgements({axis: 1}))) == len(judgements(changed_judgements({axis: 0}))) == 1


@pytest.mark.parametrize("weight", [math.inf, math.nan, "2.0", True, pytest.param(10**400, id="huge")])
def test_a_weight_that_cannot_be_summed_is_refused(weight: object) -> None:
    with pytest.raises(UnirenderError, match=r"^intrinsic_comparisons\[0\]: darker_score is .* finite number$"):
        judgements(changed_judgements({}, weight))
    assert judgements(changed_judgements({}, weight, opaque_points=False)) == []  # it would not count


@pytest.mark.parametrize("opaque", ["false", "true", 0, 1, []])
def test_opaque_is_true_or_false(opaque: object) -> None:
    with pytest.raises(UnirenderError, match=r"^intrinsic_points, id 0: opaque is .*, expected true, false or null$"):
        judgements(changed_judgements({"opaque": opaque}))
    assert judgements(changed_judgements({"opaque": None})) == judgements(changed_judgements({"opaque": False})) == []


def test_intensity_by_hand() -> None:
    t = np.array([[0.2] * 3, [0.4] * 3])
    weights = np.array([3.0, 1.0])
    assert intensity(t * 2.5, t, weights) == pytest.approx(0, abs=1e-12)
    p = np.array([[0.4] * 3, [0.4] * 3])  # flat: the best factor is (3 * .2 + .4) / (4 * .4) = 0.625, both are 0.25
    assert intensity(p, t, weights) == pytest.approx(100 * (3 * 0.05**2 + 0.15**2) / 4)
    assert intensity(t[::-1], t, weights) > intensity(p, t, weights)
    assert intensity(t * [0.5, 1, 1.5], t, weights) == pytest.approx(0, abs=1e-12)  # colour is no part of it


def test_chromaticity_by_hand() -> None:
    t = np.array([[0.4, 0.2, 0.3], [0.3, 0.3, 0.3]])
    weights = np.array([1.0, 3.0])
    assert chromaticity(t * [[0.3], [2.0]], t, weights) == pytest.approx(0, abs=1e-4)  # a factor for each
    grey = np.full((2, 3), 0.5)
    import colour

    labs = [colour.XYZ_to_Lab(colour.sRGB_to_XYZ(srgb_encode(c))) for c in (np.array([0.3] * 3), t[0])]
    assert chromaticity(grey, t, weights) == pytest.approx(float(colour.delta_E(labs[0], labs[1])) / 4, abs=0.01)
    bright, white = np.array([[0.3, 0.25, 0.2]]), np.array([[0.85, 0.85, 0.85]])
    once = np.ones(1)
    assert chromaticity(bright, white, once) == pytest.approx(10.33, abs=0.01)
    assert chromaticity(bright, white, once) < 10.5  # 10.70 without the clip at 1
    green = t[:, [1, 0, 2]]  # where the first surface is magenta
    assert chromaticity(green, t, weights) > chromaticity(grey, t, weights)


def test_means_over_segments() -> None:
    labels = np.array([[0, 2], [2, 5]], np.uint8)
    albedo = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    means, counts = segment_means(albedo, labels, [2, 5, 6])
    assert counts.tolist() == [2, 1, 0]
    assert means.tolist() == [[4.5, 5.5, 6.5], [9, 10, 11], [0, 0, 0]]
