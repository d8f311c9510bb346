"""The ranges of a training's config. Torch-free, so that the command line can look before anything is imported."""

import math
import operator
from collections.abc import Callable

from unirender.errors import UnirenderError
from unirender.training.config import TrainConfig

Range = tuple[str, Callable[[float], bool]]  # in words, and whether a finite number is in it

_COUNT: Range = "at least 1", lambda value: value >= 1
_NOT_NEGATIVE: Range = "at least 0", lambda value: value >= 0
_POSITIVE: Range = "more than 0", lambda value: value > 0
_SHARE: Range = "at least 0 and at most 1", lambda value: 0 <= value <= 1
_DECAY: Range = "at least 0 and less than 1", lambda value: 0 <= value < 1

_LOSS = ("material", "albedo", "normal", "specular", "diffuse", "environment", "image", "image_floor", "colour_floor")
_DRAWN = ("mix", "permute", "mirror", "turn", "derived", "shadowed", "repaint", "move")
RANGES: dict[str, Range] = {
    **dict.fromkeys(("batch_size", "group_size", "steps", "augmentation.max_lights"), _COUNT),
    **dict.fromkeys(("p_render", "p_t", "map_dropout", "loss.cycle_share", "loss.cycle_warmup"), _SHARE),
    **{f"loss.{name}": _NOT_NEGATIVE for name in (*_LOSS, "background", "cycle", "composite")},
    **dict.fromkeys(("optimizer.learning_rate", "optimizer.clip_norm"), _POSITIVE),
    **dict.fromkeys(("optimizer.beta1", "optimizer.beta2", "optimizer.ema_decay"), _DECAY),
    **dict.fromkeys(("seed", "optimizer.weight_decay", "optimizer.warmup_steps", "augmentation.tint"), _NOT_NEGATIVE),
    "optimizer.final_lr": _SHARE,
    **{f"augmentation.{name}": _SHARE for name in _DRAWN},
}


def check_config(config: TrainConfig) -> None:
    """Looks at every number of a config but the network's, which the network looks at itself.

    Raises:
        UnirenderError: one is outside its range; names the first.
    """
    for name, (words, holds) in RANGES.items():
        value = operator.attrgetter(name)(config)
        if not (math.isfinite(value) and holds(value)):
            raise UnirenderError(f"training config: {name} is {value!r}, expected {words}; correct it in the preset")
