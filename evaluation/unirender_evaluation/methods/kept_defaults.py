"""Defaults of the process that a stranger's method may set, and that the answers of all other rows depend on.

They are torch's (dtype, device, gradients, precision, determinism, threads), Mitsuba's variant, how numpy
treats floating-point errors, and the current folder, from which files are named.
"""

import copy
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

CUDNN = ("allow_tf32", "benchmark", "deterministic")


class OwnDefaults:
    """What one method has set of them. Its code finds it again in its next call; nobody else's does."""

    def __init__(self) -> None:
        self._torch: Mapping[str, Any] = {}
        self._numpy: dict[str, Any] = {}
        self._variant: str | None = None  # None: Mitsuba had none
        self._folder: str | None = None  # None: that of all others

    @contextmanager
    def here(self) -> Iterator[None]:
        """For a block of the method's code: the defaults are its own, and afterwards as before.

        But for Mitsuba's variant, which takes a third of a second to set: who renders next sets it. Whether a method
        has set the one that was there already cannot be told, so it finds that again, too.
        """
        before, folder = torch_defaults(), _folder()
        with np.errstate(**self._numpy):
            _set_torch(self._torch)
            _enter(self._folder)
            _set_variant(self._variant)
            try:
                yield
            finally:
                self._torch, self._numpy = torch_defaults(), dict(np.geterr())
                self._variant = _variant()
                self._folder = own if (own := _folder()) != folder else None
                _set_torch(before or _initial())
                _enter(folder)

    def copy(self) -> "OwnDefaults":
        """The same, to be changed alone: those of a module, for each method that it has."""
        return copy.copy(self)


def torch_defaults() -> dict[str, Any]:
    """Setting -> value; empty where torch is not imported."""
    torch = sys.modules.get("torch")
    return {} if torch is None else {name: read(torch) for name, (read, _) in TORCH.items()}


def _initial() -> dict[str, Any]:
    """What torch begins with, if the block has imported it; its threads are not known then."""
    torch = sys.modules.get("torch")
    if torch is None:
        return {}
    known = {"dtype": torch.float32, "device": torch.device("cpu"), "gradients": True}
    known |= {"precision": (*["none"] * 4, "tf32", "tf32"), "products": "highest"}
    return known | {"determinism": (False, False), "cudnn": (True, False, False)}


def _set_torch(defaults: Mapping[str, Any]) -> None:
    """Sets those that are others now; in their order, since a general precision changes what follows."""
    for name, value in defaults.items():
        read, write = TORCH[name]
        if value != read(torch := sys.modules["torch"]):
            write(torch, value)


def _precise(torch: Any) -> tuple[Any, ...]:
    """What has a precision of float32 that torch's newer interface sets, the general ones first."""
    cpu, gpu = torch.backends.mkldnn, torch.backends.cudnn
    return torch.backends, cpu, cpu.conv, cpu.rnn, gpu.conv, gpu.rnn


def _read_precision(torch: Any) -> tuple[str, ...]:
    return tuple(place.fp32_precision for place in _precise(torch))


def _write_precision(torch: Any, precision: tuple[str, ...]) -> None:
    for place, value in zip(_precise(torch), precision, strict=True):
        if place.fp32_precision != value:
            place.fp32_precision = value


def _read_products(torch: Any) -> str:
    """The precision of products of float32, in the words of `set_float32_matmul_precision`."""
    gpu, cpu = torch.backends.cuda.matmul.fp32_precision, torch.backends.mkldnn.matmul.fp32_precision
    return "medium" if cpu == "bf16" else "high" if "tf32" in (gpu, cpu) else "highest"


def _read_determinism(torch: Any) -> tuple[bool, bool]:
    return torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()


def _read_cudnn(torch: Any) -> tuple[bool | None, ...]:
    """The flags; None for one that was set by another of torch's interfaces, too, and is not told by this one."""
    found = []
    for flag in CUDNN:
        try:
            found.append(getattr(torch.backends.cudnn, flag))
        except RuntimeError:
            found.append(None)
    return tuple(found)


def _write_cudnn(torch: Any, flags: tuple[bool | None, ...]) -> None:
    for flag, value in zip(CUDNN, flags, strict=True):
        if value is not None:
            setattr(torch.backends.cudnn, flag, value)


def _write_device(torch: Any, device: Any) -> None:
    torch.set_default_device(None if device.type == "cpu" else device)


TORCH: Mapping[str, tuple[Callable[[Any], Any], Callable[[Any, Any], None]]] = {  # setting: how it is read and set
    "dtype": (lambda torch: torch.get_default_dtype(), lambda torch, value: torch.set_default_dtype(value)),
    "device": (lambda torch: torch.get_default_device(), _write_device),
    "gradients": (lambda torch: torch.is_grad_enabled(), lambda torch, value: torch.set_grad_enabled(value)),
    "precision": (_read_precision, _write_precision),
    "products": (_read_products, lambda torch, value: torch.set_float32_matmul_precision(value)),
    "determinism": (
        _read_determinism,
        lambda torch, value: torch.use_deterministic_algorithms(value[0], warn_only=value[1]),
    ),
    "cudnn": (_read_cudnn, _write_cudnn),
    "threads": (lambda torch: torch.get_num_threads(), lambda torch, value: torch.set_num_threads(value)),
}


def _variant() -> str | None:
    """Mitsuba's; None where it is not imported, or has none."""
    mitsuba = sys.modules.get("mitsuba")
    return None if mitsuba is None else mitsuba.variant()


def _set_variant(variant: str | None) -> None:
    """Sets it, where it is another one now."""
    if variant is not None and variant != _variant():
        sys.modules["mitsuba"].set_variant(variant)


def _folder() -> str | None:
    """The current one; None where it is gone."""
    with suppress(OSError):
        return os.getcwd()
    return None


def _enter(folder: str | None) -> None:
    if folder is not None and folder != _folder():
        with suppress(OSError):  # it is gone
            os.chdir(folder)
