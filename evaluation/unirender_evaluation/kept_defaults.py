"""Defaults of the process that a stranger's method may set, and that the numbers of all other rows depend on."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


@contextmanager
def kept_defaults() -> Iterator[None]:
    """For a block of a stranger's code: torch's default dtype and device, and numpy's floating-point errors, are
    afterwards as before."""
    before = _torch_defaults()
    with np.errstate():
        try:
            yield
        finally:
            torch = sys.modules.get("torch")
            if torch is not None and _torch_defaults() != before:
                dtype, device = before or (torch.float32, torch.device("cpu"))
                torch.set_default_dtype(dtype)
                torch.set_default_device(None if device.type == "cpu" else device)


def _torch_defaults() -> tuple[Any, Any] | None:
    """(dtype, device); None where torch is not imported."""
    torch = sys.modules.get("torch")
    return None if torch is None else (torch.get_default_dtype(), torch.get_default_device())
