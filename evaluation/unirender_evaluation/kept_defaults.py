"""Defaults of the process that a stranger's method may set, and that the numbers of all other rows depend on.

They are torch's default dtype and device, and how numpy treats floating-point errors.
"""

import copy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


class OwnDefaults:
    """What one method has set of them. Its code finds it again in its next call; nobody else's does."""

    def __init__(self) -> None:
        self._torch: tuple[Any, Any] | None = None
        self._numpy: dict[str, Any] = {}

    @contextmanager
    def here(self) -> Iterator[None]:
        """For a block of the method's code: the defaults are its own, and afterwards as before."""
        before = _torch_defaults()
        with np.errstate(**self._numpy):
            _set_torch(self._torch)
            try:
                yield
            finally:
                self._torch, self._numpy = _torch_defaults(), dict(np.geterr())
                _set_torch(before or _initial())

    def copy(self) -> "OwnDefaults":
        """The same, to be changed alone: those of a module, for each method that it has."""
        return copy.copy(self)


def _torch_defaults() -> tuple[Any, Any] | None:
    """(dtype, device); None where torch is not imported."""
    torch = sys.modules.get("torch")
    return None if torch is None else (torch.get_default_dtype(), torch.get_default_device())


def _initial() -> tuple[Any, Any] | None:
    """What torch begins with, if the block has imported it."""
    torch = sys.modules.get("torch")
    return None if torch is None else (torch.float32, torch.device("cpu"))


def _set_torch(defaults: tuple[Any, Any] | None) -> None:
    if defaults is None or defaults == _torch_defaults():
        return
    torch, (dtype, device) = sys.modules["torch"], defaults
    torch.set_default_dtype(dtype)
    torch.set_default_device(None if device.type == "cpu" else device)
