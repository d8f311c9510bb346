"""Scores of a prediction against the truth: every variant of every metric at once, as one flat dict.

Compositing (DESIGN, "Edges and background"). *Masked* figures compare un-premultiplied maps and weight by the true
coverage. *Whole-frame* figures composite in linear light, then clip, then encode: white behind image, albedo, specular
and diffuse light, 0 behind materials; found maps with the prediction's own mask, or with the true one pasted where it
has none, or returns the one that it was given. An own mask has a value itself, `mask.iou`, by which records and the
protocol line tell the two. SSIM and LPIPS look at neighbourhoods: their
masked variants compare whole-frame composites with the true mask pasted on both sides; SSIM then weights its map by
coverage, LPIPS (which has no map) stays a mean over the frame.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance
from unirender.color import srgb_encode, unpremultiply
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.system.machine import memory_excess
from unirender_evaluation import metrics
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.metrics import (
    LPIPS_SCALES,
    MASKS,
    OWN_MASK,
    SCALES,
    SPACES,
    Mask,
    Scale,
    Space,
    Variant,
    metric_key,
)
from unirender_evaluation.ssim import crop_border, ssim_map

Rgb = Float[np.ndarray, "h w 3"]
Weights = Float[np.ndarray, "h w 1"]
COLOURS = ("albedo", "specular", "diffuse")
MATERIALS = ("roughness", "metallic")
IMAGE_BYTES_A_PIXEL, MAPS_BYTES_A_PIXEL, BYTES_OF_NONE = 420, 570, 3e8  # of memory, what is scored included
LPIPS_BYTES_A_PIXEL = {"alex": 80, "vgg": 1420}  # beside that
LARGE = 2**20  # pixels from which they are looked at
SAME_MASK = 1 / 255  # largest difference of a mask that was stored in 8 bits, whether rounded or cut off


def score_maps(
    prediction: Intrinsics,
    truth: Intrinsics,
    *,
    lpips: Sequence[Lpips] = (),
    lpips_scales: Sequence[Scale] = LPIPS_SCALES,
) -> dict[str, float]:
    """Scores every map, but for the light, that prediction and truth both have.

    Args:
        prediction: one picture's intrinsics `[h, w, c]`; maps that are None get no values.
        truth: the same at the same size, with its mask.
        lpips: backbones to compute; a backbone left out has no values (the cell says n/a).
        lpips_scales: scale alignments for which LPIPS is computed.

    Returns:
        Metric key -> value, for the quantities albedo, specular, diffuse, roughness, metallic, normal; and mask, where
        the prediction has one of its own. Lights have metrics of their own (`light_metrics.score_light`).

    Raises:
        UnirenderError: if the truth has no mask or an empty one, sizes differ, or the machine is too small for them.
    """
    as_instance(prediction, Intrinsics, "prediction")
    w = _truth_mask(as_instance(truth, Intrinsics, "truth").mask)
    _check_memory("maps", w, MAPS_BYTES_A_PIXEL, lpips)
    own = _own_mask(prediction.mask, w)
    values: dict[str, float] = {}
    if own is not w:
        values[OWN_MASK] = float(np.minimum(own, w).sum() / np.maximum(own, w).sum())
    for name in COLOURS:
        p, t = getattr(prediction, name), getattr(truth, name)
        if p is None or t is None:
            continue
        _check_shapes(name, p, t)
        values |= score_colour(name, p, t, w, own, SCALES, lpips, lpips_scales)
        for scale in SCALES:
            aligned, variant = metrics.align_scale(p, t, w, scale), Variant(scale=scale)
            if name == "albedo":
                values[metric_key(name, "ciede2000", variant)] = metrics.ciede2000(aligned, t, w)
            else:
                values[metric_key(name, "log_rmse", variant)] = metrics.log_rmse(aligned, t, w)
    for name in MATERIALS:
        p, t = getattr(prediction, name), getattr(truth, name)
        if p is not None and t is not None:
            _check_shapes(name, p, t)
            values[metric_key(name, "mse", Variant("masked"))] = metrics.mse(p, t, w)
            values[metric_key(name, "mse", Variant("whole"))] = metrics.mse(p * own, t * w)
            difference = metrics.weighted_mean(p, w) - metrics.weighted_mean(t, w)
            values[metric_key(name, "mse_object")] = difference**2
    if prediction.normal is not None and truth.normal is not None:
        _check_shapes("normal", prediction.normal, truth.normal)
        cosine = metrics.cosine(prediction.normal, truth.normal)
        values[metric_key("normal", "cosine")] = metrics.weighted_mean(cosine, w)
        values[metric_key("normal", "angle_deg")] = metrics.weighted_mean(np.degrees(np.arccos(cosine)), w)
    return values


def score_image(
    prediction_linear: Rgb,
    truth_linear: Rgb,
    truth_mask: Weights,
    *,
    prediction_mask: Weights | None = None,
    quantity: str = "relit",
    lpips: Sequence[Lpips] = (),
    lpips_scales: Sequence[Scale] = LPIPS_SCALES,
) -> dict[str, float]:
    """Scores a rendered image.

    Args:
        prediction_linear: premultiplied linear RGB, background 0.
        truth_linear: the same.
        truth_mask: coverage of the truth.
        prediction_mask: the method's own coverage; None pastes the true one.
        quantity: name in the metric keys: "relit", "edit_metallic", "edit_roughness".
        lpips: backbones to compute.
        lpips_scales: scale alignments for which LPIPS is computed.

    Returns:
        Metric key -> value, all variants.

    Raises:
        UnirenderError: if the mask is empty, sizes differ, the prediction is not finite, or the machine is too small.
    """
    w = _truth_mask(truth_mask)
    _check_memory(quantity, w, IMAGE_BYTES_A_PIXEL, lpips)
    own = _own_mask(prediction_mask, w)
    _check_shapes(quantity, prediction_linear, truth_linear)
    p, t = (unpremultiply(x, m) for x, m in ((prediction_linear, own), (truth_linear, w)))
    return score_colour(quantity, p, t, w, own, SCALES, lpips, lpips_scales)


def over_white(colour: Rgb, mask: Weights) -> Rgb:
    """Composite of an un-premultiplied linear map over white; not clipped."""
    return colour * mask + (1 - mask)


def score_colour(
    quantity: str,
    p: Rgb,
    t: Rgb,
    w: Weights,
    own: Weights,
    scales: Sequence[Scale],
    lpips: Sequence[Lpips] = (),
    lpips_scales: Sequence[Scale] = LPIPS_SCALES,
) -> dict[str, float]:
    """PSNR, SSIM and LPIPS of un-premultiplied linear maps, all variants; `own` is the prediction's mask."""
    values: dict[str, float] = {}
    aligned = {scale: metrics.align_scale(p, t, w, scale) for scale in scales}
    # With the true mask pasted, masked and whole composites are one picture: it is compared once.
    masks: dict[Mask, Weights] = {"masked": w} if own is w else {"masked": w, "whole": own}
    frames = np.stack([over_white(aligned[scale], mask) for mask in masks.values() for scale in scales])
    names: list[tuple[Mask, Scale]] = [(mask, scale) for mask in masks for scale in scales]
    truth = over_white(t, w)
    for space in SPACES:
        shown, shown_truth = _display(frames, space), _display(truth, space)
        similarity = dict(zip(names, ssim_map(shown, shown_truth[None]), strict=True))
        pictures = dict(zip(names, shown, strict=True))
        truth_map = _display(t, space)
        for scale in scales:
            masked, whole = Variant("masked", space, scale), Variant("whole", space, scale)
            in_whole = ("masked" if own is w else "whole", scale)
            values[metric_key(quantity, "psnr", masked)] = metrics.psnr(_display(aligned[scale], space), truth_map, w)
            values[metric_key(quantity, "psnr", whole)] = metrics.psnr(pictures[in_whole], shown_truth)
            similarity_masked = similarity["masked", scale][..., None]
            values[metric_key(quantity, "ssim", masked)] = metrics.weighted_mean(similarity_masked, w)
            values[metric_key(quantity, "ssim", whole)] = float(crop_border(similarity[in_whole]).mean())
        if space == "srgb":
            compared = {name: picture for name, picture in pictures.items() if name[1] in lpips_scales}
            values |= _lpips_values(quantity, lpips, compared, shown_truth, pasted=own is w)
    return values


def _lpips_values(
    quantity: str, networks: Sequence[Lpips], pictures: dict[tuple[Mask, Scale], Rgb], truth: Rgb, *, pasted: bool
) -> dict[str, float]:
    """LPIPS of display pictures over white; with the true mask `pasted` each is the masked and the whole one."""
    values: dict[str, float] = {}
    if not pictures:
        return values
    shown = np.stack(list(pictures.values()))
    for network in networks:
        for (own, scale), distance in zip(pictures, network.distance(shown, truth[None]), strict=True):
            for mask in MASKS if pasted else (own,):
                values[metric_key(quantity, network.metric, Variant(mask, "srgb", scale))] = float(distance)
    return values


def _display(linear: Float[np.ndarray, "*n h w 3"], space: Space) -> Float[np.ndarray, "*n h w 3"]:
    clipped = np.clip(linear, 0, 1)
    return srgb_encode(clipped) if space == "srgb" else clipped


def _truth_mask(mask: Weights | None) -> Weights:
    if mask is None or not mask.any():
        what = "no mask" if mask is None else "an empty mask"
        raise UnirenderError(f"scoring: the truth has {what}, expected coverage in [0, 1] with an object in it")
    return mask


def _check_memory(what: str, mask: Weights, bytes_a_pixel: int, lpips: Sequence[Lpips]) -> None:
    """Refuses what the machine is too small for: in one sentence instead of an end without a word."""
    pixels = mask.shape[0] * mask.shape[1]
    if pixels < LARGE:
        return
    taken = bytes_a_pixel + max((LPIPS_BYTES_A_PIXEL[network.backbone] for network in lpips), default=0)
    if excess := memory_excess(BYTES_OF_NONE + taken * pixels):
        fewer = ", or leave out LPIPS" if lpips else ""
        raise UnirenderError(
            f"scoring {what}: {pixels / 1e6:,.3g} megapixels, which {excess}; scale both sides down{fewer}"
        )


def _own_mask(mask: Weights | None, truth: Weights) -> Weights:
    """The truth's very array where the method has no mask of its own, or the same one as far as 8 bits can tell."""
    if mask is None:
        return truth
    _check_shapes("mask", mask, truth)
    return truth if np.abs(mask - truth).max() <= SAME_MASK + 1e-6 else mask


def _check_shapes(name: str, p: np.ndarray, t: np.ndarray) -> None:
    if p.shape != t.shape or p.ndim != 3:
        raise UnirenderError(
            f"scoring {name}: got shapes {p.shape} and {t.shape}, expected the same (h, w, c); resample the prediction"
        )
    if not np.isfinite(p).all():
        raise UnirenderError(f"scoring {name}: the prediction has NaN or infinite values, expected finite ones")
