"""Values that are recorded of a stranger's answer because it may be in another convention than the contract's.

It cannot be refused: nothing but its score says so. A note below the tables does where nearly all pictures agree
(`protocol.doubts`).
"""

from collections.abc import Mapping

from unirender.color import unpremultiply
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import Image
from unirender_evaluation.methods.mistakes import GAINS, colour_gains, light_gains, normal_gains, roughness_gains
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.task import Task


def suspicions(task: Task, image: Image | None, maps: Intrinsics | None) -> dict[str, float]:
    """Metric key -> gain in dB of an answer by each usual mistake undone."""
    values: dict[str, float] = {}
    true, mask = task.truth_maps, task.mask
    if image is not None and task.truth_image is not None:
        straight = unpremultiply(image, mask), unpremultiply(task.truth_image, mask)
        values |= _named(task.quantity, colour_gains(*straight, mask))
    if maps is None or true is None:
        return values
    for name in ("albedo", "specular", "diffuse"):
        found, truth = getattr(maps, name), getattr(true, name)
        if found is not None and truth is not None:
            values |= _named(name, colour_gains(found, truth, mask))
    if maps.normal is not None and true.normal is not None:
        values |= _named("normal", normal_gains(maps.normal, true.normal, mask))
    if maps.environment is not None and true.environment is not None:
        values |= _named("environment", light_gains(maps.environment, true.environment))
    return values | _named("roughness", roughness_gains(maps, true, mask))


def _named(quantity: str, gains: Mapping[str, float]) -> dict[str, float]:
    return {metric_key(quantity, GAINS[name]): gain for name, gain in gains.items()}
