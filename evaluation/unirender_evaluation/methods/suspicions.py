"""Values that are recorded of a stranger's answer because it may be in another convention than the contract's.

It cannot be refused: nothing but its score says so. A note below the tables does where nearly all pictures agree
(`protocol.doubts`).
"""

from collections.abc import Mapping

import numpy as np

from unirender.color import unpremultiply
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.methods.mistakes import (
    GAINS,
    colour_gains,
    light_facts,
    light_gains,
    normal_gains,
    roughness_facts,
    roughness_gains,
)
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.task import Task


def suspicions(task: Task, image: Image | None, maps: Intrinsics | None) -> dict[str, float]:
    """Metric key -> gain in dB of an answer by each usual mistake undone, and what else helps to tell mistakes."""
    values: dict[str, float] = {}
    true, mask = task.truth_maps, task.mask
    if image is not None and task.truth_image is not None:
        straight = unpremultiply(image, mask), unpremultiply(task.truth_image, mask)
        values |= _named(task.quantity, colour_gains(*straight, mask))
    if maps is None or true is None:
        return values
    values |= suspicions_of_maps(maps.maps, true.maps, mask)
    if maps.environment is not None and true.environment is not None:
        values |= _named("environment", light_gains(maps.environment, true.environment))
        values |= light_facts(maps.environment, true.environment)
    return values | _named("roughness", roughness_gains(maps, true, mask)) | roughness_facts(maps, true, mask)


def suspicions_of_maps(found: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray], mask: Mask) -> dict[str, float]:
    """The gains of maps in colour and of normals, as far as both sides have them; straight, colours linear."""
    values: dict[str, float] = {}
    for name in ("albedo", "specular", "diffuse", "relit"):
        if name in found and name in true:
            values |= _named(name, colour_gains(found[name], true[name], mask))
    if "normal" in found and "normal" in true:
        values |= _named("normal", normal_gains(found["normal"], true["normal"], mask))
    return values


def _named(quantity: str, gains: Mapping[str, float]) -> dict[str, float]:
    return {metric_key(quantity, GAINS[name]): gain for name, gain in gains.items()}
