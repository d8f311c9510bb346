"""What a method found in its last pictures: rows and tables that ask for the same one share it."""

import hashlib
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from unirender.camera import Camera
from unirender_evaluation.methods.method import Image, Mask

KEPT = 16  # more than are asked for of one scene; those of thousands of photographs would not fit into memory
Found = TypeVar("Found")


class Decompositions(Generic[Found]):
    """Decompositions by picture, mask and camera; the last `KEPT`."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[Found, float]] = {}

    def of(
        self, image_srgb: Image, mask: Mask, camera: Camera, decompose: Callable[[], Found], told: bytes = b""
    ) -> tuple[Found, float]:
        """The decomposition of a picture, and the seconds that it took before this call: 0 where it is made now.

        `told` is whatever else the answer depends on. What `decompose` raises is not kept.
        """
        shown = f"{image_srgb.shape} {camera}".encode() + image_srgb.tobytes() + mask.tobytes() + told
        key = hashlib.sha256(shown).hexdigest()
        if key in self._found:
            return self._found[key]
        start = time.perf_counter()
        made = decompose()
        while len(self._found) >= KEPT:
            del self._found[next(iter(self._found))]
        self._found[key] = made, time.perf_counter() - start
        return made, 0.0
