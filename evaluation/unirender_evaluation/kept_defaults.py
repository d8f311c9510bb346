"""Defaults of the process that a stranger's method may set, and that the numbers of all other rows depend on.

They are torch's default dtype and device, how numpy treats floating-point errors, and the current folder, from which
files are named.
"""

import copy
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np


class OwnDefaults:
    """What one method has set of them. Its code finds it again in its next call; nobody else's does."""

    def __init__(self) -> None:
        self._torch: tuple[Any, Any] | None = None
        self._numpy: dict[str, Any] = {}
        self._folder: str | None = None  # None: that of all others

    @contextmanager
    def here(self) -> Iterator[None]:
        """For a block of the method's code: the defaults are its own, and afterwards as before."""
        before, folder = _torch_defaults(), _folder()
        with np.errstate(**self._numpy):
            _set_torch(self._torch)
            _enter(self._folder)
            try:
                yield
            finally:
                self._torch, self._numpy = _torch_defaults(), dict(np.geterr())
                self._folder = own if (own := _folder()) != folder else None
                _set_torch(before or _initial())
                _enter(folder)

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


def _folder() -> str | None:
    """The current one; None where it is gone."""
    with suppress(OSError):
        return os.getcwd()
    return None


def _enter(folder: str | None) -> None:
    if folder is not None and folder != _folder():
        with suppress(OSError):  # it is gone
            os.chdir(folder)
