"""Metrics: what each number is, which direction is better, and the plain functions behind it.

Notation: `p` prediction, `t` truth, `w` coverage weights in [0, 1] (the *true* mask). Masked figures are
coverage-weighted means, sum(w e) / sum(w); whole-frame figures are plain means over a composite (see `scoring`). All
functions take float arrays `[h, w, c]`, compute in float64 and return a float. There is no hidden floor: the PSNR of
identical images is inf.

A metric key names one number: `<quantity>.<metric>` and, behind an @, the variant axes that the metric has, in the
order mask, space, scale: `albedo.psnr@masked-srgb-raw`, `roughness.mse@masked`, `normal.cosine`.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_floats
from unirender.blocks import BLOCK
from unirender.errors import UnirenderError
from unirender.system.wording import meant, near

Mask = Literal["masked", "whole"]
Space = Literal["srgb", "linear"]
Scale = Literal["raw", "aligned", "aligned_rgb"]
MASKS: tuple[Mask, ...] = ("masked", "whole")
SPACES: tuple[Space, ...] = ("srgb", "linear")
SCALES: tuple[Scale, ...] = ("raw", "aligned", "aligned_rgb")
AXES = {"mask": MASKS, "space": SPACES, "scale": SCALES}  # of a `Variant`
LPIPS_SCALES: tuple[Scale, ...] = ("raw",)  # those that runs compute: with others, scoring takes half as long again

HIGHER, LOWER = True, False  # is better: `Metric.higher_is_better`, as tables of metrics say it
LOG_EPSILON = 0.01  # added before the logarithm, display units: a hundredth of display white


@dataclass(frozen=True)
class Variant:
    """How a number is taken.

    Attributes:
        mask: "masked" = coverage-weighted over the object; "whole" = whole frame over the declared background.
        space: "srgb" = display values; "linear" = linear light, both clipped to [0, 1].
        scale: "raw"; "aligned" = one least-squares factor per image; "aligned_rgb" = one per image and channel. Factors
            are fitted in linear light inside the true mask.
    """

    mask: Mask = "masked"
    space: Space = "srgb"
    scale: Scale = "raw"

    def __post_init__(self) -> None:
        for axis, words in AXES.items():
            if (word := getattr(self, axis)) not in words:
                raise UnirenderError(f"variant: got {axis} {word!r:.60}, expected one of {', '.join(words)}")

    @property
    def label(self) -> str:
        return f"{self.mask}-{self.space}-{self.scale}"

    @classmethod
    def parse(cls, text: str) -> "Variant":
        """Reads "masked-linear", "whole-srgb-aligned_rgb", ...; an axis that is left out keeps its default.

        Raises:
            UnirenderError: if a word is on no axis, or an axis is named twice.
        """
        axes: dict[str, str] = {}
        for word in text.split("-"):
            found = [axis for axis, words in AXES.items() if word in words]
            if not found or found[0] in axes:
                known = (*MASKS, *SPACES, *SCALES)
                close = [name for name in near(word, known) if name != word]
                raise UnirenderError(
                    f"variant {text!r}: got {word!r}, expected one word per axis of {', '.join(known)}, '-' between"
                    f"{meant(close)}"
                )
            axes[found[0]] = word
        return cls(**axes)  # pyright: ignore[reportArgumentType] - each word was looked up among its axis' values


DEFAULT_VARIANT = Variant()  # what we believe
PUBLISHED_VARIANT = Variant("whole")  # beside which the paper's numbers stand: its own, as far as it is known
ALL_VARIANTS = tuple(Variant(mask, space, scale) for mask in MASKS for space in SPACES for scale in SCALES)
ALL = "all"


def chosen_variants(texts: Iterable[str]) -> tuple[Variant, ...] | None:
    """What `--variant` asks for: each text a variant (`Variant.parse`) or "all"; None where there is none.

    Raises:
        UnirenderError: a text is no variant.
    """
    found = [variant for text in texts for variant in (ALL_VARIANTS if text == ALL else (Variant.parse(text),))]
    return tuple(dict.fromkeys(found)) or None


@dataclass(frozen=True)
class Metric:
    """One kind of number. The direction belongs here and nowhere else."""

    name: str  # as in metric keys
    label: str  # as in table headers
    unit: str  # "" for dimensionless
    higher_is_better: bool
    perfect: float  # value of a perfect prediction
    axes: tuple[str, ...] = ()  # the axes of `Variant` that the metric has, in the order mask, space, scale
    decimals: int = 4  # digits after the point in tables; ranks are taken on rounded values
    formula: str = ""  # one line for the protocol

    def better(self, a: float, b: float) -> bool:
        """Whether a is strictly better than b."""
        return a > b if self.higher_is_better else a < b

    @property
    def arrow(self) -> str:
        return "↑" if self.higher_is_better else "↓"


_ALL = ("mask", "space", "scale")
METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("psnr", "PSNR", "dB", HIGHER, math.inf, _ALL, 2, "-10 log10 MSE, peak 1, mean over images"),
        Metric("ssim", "SSIM", "", HIGHER, 1.0, _ALL, 4, "Wang et al. 2004, Gaussian 11 x 11, sigma 1.5"),
        Metric("lpips_vgg", "LPIPS-VGG", "", LOWER, 0.0, ("mask", "scale"), 4, "official v0.1; masked: pasted mask"),
        Metric("lpips_alex", "LPIPS-Alex", "", LOWER, 0.0, ("mask", "scale"), 4, "official v0.1; masked: pasted mask"),
        Metric("iou", "IoU", "", HIGHER, 1.0, (), 4, "sum of min(p, t) over sum of max(p, t), of masks"),
        Metric("mse", "MSE", "", LOWER, 0.0, ("mask",), 4, "mean squared error per pixel"),
        Metric("mse_object", "MSE (object)", "", LOWER, 0.0, (), 4, "squared difference of the in-mask means"),
        Metric("cosine", "cos", "", HIGHER, 1.0, (), 3, "coverage-weighted mean cosine of the angle between normals"),
        Metric("angle_deg", "angle", "deg", LOWER, 0.0, (), 1, "coverage-weighted mean angle between normals"),
        Metric("ciede2000", "CIEDE2000", "", LOWER, 0.0, ("scale",), 2, "coverage-weighted mean difference, D65"),
        Metric("log_rmse", "log-RMSE", "", LOWER, 0.0, ("scale",), 3, f"RMSE of ln(x + {LOG_EPSILON}), in mask, HDR"),
        Metric("rmse_relative", "error", "", LOWER, 0.0, ("scale",), 3, "RMSE over the truth's mean, in mask, HDR"),
    )
}


def metric_key(quantity: str, metric: Metric | str, variant: Variant = DEFAULT_VARIANT) -> str:
    """The key under which a value is recorded; axes that the metric does not have are left out."""
    metric = METRICS[metric] if isinstance(metric, str) else metric
    axes = "-".join(getattr(variant, axis) for axis in metric.axes)
    return f"{quantity}.{metric.name}" + (f"@{axes}" if axes else "")


OWN_MASK = metric_key("mask", "iou")  # recorded where maps were scored with a mask of the method's own


def pair(p: Any, t: Any) -> tuple[Float[np.ndarray, "h w c"], Float[np.ndarray, "h w c"]]:
    """Two pictures to compare, in float64.

    Raises:
        UnirenderError: one has the whole numbers of a file, there are several pictures, or shapes differ.
    """
    p, t = as_floats(p, "metric"), as_floats(t, "metric")
    if p.ndim != 3:
        raise UnirenderError(f"metric: got shape {p.shape}, expected one picture [h, w, c]; take the mean of several")
    if p.shape != t.shape:
        raise UnirenderError(f"metric: got shapes {p.shape} and {t.shape}, expected equal ones; resample one of them")
    return p.astype(np.float64), t.astype(np.float64)


def mse(
    p: Float[np.ndarray, "h w c"], t: Float[np.ndarray, "h w c"], w: Float[np.ndarray, "h w 1"] | None = None
) -> float:
    """Mean squared error; coverage-weighted where `w` is given.

    Raises:
        UnirenderError: as `pair`, or the weights sum to 0.
    """
    p, t = pair(p, t)
    error = np.square(p - t)
    return float(error.mean()) if w is None else weighted_mean(error.mean(axis=-1, keepdims=True), w)


def psnr_from_mse(error: float) -> float:
    """dB for a peak of 1; inf for an error of exactly 0."""
    return math.inf if error == 0 else -10 * math.log10(error)


def psnr(
    p: Float[np.ndarray, "h w c"], t: Float[np.ndarray, "h w c"], w: Float[np.ndarray, "h w 1"] | None = None
) -> float:
    """Peak signal-to-noise ratio of images in [0, 1]; inf if they are identical."""
    return psnr_from_mse(mse(p, t, w))


def weighted_mean(x: Float[np.ndarray, "*pixels 1"], w: Float[np.ndarray, "*pixels 1"]) -> float:
    """sum(w x) / sum(w).

    Raises:
        UnirenderError: the mask is empty or of another shape: [h w] beside [h w 1] would weight each row by all rows.
    """
    if x.shape != w.shape:
        raise UnirenderError(f"metric: got a mask of shape {w.shape}, expected {x.shape}; take mask[..., None]")
    total = float(w.sum(dtype=np.float64))
    if total <= 0:
        raise UnirenderError("metric: the true mask is empty, expected an object in the picture; drop the sample")
    return float((x * w.astype(np.float64)).sum() / total)


def cosine(p: Float[np.ndarray, "h w 3"], t: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 1"]:
    """Cosine of the angle between vectors of any length; 0 where one has no direction (length 0)."""
    p, t = p.astype(np.float64), t.astype(np.float64)
    lengths = np.linalg.norm(p, axis=-1, keepdims=True) * np.linalg.norm(t, axis=-1, keepdims=True)
    dot = (p * t).sum(axis=-1, keepdims=True)
    return np.clip(np.divide(dot, lengths, out=np.zeros_like(dot), where=lengths > 0), -1.0, 1.0)


def align_scale(
    p: Float[np.ndarray, "h w c"], t: Float[np.ndarray, "h w c"], w: Float[np.ndarray, "h w 1"], scale: Scale
) -> Float[np.ndarray, "h w c"]:
    """Multiplies the prediction (linear) by the least-squares factor sum(w p t) / sum(w p p), per image or channel.

    A prediction that is 0 everywhere (or in a channel) has no factor and stays as it is.
    """
    if scale == "raw":
        return p
    axes = (0, 1, 2) if scale == "aligned" else (0, 1)
    weighted = p.astype(np.float64) * w
    cross, power = (weighted * t).sum(axis=axes), (weighted * p).sum(axis=axes)
    return (p * np.divide(cross, power, out=np.ones_like(cross), where=power > 0)).astype(np.float32)


def log_rmse(p: Float[np.ndarray, "h w c"], t: Float[np.ndarray, "h w c"], w: Float[np.ndarray, "h w 1"]) -> float:
    """Root of the coverage-weighted mean of (ln(p + eps) - ln(t + eps))^2 for radiance >= 0, eps = `LOG_EPSILON`."""
    logs = [np.log(np.maximum(x.astype(np.float64), 0) + LOG_EPSILON) for x in (p, t)]
    return math.sqrt(mse(logs[0], logs[1], w))


def rmse_relative(p: Float[np.ndarray, "h w c"], t: Float[np.ndarray, "h w c"], w: Float[np.ndarray, "h w 1"]) -> float:
    """Root of the coverage-weighted mean of (p - t)^2, over the mean of t, linear.

    Raises:
        UnirenderError: the truth is black, or as `mse` does.
    """
    mean = weighted_mean(t.astype(np.float64).mean(axis=-1, keepdims=True), w)
    if not mean > 0:
        raise UnirenderError("metric: the truth is black, expected some light; drop the sample")
    return math.sqrt(mse(p, t, w)) / mean


def ciede2000(
    p_linear: Float[np.ndarray, "h w 3"], t_linear: Float[np.ndarray, "h w 3"], w: Float[np.ndarray, "h w 1"]
) -> float:
    """Coverage-weighted mean CIEDE2000 of linear Rec.709 colours in [0, 1] (reference white D65).

    Raises:
        UnirenderError: as `pair`, or the mask is empty or of another shape.
    """
    import colour  # 2 s to import, and only this function needs it

    p_linear, t_linear = pair(p_linear, t_linear)
    expected = (*p_linear.shape[:2], 1)
    if w.shape != expected:
        raise UnirenderError(f"metric: got a mask of shape {w.shape}, expected {expected}; take mask[..., None]")
    inside = w[..., 0] > 0
    space = colour.RGB_COLOURSPACES["ITU-R BT.709"]
    p, t, weights = p_linear[inside], t_linear[inside], w[inside]
    difference = np.empty(weights.shape)
    for start in range(0, len(p), BLOCK):
        part = slice(start, start + BLOCK)
        labs = [
            colour.XYZ_to_Lab(np.clip(x[part], 0, 1).astype(np.float64) @ space.matrix_RGB_to_XYZ.T, space.whitepoint)
            for x in (p, t)
        ]
        difference[part, 0] = colour.delta_E(labs[0], labs[1], method="CIE 2000")
    return weighted_mean(difference, weights)
