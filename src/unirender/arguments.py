"""Arguments of the functions that people call, looked at where they arrive: by their type. Light to import."""

import os
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError

Kind = TypeVar("Kind")


def as_path(value: Any, what: str = "path") -> Path:
    """What somebody handed in as the path of a file or folder.

    Raises:
        UnirenderError: it is none.
    """
    named = os.fspath(value) if isinstance(value, os.PathLike) else value
    if not isinstance(named, str) or "\0" in named:
        raise UnirenderError(
            f"{what}: got {type(value).__name__} {value!r:.60}, expected a path as text or pathlib.Path"
        )
    return Path(named)


def as_instance(value: Any, kind: type[Kind], what: str) -> Kind:
    """What somebody handed in as an object of a class of ours.

    Raises:
        UnirenderError: it is none.
    """
    if isinstance(value, kind):
        return value
    inside = getattr(value, kind.__name__.lower(), None)
    hint = f"; it has one as its `{kind.__name__.lower()}`" if isinstance(inside, kind) else ""
    raise UnirenderError(
        f"{what}: got {type(value).__name__}, expected {kind.__module__}.{kind.__qualname__}{hint}; are arguments in "
        "another order?"
    )


def as_floats(value: Any, what: str) -> Float[np.ndarray, "..."]:
    """What somebody handed in as display values or linear light, of which white is 1: an array, its values as they are.

    Raises:
        UnirenderError: it is none, or has the whole numbers of a picture of 8 or 16 bits.
    """
    given = np.asarray(value)
    if given.dtype.kind == "u":
        raise UnirenderError(
            f"{what}: got {given.dtype} values, expected floats whose white is 1; divide by {np.iinfo(given.dtype).max}"
        )
    if given.dtype.kind not in "bif":
        raise UnirenderError(f"{what}: got {type(value).__name__} {value!r:.60}, expected numbers")
    return given


def as_coverage(value: Any, what: str) -> Float[np.ndarray, "..."]:
    """The same of a mask, which may be one of whole numbers where these are 0 and 1.

    Raises:
        UnirenderError: as `as_floats`.
    """
    given = np.asarray(value)
    return given.astype(np.float32) if given.dtype.kind == "u" and given.max(initial=0) <= 1 else as_floats(value, what)


def check_switches(**switches: Any) -> None:
    """Looks at arguments that are on or off: of a text, any would count as on.

    Raises:
        UnirenderError: one is neither True nor False.
    """
    for name, value in switches.items():
        if not isinstance(value, bool | np.bool_):
            raise UnirenderError(f"{name}: got {value!r:.60}, expected True or False")
