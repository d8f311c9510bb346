"""Every number of a training's config has a range, and a training outside it does not begin."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_models import TRAIN

from unirender.errors import UnirenderError
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.config_check import RANGES, check_config
from unirender.training.loop.trainer import Trainer
from unirender.training.presets import PRESETS


def changed(config: Any, name: str, value: float) -> Any:
    """The config with another value at a dotted name."""
    head, _, rest = name.partition(".")
    return dataclasses.replace(config, **{head: changed(getattr(config, head), rest, value) if rest else value})


def numbers(config: Any, prefix: str = "") -> set[str]:
    """Dotted names of all entries that are numbers, those of the network left out."""
    found: set[str] = set()
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value) and name != "model":
            found |= numbers(value, f"{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.add(name)
    return found


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_in_their_ranges(name: str) -> None:
    check_config(PRESETS[name])


def test_no_number_is_without_a_range() -> None:
    assert numbers(TrainConfig()) == RANGES.keys()


@pytest.mark.parametrize(
    ("name", "bad", "good", "expected"),
    [
        ("batch_size", 0, 1, "at least 1"),
        ("group_size", 0, 1, "at least 1"),
        ("p_render", -0.1, 0.0, "at least 0 and at most 1"),
        ("p_t", 1.5, 1.0, "at least 0 and at most 1"),
        ("map_dropout", float("nan"), 1.0, "at least 0 and at most 1"),
        ("loss.cycle_share", 1.01, 1.0, "at least 0 and at most 1"),
        ("loss.albedo", -1.0, 0.0, "at least 0"),
        ("optimizer.learning_rate", 0.0, 1e-9, "more than 0"),
        ("optimizer.learning_rate", float("inf"), 1.0, "more than 0"),
        ("optimizer.beta2", 1.0, 0.0, "at least 0 and less than 1"),
        ("augmentation.mirror", 2.0, 1.0, "at least 0 and at most 1"),
        ("seed", -1, 0, "at least 0"),
    ],
)
def test_a_value_outside_its_range_is_named(name: str, bad: float, good: float, expected: str) -> None:
    with pytest.raises(UnirenderError, match=f"training config: {name} is .*, expected {expected}; correct"):
        check_config(changed(TrainConfig(), name, bad))
    check_config(changed(TrainConfig(), name, good))  # the end of the range belongs to it, or is close to it


def test_a_training_outside_the_ranges_does_not_begin(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=r"group_size is 0"):
        Trainer(changed(TRAIN, "group_size", 0), RunConfig(tmp_path, steps=1), torch.device("cpu"), torch.float32)
    assert not any(tmp_path.iterdir())
