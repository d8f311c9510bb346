"""What the machine has, against what options ask for: one sentence before the work instead of a crash in it."""

import os
from collections.abc import Mapping

from unirender.errors import UnirenderError
from unirender.system.machine import memory_excess


def require_cores(threads: int) -> None:
    """Looks at a number of threads; 0: one for each core.

    Raises:
        UnirenderError: there are not so many cores.
    """
    cores = os.cpu_count() or 1
    if threads > cores:
        raise UnirenderError(f"--threads {threads}: expected at most {cores}, the cores of this machine; 0 takes all")


def require_memory_for_pictures(count: int, height: int, width: int, bytes_of_pixel: float) -> None:
    """Looks at a set of pictures of one size.

    Args:
        count: of the pictures.
        height, width: of each, in pixels.
        bytes_of_pixel: about how many bytes a pixel takes.

    Raises:
        UnirenderError: they take more than the machine has in all.
    """
    named = f"{count} pictures of {width} x {height} pixels"
    require_memory({named: bytes_of_pixel * count * height * width}, "fewer or smaller ones (--most-views, --size)")


def require_memory(needed: Mapping[str, float], instead: str = "a smaller number") -> None:
    """Looks at options, or pictures, with which memory grows.

    Args:
        needed: by option, with its value: about how many bytes it takes.
        instead: what is expected.

    Raises:
        UnirenderError: one takes more than the machine has in all.
    """
    for option, wanted in needed.items():
        if excess := memory_excess(wanted):
            raise UnirenderError(f"{option}: {excess}; expected {instead}")
