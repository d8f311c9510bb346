"""Values that are recorded of a stranger's answer only where it is probably in another convention than the contract's.

It cannot be refused: nothing but its score says so. A note below the tables does where nearly all pictures agree
(`protocol.doubts`).
"""

from itertools import product

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_encode, unpremultiply
from unirender.intrinsics import Intrinsics
from unirender_evaluation import metrics
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.methods.plausible import NEARLY_ALL, facing_away
from unirender_evaluation.metrics import FACING_AWAY, TURNED, metric_key
from unirender_evaluation.task import Task

MUCH_DB = 6.0  # half the error
EXACT = 1e-9  # mean squared error of what is right but for rounding
MUCH_COSINE = 0.1  # a sphere's true normals lose 0.5 with another sign of y


def suspicions(task: Task, image: Image | None, maps: Intrinsics | None) -> dict[str, float]:
    """Metric key -> value of what is suspicious in an answer.

    Args:
        task: the question, with its truth.
        image: the picture that answers it, linear, premultiplied.
        maps: the maps that answer it.
    """
    values: dict[str, float] = {}
    true = task.truth_maps
    if image is not None and task.truth_image is not None:
        straight = unpremultiply(image, task.mask), unpremultiply(task.truth_image, task.mask)
        values |= _decoded(task.quantity, *straight, task.mask)
    if maps is None or true is None:
        return values
    for name in ("albedo", "specular", "diffuse"):
        found, truth = getattr(maps, name), getattr(true, name)
        if found is not None and truth is not None:
            values |= _decoded(name, found, truth, task.mask)
    if maps.normal is not None and true.normal is not None:
        away = facing_away(maps.normal, task.mask)
        if away > NEARLY_ALL:
            values[FACING_AWAY] = away
        elif (gain := turning_gain(maps.normal, true.normal, task.mask)) > MUCH_COSINE:
            values[TURNED] = gain
    return values


def _decoded(quantity: str, found: Image, true: Image, mask: Mask) -> dict[str, float]:
    gain = decoding_gain(found, true, mask)
    return {metric_key(quantity, "decoded"): gain} if gain > MUCH_DB else {}


def decoding_gain(found: Image, true: Image, mask: Mask) -> float:
    """dB that the masked sRGB PSNR of colours gains where they are taken for display values; 0 where none is.

    Args:
        found: as linear light, not premultiplied.
        true: linear light.
        mask: true coverage.
    """
    shown, aim = np.clip(found, 0, 1), srgb_encode(np.clip(true, 0, 1))
    as_linear, as_display = (metrics.mse(p, aim, mask) for p in (srgb_encode(shown), shown))
    return max(10 * float(np.log10((as_linear + EXACT) / (as_display + EXACT))), 0.0)


def turning_gain(found: Image, true: Image, mask: Mask) -> float:
    """By how much the mean cosine of normals rises where x, y or both have the other sign; negative where it falls."""

    def mean_cosine(signs: Float[np.ndarray, " 3"]) -> float:
        return metrics.weighted_mean(metrics.cosine(found * signs, true), mask)

    as_it_is, *turned = (mean_cosine(np.array([*signs, 1.0])) for signs in product((1.0, -1.0), repeat=2))
    return max(turned) - as_it_is
