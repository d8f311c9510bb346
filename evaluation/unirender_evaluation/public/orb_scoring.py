"""Stanford-ORB's tables and how an answer is scored, as the set's evaluation code does it (`public.metrics`).

Two points of that code are kept although they look odd, so that numbers can stand beside published ones: albedo is
compared in linear light under the name PSNR-L, and relit pictures, display values already, are encoded to sRGB once
more before LPIPS.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_encode
from unirender.errors import UnirenderError
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.metrics import Metric, Scale, Variant, metric_key
from unirender_evaluation.public.metrics import (
    COSINE_DISTANCE,
    DEPTH_SI_MSE,
    ORB_LPIPS_ALEX,
    ORB_LPIPS_VGG,
    ORB_SSIM,
    PEAK_HDR,
    PSNR_H,
    PSNR_L,
    OrbPsnr,
    cosine_distance,
    depth_si_mse,
    eroded,
    orb_ssim,
    psnr_h,
    psnr_l,
)
from unirender_evaluation.public.sets import Answer
from unirender_evaluation.tables.specs import Column, TableSpec

SCALES: Mapping[Scale, str] = {"aligned_rgb": "scaled", "raw": "raw"}
FLOORED = "_floored"  # behind a PSNR's name: 1 where its value is the benchmark's floor
RANGE_TOLERANCE = 1e-3  # of a stored albedo
LENGTH_TOLERANCE = 0.1  # of stored normals: means over blocks are a little shorter
MOST_OFF = 0.1  # share of the object whose normals may have another length: a scan has holes
Rgb = Float[np.ndarray, "h w 3"]
OneMask = Float[np.ndarray, "h w 1"]


def _columns(group: str, quantity: str, metrics: Sequence[Metric]) -> tuple[Column, ...]:
    return tuple(
        Column(f"{group}, {label}", quantity, metric, {"scale": scale}, published=False)
        for scale, label in SCALES.items()
        for metric in metrics
    )


MAPS_TABLE = TableSpec(
    "stanford-orb",
    "Stanford-ORB: maps",
    (
        *_columns("Albedo", "albedo", (PSNR_L, ORB_SSIM, ORB_LPIPS_VGG, ORB_LPIPS_ALEX)),
        Column("Normal", "normal", COSINE_DISTANCE, published=False),
        Column("Depth", "depth", DEPTH_SI_MSE, published=False),
    ),
    ("single-image",),
)
RELIT_TABLE = TableSpec(
    "stanford-orb-relighting",
    "Stanford-ORB: relighting",
    _columns("Relit", "relit", (PSNR_H, PSNR_L, ORB_SSIM, ORB_LPIPS_VGG, ORB_LPIPS_ALEX)),
    ("from-image-hdri",),
)
ABOUT = (
    ("scaled", "one least-squares factor per picture and channel, inside the mask, as in the benchmark; raw: none"),
    ("floor", "a PSNR below that of the constant 0.5 in the mask counts as that one, as in the benchmark"),
    ("SSIM", "window 3 x 3, of what PSNR-L compares"),
)
ABOUT_MAPS = (
    ("PSNR-L", "linear light, clipped at 1; mean over the frame, peak 1"),
    ("LPIPS", "v0.1, whole frame"),
    ("normals", "mean of 1 - cos"),
    ("depth", "mean over the frame of the squared error, one factor per picture (the benchmark: per capture)"),
)
ABOUT_RELIT = (
    (
        "PSNR-H",
        f"linear, both sides times mean(sRGB(truth)) / mean(truth), clipped at {PEAK_HDR:g}; mean over frame, peak 1",
    ),
    ("PSNR-L", "clipped at 1, sRGB; mean over the frame, peak 1"),
    ("LPIPS", "v0.1, whole frame, of pictures encoded to sRGB twice, as the benchmark's code does"),
)


def check_truth(name: str, inside: Float[np.ndarray, "n c"], source: str) -> None:
    """Looks whether a stored map is in its unit where it counts.

    Args:
        name: "normal", "albedo" or "depth", which has none.
        inside: its values in the eroded mask.
        source: the file, for the message.

    Raises:
        UnirenderError: an albedo leaves [0, 1], or more than a tenth of the normals are no unit vectors.
    """
    if name == "albedo" and (inside.min() < -RANGE_TOLERANCE or inside.max() > 1 + RANGE_TOLERANCE):
        raise UnirenderError(
            f"{source}: the albedo reaches from {inside.min():g} to {inside.max():g} on the object, expected linear "
            "values from 0 to 1"
        )
    if name == "normal":
        off = float((np.abs(np.linalg.norm(inside, axis=-1) - 1) > LENGTH_TOLERANCE).mean())
        if off > MOST_OFF:
            raise UnirenderError(
                f"{source}: {off:.0%} of the object's normals have another length than 1, expected unit vectors in "
                "camera axes (not (n + 1) / 2)"
            )


def score_relit(p: Rgb, t: Rgb, mask: OneMask, lpips: Sequence[Lpips]) -> dict[str, float]:
    """Values of a relit picture.

    Args:
        p: prediction, linear.
        t: truth, linear.
        mask: coverage of the truth, [0, 1].
        lpips: backbones to compute.
    """
    m, values = eroded(mask), {}
    for scale in SCALES:
        aligned = scale == "aligned_rgb"
        values |= _psnr_values("relit", PSNR_H, psnr_h(p, t, m, aligned), scale)
        values |= _picture_values("relit", psnr_l(p, t, m, aligned), scale, lpips)
    return values


def score_maps(
    answer: Answer, truths: Mapping[str, np.ndarray], mask: OneMask, lpips: Sequence[Lpips]
) -> dict[str, float]:
    """Values of the maps that both sides have.

    Args:
        answer: of a method.
        truths: "normal", "albedo" (linear), "depth", as far as they are there.
        mask: coverage of the truth, [0, 1].
        lpips: backbones to compute.
    """
    m, values, maps = eroded(mask), {}, answer.maps
    if maps is not None and maps.albedo is not None and "albedo" in truths:
        for scale in SCALES:
            compared = psnr_l(maps.albedo, truths["albedo"], m, scale == "aligned_rgb", encode=False)
            values |= _picture_values("albedo", compared, scale, lpips)
    if maps is not None and maps.normal is not None and "normal" in truths:
        values[metric_key("normal", COSINE_DISTANCE)] = cosine_distance(maps.normal, truths["normal"], m)
    if answer.depth is not None and "depth" in truths:
        values[metric_key("depth", DEPTH_SI_MSE)] = depth_si_mse(answer.depth, truths["depth"], m)
    return values


def _picture_values(quantity: str, compared: OrbPsnr, scale: Scale, lpips: Sequence[Lpips]) -> dict[str, float]:
    variant = Variant(scale=scale)
    values = _psnr_values(quantity, PSNR_L, compared, scale)
    values[metric_key(quantity, ORB_SSIM, variant)] = orb_ssim(compared.shown, compared.truth)
    shown, truth = srgb_encode(compared.shown), srgb_encode(compared.truth)
    for network in lpips:
        metric = {m.name: m for m in (ORB_LPIPS_VGG, ORB_LPIPS_ALEX)}[network.metric]
        values[metric_key(quantity, metric, variant)] = float(network.distance(shown[None], truth[None])[0])
    return values


def _psnr_values(quantity: str, metric: Metric, compared: OrbPsnr, scale: Scale) -> dict[str, float]:
    key = metric_key(quantity, metric, Variant(scale=scale))
    floored = float(compared.value == compared.floor)
    return {key: compared.value, key.replace(metric.name, metric.name + FLOORED): floored}
