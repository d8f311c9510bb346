"""What a notebook shows of an object that holds arrays: in one line their shapes and ranges, not their numbers."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Shaped


def in_short(array: Shaped[np.ndarray, "..."]) -> str:
    """`[64, 128, 3] in [0, 2.5]`: shape and range."""
    shape = list(array.shape)
    return f"{shape} in [{float(array.min()):.3g}, {float(array.max()):.3g}]" if array.size else f"{shape}"


def short_repr(self: Any) -> str:
    """The `__repr__` of a dataclass: arrays in short, and nothing of fields that are None or have `repr=False`."""
    parts = []
    for field in dataclasses.fields(self):
        value = getattr(self, field.name)
        if isinstance(value, np.ndarray):
            parts.append(f"{field.name} {in_short(value)}")
        elif field.repr and value is not None:
            parts.append(f"{field.name}={value!r}")
    return f"{type(self).__name__}({', '.join(parts)})"
