"""Scores of one prediction from a notebook or a training loop: the benchmark's numbers without a suite.

import unirender_evaluation
values = unirender_evaluation.score(prediction, truth, "masked-srgb-raw")
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.metrics import METRICS, Variant, metric_key

if TYPE_CHECKING:
    from unirender_evaluation.lpips import Lpips

Picture = Float[np.ndarray, "h w 3"]


def score(
    prediction: Any,
    truth: Any,
    protocol: Variant | str | None = None,
    *,
    mask: Any = None,
    lpips: Sequence[str] = (),
    quantity: str = "image",
) -> dict[str, float]:
    """Scores maps or a picture against the truth, by the functions that the benchmark itself uses.

    Args:
        prediction: `Intrinsics` of one picture, or a picture (h, w, 3): linear light, premultiplied, float. The mask of
            `Intrinsics`, if any, counts as the method's own in whole-frame figures.
        truth: the same kind, of the same size. Maps that either side lacks get no values; `Intrinsics` need a mask.
        protocol: how numbers are taken: "masked-srgb-raw", "whole-linear-aligned" and so on (what is left out is
            masked, srgb, raw), or a `Variant`; None: every variant at once.
        mask: coverage (h, w, 1) of a true picture, in [0, 1] or as booleans; `np.ones((h, w, 1))` where all of it
            counts. Not for `Intrinsics`, which have their own.
        lpips: backbones to compute, "alex" or "vgg". They need torch and take longer than all else together.
        quantity: what a picture's keys begin with.

    Returns:
        Metric key -> value: `albedo.psnr@masked-srgb-raw`, `normal.cosine`, ... The PSNR of identical pictures is inf.
        Two lights have the values of the benchmark's table of lights (`light_metrics.score_light`), which do not depend
        on how many texels a map has; a black one has none.

    Raises:
        UnirenderError: the two are of different kinds or sizes, a picture is not finite linear floats with the channels
            last, or clearly in other units than the truth (0 to 255, -1 to 1), a mask is missing or empty, a variant or
            backbone is unknown, or nothing is left to score; a picture
            or colour map is smaller than SSIM's window (11 pixels a side), or than what LPIPS takes (31).
    """
    from unirender_evaluation.scoring import score_image, score_maps

    variant = Variant.parse(protocol) if isinstance(protocol, str) else protocol
    if variant is not None:
        as_instance(variant, Variant, "score: protocol")
    options: dict[str, Any] = {
        "lpips": _networks(lpips),
        "lpips_scales": ("raw" if variant is None else variant.scale,),
    }
    for each in (prediction, truth):
        if isinstance(getattr(each, "intrinsics", None), Intrinsics):
            as_instance(each, Intrinsics, "score")
    if isinstance(prediction, Intrinsics) != isinstance(truth, Intrinsics):
        got = f"{type(prediction).__name__} and {type(truth).__name__}"
        raise UnirenderError(f"score: got {got}, expected two unirender.Intrinsics or two pictures")
    if isinstance(prediction, Intrinsics):
        if mask is not None:
            raise UnirenderError("score: got maps and mask=, expected the coverage in the truth's own mask")
        maps = (each.replace(environment=None) for each in (prediction, truth))
        values = score_maps(*maps, **options) | _light_values(prediction, truth)
    else:
        values = score_image(*_checked_pictures(prediction, truth, mask), quantity=quantity, **options)
    chosen = values if variant is None else {key: value for key, value in values.items() if _is_of(key, variant)}
    if not chosen:
        what = "no map that both sides have" if not values else f"no value under {variant and variant.label}"
        raise UnirenderError(f"score: {what}, expected at least one number")
    return chosen


def _checked_pictures(prediction: Any, truth: Any, mask: Any) -> tuple[Picture, Picture, Float[np.ndarray, "h w 1"]]:
    """The two pictures, of one size and in the same units, and the true coverage."""
    from unirender_evaluation.methods.plausible import range_doubt

    if mask is None:
        raise UnirenderError(
            "score: pictures need mask=, the true coverage (h, w, 1); np.ones((h, w, 1)) where all of it counts"
        )
    p, t = _picture(prediction, "the prediction"), _picture(truth, "the truth")
    if p.shape != t.shape:
        raise UnirenderError(
            f"score: got pictures of {p.shape} and {t.shape}, expected the same (h, w, c); resample the prediction"
        )
    coverage = _mask(mask, t)
    usual = max(float(np.median(t[coverage[..., 0] > 0])), 1.0)
    doubt = range_doubt(p, coverage, usual)
    if doubt is not None and range_doubt(t, coverage, usual) is None:  # a truth of such values has other units, too
        raise UnirenderError(f"score: the prediction is in other units than the truth: {doubt}; convert it")
    return p, t, coverage


def _networks(backbones: Sequence[str]) -> "list[Lpips]":
    if isinstance(backbones, str) or not isinstance(backbones, Sequence):
        name = backbones if isinstance(backbones, str) else "vgg"
        raise UnirenderError(f"score: got lpips={backbones!r:.60}, expected a list of names: lpips=[{name!r}]")
    if not backbones:
        return []
    from unirender_evaluation.lpips import load

    return [load(name) for name in backbones]


def _light_values(found: Intrinsics, true: Intrinsics) -> dict[str, float]:
    """Values of the light, where both have one that is not black."""
    from unirender_evaluation.light_metrics import score_light

    lights = [each.environment for each in (found, true)]
    return score_light(found, true) if all(light is not None and light.max() > 0 for light in lights) else {}


def _is_of(key: str, variant: Variant) -> bool:
    """Whether a metric key is how its quantity and metric are named under a variant."""
    quantity, _, rest = key.partition(".")
    name, _, axes = rest.partition("@")
    return not axes or metric_key(quantity, METRICS[name], variant) == key


def _picture(value: Any, what: str) -> Picture:
    return _array(value, what, 3, "linear light, premultiplied; `unirender.color.srgb_decode` decodes display values")


def _mask(value: Any, truth: Picture) -> Float[np.ndarray, "h w 1"]:
    if isinstance(value, np.ndarray) and value.dtype == bool:
        value = value.astype(np.float32)
    found = _array(value, "mask", 1, "coverage in [0, 1]")
    if found.shape[:2] != truth.shape[:2]:
        raise UnirenderError(
            f"score: got a mask of {found.shape[:2]} and a truth of {truth.shape[:2]} pixels, expected the same; "
            "resample the mask"
        )
    if found.min() < 0 or found.max() > 1:
        raise UnirenderError(f"score: mask is in [{found.min():g}, {found.max():g}], expected coverage in [0, 1]")
    return found


def _array(value: Any, what: str, channels: int, meaning: str) -> Float[np.ndarray, "h w c"]:
    """A float array `[h, w, channels]`, or a sentence that says why it is none."""
    if hasattr(value, "detach"):
        raise UnirenderError(
            f"score: {what} is a torch tensor, expected a numpy array with the channels last: "
            "`x.detach().cpu().movedim(-3, -1).numpy()` of one picture"
        )
    if isinstance(getattr(value, "mean", None), np.ndarray):
        raise UnirenderError(f"score: {what} is {type(value).__name__}, expected an array, as its `mean` is")
    found = np.asarray(value)
    wanted = f"floats of shape (h, w, {channels}), {meaning}"
    if found.ndim == 3 and (found.shape[-1], channels) == (4, 3):
        wanted += "; the alpha of a render is left out by [..., :3]"
    if found.ndim == 3 and found.shape[-1] != channels and found.shape[0] == channels:
        wanted += "; the channels come last"
    if found.ndim == 4:
        wanted += "; score one picture at a time"
    if found.dtype.kind != "f" or found.ndim != 3 or found.shape[-1] != channels:
        raise UnirenderError(f"score: {what} is {found.dtype} of shape {found.shape}, expected {wanted}")
    with np.errstate(over="ignore"):  # what overflows is infinite
        values = found.astype(np.float32)
    if not np.isfinite(values).all():
        raise UnirenderError(f"score: {what} has NaN or infinite values, expected finite ones: {meaning}")
    return values
