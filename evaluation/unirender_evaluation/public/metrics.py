"""Metrics of public test sets, each as its own benchmark defines it: written from the definitions, not from our own.

Notation: `p` prediction, `t` truth, `m` the benchmark's mask (0 or 1), all `[h, w, c]` float arrays.

    Stanford-ORB  Kuang et al. 2023: PSNR-H, PSNR-L, SSIM, LPIPS of relit pictures and albedo, each with a factor per
                  channel or without; cosine distance of normals; scale-invariant error of depth
    IIW           Bell et al. 2014: WHDR, the weighted share of people's judgements that an albedo contradicts
    MAW           Wu et al. 2023: intensity and chromaticity errors of albedo against measured patches

They differ from `metrics` on purpose: PSNR-H and PSNR-L divide by the whole frame, are never below what the constant
0.5 scores (the benchmark's own floor, which `OrbPsnr` tells), and SSIM has a window of 3 x 3.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Integer
from scipy.ndimage import binary_erosion, correlate1d

from unirender.color import srgb_encode
from unirender.errors import UnirenderError
from unirender_evaluation.metrics import HIGHER, LOWER, Metric, ciede2000, psnr_from_mse
from unirender_evaluation.ssim import SSIM_K1, SSIM_K2, SSIM_SIGMA

ERODED = 5  # pixels, side of the square by which Stanford-ORB shrinks its masks
PEAK_HDR, PEAK_LDR = 4.0, 1.0  # radiance at which PSNR-H and PSNR-L clip
NO_POWER = 1e-6  # a sum of squares below which no factor is fitted
DELTA = 0.10  # of WHDR: relative difference from which one of two points is darker
LEAST_REFLECTANCE = 1e-10

PSNR_H = Metric("psnr_h", "PSNR-H", "dB", HIGHER, math.inf, ("scale",), 2)
PSNR_L = Metric("psnr_l", "PSNR-L", "dB", HIGHER, math.inf, ("scale",), 2)
ORB_SSIM = Metric("ssim_3", "SSIM", "", HIGHER, 1.0, ("scale",), 4)
ORB_LPIPS_VGG = Metric("lpips_vgg", "LPIPS-VGG", "", LOWER, 0.0, ("scale",), 4)
ORB_LPIPS_ALEX = Metric("lpips_alex", "LPIPS-Alex", "", LOWER, 0.0, ("scale",), 4)
COSINE_DISTANCE = Metric("cosine_distance", "1 - cos", "", LOWER, 0.0, (), 4)
DEPTH_SI_MSE = Metric("si_mse", "SI-MSE", "", LOWER, 0.0, (), 5)
WHDR = Metric("whdr", "WHDR", "", LOWER, 0.0, (), 4)
INTENSITY = Metric("intensity", "si-MSE x 100", "", LOWER, 0.0, (), 3)
CHROMATICITY = Metric("chromaticity", "CIEDE2000", "", LOWER, 0.0, (), 3)

Rgb = Float[np.ndarray, "h w 3"]
OneMask = Float[np.ndarray, "h w 1"]


def eroded(mask: OneMask) -> OneMask:
    """1 where the mask exceeds one half in the whole square of `ERODED` pixels around; beyond the frame it counts."""
    inside = binary_erosion(mask[..., 0] > 0.5, np.ones((ERODED, ERODED)), border_value=1)
    return inside[..., None].astype(np.float32)


def channel_factors(p: Rgb, t: Rgb, m: OneMask) -> Float[np.ndarray, " 3"]:
    """Least-squares factor of each channel in the mask; 1 for a channel of p that is black (nothing can be fitted)."""
    power = (m * p.astype(np.float64) ** 2).sum(axis=(0, 1))
    cross = (m * p.astype(np.float64) * t).sum(axis=(0, 1))
    return np.divide(cross, power, out=np.ones(3), where=power > NO_POWER)


@dataclass(frozen=True)
class OrbPsnr:
    """Stanford-ORB's PSNR of one picture."""

    value: float  # dB, at least `floor`
    floor: float  # dB, of the constant 0.5 inside the mask: the benchmark prints no lower value
    shown: Rgb  # the prediction as compared: scaled, clipped, masked, encoded where PSNR-L encodes
    truth: Rgb  # the truth likewise


def orb_psnr(p: Rgb, t: Rgb, m: OneMask, *, peak: float, lift: bool, encode: bool, aligned: bool) -> OrbPsnr:
    """PSNR of linear pictures, black outside the mask, the mean taken over the whole frame.

    Args:
        p: prediction, linear.
        t: truth, linear.
        m: the eroded mask.
        peak: radiance at which both are clipped.
        lift: multiply both by mean(srgb(t)) / mean(t), of t clipped at 1, over the frame: linear pictures are dark
            (PSNR-H).
        encode: compare display values (PSNR-L).
        aligned: fit a factor per channel first.
    """
    p, t = np.maximum(p, 0) * m, np.maximum(t, 0) * m
    shown = np.clip(t, 0, 1)
    if lift and (mean := float(shown.mean(dtype=np.float64))) > 1e-8:
        factor = float(srgb_encode(shown).mean(dtype=np.float64)) / mean
        p, t = p * factor, t * factor
    if aligned:
        p = p * channel_factors(p, t, m)
    p, t = (np.clip(x, 0, peak).astype(np.float32) for x in (p, t))
    if encode:
        p, t = srgb_encode(p), srgb_encode(t)
    value, floor = _frame_psnr(p, t), _frame_psnr(np.repeat(np.float32(0.5) * m, 3, axis=-1), t)
    return OrbPsnr(max(value, floor), floor, p, t)


def _frame_psnr(p: Rgb, t: Rgb) -> float:
    return psnr_from_mse(float(np.square(p.astype(np.float64) - t).mean()))


def psnr_h(p: Rgb, t: Rgb, m: OneMask, aligned: bool) -> OrbPsnr:
    """PSNR-H: linear light, lifted, clipped at 4."""
    return orb_psnr(p, t, m, peak=PEAK_HDR, lift=True, encode=False, aligned=aligned)


def psnr_l(p: Rgb, t: Rgb, m: OneMask, aligned: bool, *, encode: bool = True) -> OrbPsnr:
    """PSNR-L: clipped at 1; display values of pictures, linear values of albedo (`encode=False`)."""
    return orb_psnr(p, t, m, peak=PEAK_LDR, lift=False, encode=encode, aligned=aligned)


def orb_ssim(p: Rgb, t: Rgb) -> float:
    """SSIM with a Gaussian window of 3 x 3 pixels (sigma 1.5), mean over frame and channels, borders mirrored."""
    weights = np.exp(-0.5 * (np.arange(-1, 2) / SSIM_SIGMA) ** 2)

    def blur(x: Rgb) -> Rgb:
        for axis in (0, 1):
            x = correlate1d(x, weights / weights.sum(), axis=axis, mode="mirror")
        return x

    p, t = p.astype(np.float64), t.astype(np.float64)
    mean_p, mean_t = blur(p), blur(t)
    var_p, var_t, covariance = blur(p * p) - mean_p**2, blur(t * t) - mean_t**2, blur(p * t) - mean_p * mean_t
    numerator = (2 * mean_p * mean_t + SSIM_K1**2) * (2 * covariance + SSIM_K2**2)
    return float((numerator / ((mean_p**2 + mean_t**2 + SSIM_K1**2) * (var_p + var_t + SSIM_K2**2))).mean())


def cosine_distance(p: Rgb, t: Rgb, m: OneMask) -> float:
    """Mean of 1 - cos over the mask; a vector without direction has the cosine 0."""
    lengths = np.linalg.norm(p, axis=-1) * np.linalg.norm(t, axis=-1)
    dot = (p.astype(np.float64) * t).sum(axis=-1)
    cosine = np.divide(dot, lengths, out=np.zeros_like(dot), where=lengths > 0)
    return float(((1 - cosine) * m[..., 0]).sum() / m.sum())


def depth_si_mse(p: OneMask, t: OneMask, m: OneMask) -> float:
    """Mean over the frame of m (a p - t)^2, with the factor a that makes it least; without power p counts as 1."""
    p = p.astype(np.float64) if (m * p.astype(np.float64) ** 2).sum() > NO_POWER else np.ones(p.shape)
    factor = (m * p * t).sum() / max((m * p * p).sum(), NO_POWER)
    return float((m * (factor * p - t) ** 2).mean())


@dataclass(frozen=True)
class Judgement:
    """What people said of two points of a photograph."""

    first: tuple[float, float]  # x and y of a point as fractions of width and height, from the top-left corner
    second: tuple[float, float]  # of the other
    darker: str  # "1" or "2", the point of darker reflectance; "E", about equal
    weight: float  # confidence, > 0


def judgements(content: Mapping[str, Any]) -> list[Judgement]:
    """The judgements of an IIW file that count: of opaque points, decided, with a positive weight.

    Raises:
        KeyError, TypeError, ValueError: the content has another layout.
        UnirenderError: a point lies outside the photograph, `opaque` is neither true nor false nor null (not known), or
            the weight of a judgement that would count is no finite number. (One of 0 or less does not count.)
    """
    points = {point["id"]: _point(point) for point in content["intrinsic_points"]}
    found = []
    for number, entry in enumerate(content["intrinsic_comparisons"]):
        (first, first_opaque), (second, second_opaque) = points[entry["point1"]], points[entry["point2"]]
        weight = entry["darker_score"]
        if entry["darker"] not in ("1", "2", "E") or weight is None or not (first_opaque and second_opaque):
            continue
        if not _in_range(weight, sys.float_info.max, least=-sys.float_info.max):
            raise UnirenderError(
                f"intrinsic_comparisons[{number}]: darker_score is {weight!r}, expected a finite number"
            )
        if weight > 0:
            found.append(Judgement(first, second, entry["darker"], float(weight)))
    return found


def _point(entry: Mapping[str, Any]) -> tuple[tuple[float, float], bool]:
    """Where a point of an IIW file is, and whether it is known to be opaque."""
    for axis, side in (("x", "width"), ("y", "height")):
        if not _in_range(entry[axis], 1):
            raise UnirenderError(
                f"intrinsic_points, id {entry['id']}: {axis} is {entry[axis]!r}, expected a fraction of the {side}, 0 "
                "to 1"
            )
    if entry["opaque"] is not None and not isinstance(entry["opaque"], bool):
        raise UnirenderError(
            f"intrinsic_points, id {entry['id']}: opaque is {entry['opaque']!r}, expected true, false or null"
        )
    return (float(entry["x"]), float(entry["y"])), entry["opaque"] is True


def _in_range(value: Any, most: float, least: float = 0) -> bool:
    """Whether a value of a JSON file is a number from `least` to `most`; NaN is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def whdr(albedo_linear: Rgb, judged: Sequence[Judgement]) -> dict[str, float]:
    """Weighted human disagreement rate of an albedo of any size.

    The reflectance of a point is the mean of its pixel's linear channels, at least `LEAST_REFLECTANCE`; point 1 is
    darker where r2 / r1 > 1 + `DELTA`, point 2 where r1 / r2 > 1 + `DELTA`, else they are equal.

    Returns:
        "whdr", sum of the contradicted weights over the sum of all, in [0, 1]; the same of the pairs that people called
        equal ("whdr_equal") and of the others ("whdr_unequal"), as far as there are any.
    """
    sums = {name: np.zeros(2) for name in ("whdr", "whdr_equal", "whdr_unequal")}
    for item in judged:
        r1, r2 = (_reflectance(albedo_linear, point) for point in (item.first, item.second))
        said = "1" if r2 / r1 > 1 + DELTA else "2" if r1 / r2 > 1 + DELTA else "E"
        counted = np.array([item.weight * (said != item.darker), item.weight])
        sums["whdr"] += counted
        sums["whdr_equal" if item.darker == "E" else "whdr_unequal"] += counted
    return {name: float(wrong / total) for name, (wrong, total) in sums.items() if total > 0}


def _reflectance(albedo_linear: Rgb, point: tuple[float, float]) -> float:
    height, width = albedo_linear.shape[:2]
    row, column = min(int(point[1] * height), height - 1), min(int(point[0] * width), width - 1)
    return max(LEAST_REFLECTANCE, float(albedo_linear[row, column].mean(dtype=np.float64)))


def segment_means(
    albedo_linear: Rgb, labels: Integer[np.ndarray, "h w"], which: Sequence[int]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Mean colour and number of pixels of each label in `which`; 0 where a label has no pixel."""
    counts = np.array([(labels == label).sum() for label in which], np.float64)
    means = [albedo_linear[labels == label].mean(axis=0) if (labels == label).any() else np.zeros(3) for label in which]
    return np.array(means, np.float64).reshape(-1, 3), counts


def intensity(p: Float[np.ndarray, "k 3"], t: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"]) -> float:
    """MAW's intensity error: weighted mean of (a p - t)^2 over segments, of grey values (channel means), one factor a.

    Returns:
        100 times the error, as it is printed in papers.
    """
    grey_p, grey_t = p.mean(axis=-1), t.mean(axis=-1)
    factor = (weights * grey_p * grey_t).sum() / max((weights * grey_p**2).sum(), NO_POWER)
    return float(100 * (weights * (factor * grey_p - grey_t) ** 2).sum() / weights.sum())


def chromaticity(p: Float[np.ndarray, "k 3"], t: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"]) -> float:
    """MAW's chromaticity error: weighted mean CIEDE2000 over segments, each brought to the truth's grey value first.

    Both are clipped at 1 on the way to display values, as the benchmark's code does.
    """
    grey_p, grey_t = p.mean(axis=-1, keepdims=True), t.mean(axis=-1, keepdims=True)
    scaled = p * (grey_p * grey_t / np.maximum(grey_p**2, NO_POWER))
    images = [x[None].astype(np.float32) for x in (scaled, t, weights[:, None])]
    return ciede2000(images[0], images[1], images[2])
