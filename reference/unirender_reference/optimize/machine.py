"""What the machine has, against what options ask for: one sentence before the work instead of a crash in it."""

import os
from collections.abc import Mapping

from unirender.errors import UnirenderError
from unirender.machine import memory_excess


def require_cores(threads: int) -> None:
    """Looks at a number of threads; 0: one for each core.

    Raises:
        UnirenderError: there are not so many cores.
    """
    cores = os.cpu_count() or 1
    if threads > cores:
        raise UnirenderError(f"--threads {threads}: expected at most {cores}, the cores of this machine; 0 takes all")


def require_memory(needed: Mapping[str, float]) -> None:
    """Looks at options with which memory grows.

    Args:
        needed: by option, with its value: about how many bytes it takes.

    Raises:
        UnirenderError: one takes more than the machine has in all.
    """
    for option, wanted in needed.items():
        if excess := memory_excess(wanted):
            raise UnirenderError(f"{option}: {excess}; expected a smaller number")
