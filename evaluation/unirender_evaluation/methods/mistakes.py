"""Usual mistakes of predictions: by how many dB a stranger's answer is nearer to the truth once one is undone.

One answer tells little: a bad albedo may be nearer to the truth upside down. Over many pictures an answer that is
sound, however bad, is further away. So all gains are recorded, and a note judges them together (`tables.mistakes`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode, srgb_encode
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender_evaluation import metrics
from unirender_evaluation.light_metrics import DIMMEST, SHAPE, scaled_log_rmse
from unirender_evaluation.methods.method import Mask
from unirender_evaluation.metrics import LOWER, Metric, metric_key

Map = Float[np.ndarray, "h w c"]
Light = Float[np.ndarray, "h w 3"]
EXACT = 1e-9  # error of what is right but for rounding
MOST_DB = 20.0  # of a gain: a few answers that are exact otherwise do not outvote the others
WHITE = (0.9, 1.01)  # where the brightest value of a light of 8 bits lies, resampled or not
BRIGHT = 2.0  # that of a true light which 8 bits do not hold
TONE, PLACE = 4.0, 1.0  # mean dB that tell: a biased map gains by another scale, too, but by no other side or axes


@dataclass(frozen=True)
class Mistake:
    """A usual mistake."""

    said: str  # what undoes it, as a note says it
    least: float  # mean gain in dB from which the note does


MISTAKES: Mapping[str, Mistake] = {  # by the name of the metric that has the gain; of equal ones the first is said
    "if_decoded": Mistake("taken for display values (encoded? expected linear)", TONE),
    "if_encoded": Mistake("encoded once more (decoded twice?)", TONE),
    "if_bgr": Mistake("with red and blue exchanged (BGR?)", PLACE),
    "if_y_down": Mistake('with normal_axes = ["+x", "-y", "+z"] (y down?)', PLACE),
    "if_opencv": Mistake('with normal_axes = ["+x", "-y", "-z"] (OpenCV?)', PLACE),
    "if_x_left": Mistake('with normal_axes = ["-x", "+y", "+z"] (x to the left?)', PLACE),
    "if_other_signs": Mistake("with other signs (+x is right, +y up, +z to the viewer)", PLACE),
    "if_other_axes": Mistake("with x, y and z exchanged (z up?)", PLACE),
    "if_edges": Mistake("with other edges (mixed with black or white, or straight for premultiplied?)", PLACE),
    "if_mirrored": Mistake("mirrored left to right", PLACE),
    "if_upside_down": Mistake("upside down (rows from the bottom?)", PLACE),
    "if_shifted": Mistake("moved by one pixel (cropped or resampled by other rules?)", PLACE),
    "if_in_box": Mistake("shrunk into the box around the object (a crop that was stretched to the frame?)", PLACE),
    "if_turned": Mistake("turned by half (its middle is behind the camera)", PLACE),
    "if_turned_right": Mistake("rolled by a quarter of its width", PLACE),
    "if_turned_left": Mistake("rolled by three quarters of its width", PLACE),
    "if_mirrored_and_turned": Mistake("mirrored and turned by half (its middle is behind the camera)", PLACE),
    "if_mirrored_and_turned_right": Mistake("mirrored, then rolled by a quarter of its width", PLACE),
    "if_mirrored_and_turned_left": Mistake("mirrored, then rolled by three quarters of its width", PLACE),
    "if_inverted": Mistake("taken for 1 minus it (smoothness?)", TONE),
    "if_root": Mistake("as its square root (the GGX alpha, or too low throughout?)", TONE),
    "if_swapped": Mistake("exchanged with metallic", TONE),
}
SIGNS: Mapping[tuple[int, ...], str] = {
    (1, -1, 1): "if_y_down",
    (1, -1, -1): "if_opencv",
    (-1, 1, 1): "if_x_left",
}  # of x, y and z
GAINS: Mapping[str, Metric] = {
    name: Metric(
        name, name.replace("_", " "), "dB", LOWER, -MOST_DB, (), 1, f"gain of a stranger's answer {mistake.said}"
    )
    for name, mistake in MISTAKES.items()
}

# A signed value, for which -1 stands as `perfect`: no file of results may have one below that.
BIAS = Metric("bias", "bias", "", LOWER, -1.0, (), 4, "masked mean of p - t, of a stranger's answer")
AT_WHITE = Metric(
    "at_white",
    "at white",
    "",
    LOWER,
    0.0,
    (),
    2,
    f"1 where a stranger's light ends at 1, where max t > {BRIGHT:g}",
)


def colour_gains(found: Map, true: Map, mask: Mask) -> dict[str, float]:
    """Mistake -> gain in masked error of display values. What is encoded once more or decoded gains beyond what another
    brightness does: no picture fixes that of an albedo or a light, and all that is dark is nearer to the truth when it
    is encoded, all that is bright when it is decoded.

    Args:
        found: linear, not premultiplied.
        true: the same.
        mask: true coverage.
    """
    linear, aim = np.clip(found, 0, 1), srgb_encode(np.clip(true, 0, 1))
    shown = srgb_encode(linear)

    def error(x: Map) -> float:
        return metrics.mse(x, aim, mask)

    undone = {
        "if_decoded": [linear],
        "if_encoded": [srgb_encode(shown)],
        "if_bgr": [shown[..., ::-1]],
        "if_mirrored": [shown[:, ::-1]],
        "if_upside_down": [shown[::-1]],
        "if_shifted": _moved(shown),
        "if_in_box": _in_boxes(shown, mask),
    }
    if np.any((mask > 0) & (mask < 1)):
        undone["if_edges"] = _other_edges(found, shown, mask)
    as_it_is = error(shown)
    gains = {name: _gain(as_it_is, map(error, answers)) for name, answers in undone.items()}
    as_bright = srgb_encode(np.clip(metrics.align_scale(found, true, mask, "aligned"), 0, 1))
    level = min(as_it_is, error(as_bright))
    return gains | {name: _gain(level, map(error, undone[name])) for name in ("if_decoded", "if_encoded")}


def normal_gains(found: Map, true: Map, mask: Mask) -> dict[str, float]:
    """Mistake -> gain in 1 minus the mean cosine; arguments as in `colour_gains`."""

    def error(x: Map) -> float:
        return 1 - metrics.weighted_mean(metrics.cosine(x, true), mask)

    undone = {
        "if_mirrored": [found[:, ::-1], found[:, ::-1] * np.array([-1, 1, 1], np.float32)],
        "if_upside_down": [found[::-1], found[::-1] * np.array([1, -1, 1], np.float32)],
        "if_shifted": _moved(found),
        "if_in_box": _in_boxes(found, mask),
    }
    as_it_is = error(found)
    gains = {name: _gain(as_it_is, map(error, answers)) for name, answers in undone.items()}
    p, t = (x / np.maximum(np.linalg.norm(x.astype(np.float64), axis=-1, keepdims=True), EXACT) for x in (found, true))
    shares = np.einsum("hwi,hwj->ij", p * mask, t) / mask.sum(dtype=np.float64)  # of channel i in axis j
    axes: dict[str, list[float]] = {}
    as_they_are, *others = product(permutations(range(3)), product((1, -1), repeat=3))
    for order, signs in others:
        cosine = float(np.sum(np.array(signs) * shares[list(order), range(3)]))
        name = SIGNS.get(signs, "if_other_signs") if order == as_they_are[0] else "if_other_axes"
        axes.setdefault(name, []).append(1 - cosine)
    return gains | {name: _gain(as_it_is, errors) for name, errors in axes.items()}


def light_gains(found: Light, true: Float[np.ndarray, "h2 w2 3"]) -> dict[str, float]:
    """Mistake -> gain in the squared log-RMSE of the light; none of a black one.

    Args:
        found: lat-long radiance, any size; negative values count as 0.
        true: the same.
    """
    p, t = (resample_environment(np.maximum(light, 0), SHAPE) for light in (found, true))
    if not p.max() > DIMMEST:
        return {}

    def error(x: Map) -> float:
        return scaled_log_rmse(x, t) ** 2

    undone = {
        "if_bgr": p[..., ::-1],
        "if_mirrored": p[:, ::-1],
        "if_upside_down": p[::-1],
    }
    for name, side in (("if_turned", p), ("if_mirrored_and_turned", p[:, ::-1])):
        for turn, quarters in (("_right", 1), ("", 2), ("_left", 3)):
            undone[name + turn] = np.roll(side, SHAPE[1] * quarters // 4, 1)
    as_it_is = error(p)
    return {name: _gain(as_it_is, [error(answer)]) for name, answer in undone.items()}


def light_facts(found: Light, true: Float[np.ndarray, "h2 w2 3"]) -> dict[str, float]:
    """Whether a light ends at white, where the true one is bright; arguments as in `light_gains`.

    Of a light that was clipped as much is at white as the true one has above it; of one that was divided by its
    brightest texel hardly more than that.
    """
    if true.max() <= BRIGHT:
        return {}
    clipped = found.max() <= WHITE[1] and (found >= WHITE[0]).mean() >= (true > BRIGHT).mean()
    return {metric_key("environment", AT_WHITE): float(clipped)}


def roughness_facts(found: Intrinsics, true: Intrinsics, mask: Mask) -> dict[str, float]:
    """By how much roughness is too high."""
    p, t = found.roughness, true.roughness
    return {} if p is None or t is None else {metric_key("roughness", BIAS): metrics.weighted_mean(p - t, mask)}


def roughness_gains(found: Intrinsics, true: Intrinsics, mask: Mask) -> dict[str, float]:
    """Mistake -> gain in the masked squared error of roughness, or of roughness and metallic together."""
    p, t = found.roughness, true.roughness
    if p is None or t is None:
        return {}
    undone = {"if_decoded": srgb_decode(p), "if_inverted": 1 - p, "if_root": np.sqrt(p)}
    gains = {name: _gain(metrics.mse(p, t, mask), [metrics.mse(x, t, mask)]) for name, x in undone.items()}
    m, n = found.metallic, true.metallic
    if m is None or n is None:
        return gains
    as_it_is, swapped = (
        sum(metrics.mse(x, y, mask) for x, y in pairs) for pairs in (((p, t), (m, n)), ((p, n), (m, t)))
    )
    return gains | {"if_swapped": _gain(as_it_is, [swapped])}


def _gain(error: float, undone: Iterable[float]) -> float:
    """dB by which the least of the errors is below another one, in [-MOST_DB, MOST_DB]."""
    return float(np.clip(10 * np.log10((error + EXACT) / (min(undone) + EXACT)), -MOST_DB, MOST_DB))


def _other_edges(found: Map, shown: Map, mask: Mask) -> list[Map]:
    """A map, linear and as `shown`, as it would be if its colours were multiplied by the coverage once more or once
    less, or had been mixed with white; in linear light or as display values."""
    coverage = np.where(mask > 0, mask, 1)
    white = 1 - coverage
    multiplied = srgb_encode(np.clip(found * coverage, 0, 1))
    in_linear = [found / coverage, (found - white) / coverage]
    as_shown = [multiplied, shown / coverage, (shown - white) / coverage, multiplied / coverage]
    return [*(srgb_encode(np.clip(x, 0, 1)) for x in in_linear), *(np.clip(x, 0, 1) for x in as_shown)]


def _in_boxes(x: Map, mask: Mask) -> list[Map]:
    """A map whose frame becomes the box around the object, or the square around that box."""
    ends = np.array([np.flatnonzero(np.any(mask > 0, axis=(1 - axis, 2)))[[0, -1]] for axis in (0, 1)])
    middle, sides = ends.mean(axis=1) + 0.5, ends[:, 1] - ends[:, 0] + 1.0
    return [_shrunk(x, middle, each) for each in (sides, np.full(2, sides.max()))]


def _shrunk(x: Map, middle: Float[np.ndarray, "2"], sides: Float[np.ndarray, "2"]) -> Map:
    """A map whose frame becomes a box, by the nearest pixel; outside the box its border goes on."""
    rows, columns = (
        np.clip(((np.arange(size) + 0.5 - centre) / side + 0.5) * size, 0, size - 1).astype(np.int64)
        for size, centre, side in zip(x.shape[:2], middle, sides, strict=True)
    )
    return x[rows][:, columns]


def _moved(x: Map) -> list[Map]:
    return [np.roll(x, by, (0, 1)) for by in product((-1, 0, 1), repeat=2) if any(by)]
