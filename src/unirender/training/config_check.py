"""The ranges of a training's config. Torch-free, so that the command line can look before anything is imported."""

import math
import operator
from dataclasses import dataclass

from unirender.errors import UnirenderError
from unirender.training.config import TrainConfig


@dataclass(frozen=True)
class Range:
    """Finite numbers from `low` to `high`; an end that is `open` is not among them."""

    low: float
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        above = self.low < value if self.low_open else self.low <= value
        below = value < self.high if self.high_open else value <= self.high
        return math.isfinite(value) and above and below

    def __str__(self) -> str:
        above = f"more than {self.low:g}" if self.low_open else f"at least {self.low:g}"
        if self.high == math.inf:
            return above
        return f"{above} and {'less than' if self.high_open else 'at most'} {self.high:g}"


_COUNT = Range(1)
_NOT_NEGATIVE = Range(0)
_POSITIVE = Range(0, low_open=True)
_SHARE = Range(0, 1)
_DECAY = Range(0, 1, high_open=True)

RANGES: dict[str, Range] = {
    **dict.fromkeys(("batch_size", "group_size", "steps", "augmentation.max_lights"), _COUNT),
    **dict.fromkeys(("p_render", "p_t", "map_dropout", "loss.cycle_share", "loss.cycle_warmup"), _SHARE),
    **{f"loss.{name}": _NOT_NEGATIVE for name in ("material", "albedo", "normal", "specular", "diffuse")},
    **{
        f"loss.{name}": _NOT_NEGATIVE
        for name in ("environment", "image", "image_floor", "colour_floor", "background", "cycle", "composite")
    },
    **dict.fromkeys(("optimizer.learning_rate", "optimizer.clip_norm"), _POSITIVE),
    **dict.fromkeys(("optimizer.beta1", "optimizer.beta2", "optimizer.ema_decay"), _DECAY),
    **dict.fromkeys(("seed", "optimizer.weight_decay", "optimizer.warmup_steps", "augmentation.tint"), _NOT_NEGATIVE),
    "optimizer.final_lr": _SHARE,
    **{
        f"augmentation.{name}": _SHARE
        for name in ("mix", "permute", "mirror", "turn", "derived", "shadowed", "repaint", "move")
    },
}


def check_config(config: TrainConfig) -> None:
    """Looks at every number of a config but the network's, which the network looks at itself.

    Raises:
        UnirenderError: one is outside its range; names the first.
    """
    for name, allowed in RANGES.items():
        value = operator.attrgetter(name)(config)
        if value not in allowed:
            raise UnirenderError(f"training config: {name} is {value!r}, expected {allowed}; correct it in the preset")
