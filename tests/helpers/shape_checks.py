"""Array shapes, checked at every call: what jaxtyping's import hook puts on the functions of the three packages.

`jaxtyping.jaxtyped` with a type checker binds the arguments, checks them before the call and again with the result
after it; a quarter of the time of all tests went there. This is its way for two decorators: one call of beartype's,
which checks arguments and result once, in a context of its own for the names of the axes.
"""

import dataclasses
import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, TypeCheckError, install_import_hook

_jaxtyped = jaxtyping.jaxtyped
# An int is a float, as it is to Python and to pyright.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=TypeCheckError))


def install(*packages: str) -> None:
    """From now on packages are checked as they are imported; called before the first of them is."""
    jaxtyping.jaxtyped = checked
    install_import_hook(packages, f"{__name__}._beartype")


def checked(*, typechecker: Any) -> Callable[[Any], Any]:
    """What the hook decorates with, in place of `jaxtyped`; `typechecker` is the one of `install`."""

    def decorate(found: Any) -> Any:
        if inspect.isclass(found):
            if dataclasses.is_dataclass(found) and "__init__" in vars(found):
                found.__init__ = decorate(found.__init__)
            return found
        hints = {name: _resolved(hint, found.__globals__) for name, hint in found.__annotations__.items()}
        arrays = [array for hint in hints.values() for array in _arrays(hint)]
        if any("{" in array.dim_str for array in arrays):  # sizes by the values of other arguments
            return _jaxtyped(typechecker=typechecker)(found)
        return _checked_call(found, hints, in_context=bool(arrays))

    return decorate


def _checked_call(function: types.FunctionType, hints: dict[str, Any], in_context: bool) -> Callable[..., Any]:
    """The function, checked. Its check is made at the first call: one process never calls most functions.

    With `in_context`, a name of an axis has one size in all arguments and the result of a call, and is forgotten after.
    """

    @functools.cache
    def call() -> Callable[..., Any]:
        return _beartype(_with_hints(function, hints))

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        if not in_context:
            return call()(*args, **kwargs)
        with _jaxtyped("context"):  # pyright: ignore[reportArgumentType] - as its documentation says
            return call()(*args, **kwargs)

    return wrapper


def _with_hints(function: types.FunctionType, hints: dict[str, Any]) -> types.FunctionType:
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__annotations__ = function.__kwdefaults__, hints
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    return copy


def _arrays(hint: Any) -> Iterator[type[AbstractArray]]:
    """The array types in a hint."""
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        yield hint
    for part in typing.get_args(hint):
        yield from _arrays(part)


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """The hint without strings; Any where it names what is imported for the type checker alone."""
    holder = types.SimpleNamespace(__annotations__={"hint": hint})
    try:
        return typing.get_type_hints(holder, names, include_extras=True)["hint"]
    except (NameError, AttributeError):
        return Any
