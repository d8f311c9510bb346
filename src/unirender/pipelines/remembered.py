"""What is remembered of the last pictures between calls, so that one is looked at once for many materials and lights.

A function of `MapsKey` that is `remembered` keeps its last answers, tens of megabytes each, until others take their
place, the process ends, or `forget_pictures` lets go of them.
"""

import functools
import hashlib
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from unirender.intrinsics import Intrinsics

T = TypeVar("T")
_FORGET: list[Callable[[], None]] = []  # one for each function that remembers


class MapsKey:
    """Maps and camera as they were when this was made: equal to others with the same values, not the same arrays."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self.intrinsics = intrinsics
        digests = (
            (name, value.shape, value.dtype.str, hashlib.sha256(np.ascontiguousarray(value).data).digest())
            for name, value in intrinsics.maps.items()
        )
        self._key = (intrinsics.camera, *digests)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MapsKey) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def remembered(most: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Decorates a function whose last answers are kept.

    Args:
        most: answers.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        kept = functools.lru_cache(maxsize=most)(function)
        _FORGET.append(kept.cache_clear)
        return kept

    return decorate


def forget_pictures() -> None:
    """Lets go of all that is remembered of the last pictures: their maps, and what their surfaces hide.

    For a process that goes on for long or whose pictures are private, and before something is timed as on a new
    picture. What is asked for next takes as long as the first time, and gives the same.
    """
    for forget in _FORGET:
        forget()
