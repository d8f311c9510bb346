"""Array shapes, checked at every call: what jaxtyping's import hook puts on the functions of the three packages.

`jaxtyping.jaxtyped` with a type checker binds the arguments, checks them before the call and again with the result
after it; a quarter of the time of all tests went there. This is its way for two decorators: one call of beartype's,
which checks arguments and result once, in a context of its own for the names of the axes. And what passed once passes
again: where the hints of a function ask for nothing but kinds, dtypes and shapes, a call whose arguments and result
have those of a call before is not looked at again.
"""

import abc
import collections.abc
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

REMEMBERED = 64  # kinds of calls of a function: where values count, there is no end of them
# Kinds of the results by kinds of the arguments: of a function, and of all that are made by the same lines, as one
# inside another is at each call of that one.
_passed: dict[Any, dict[Any, set[Any]]] = {}
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
        looked_at = _remembering if all(_asks_for_kinds(hint) for hint in hints.values()) else _checked_call
        return looked_at(found, hints, in_context=bool(arrays))

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


def _remembering(function: types.FunctionType, hints: dict[str, Any], in_context: bool) -> Callable[..., Any]:
    """The function, checked at each call whose arguments and result are not of the kinds of a call before."""
    checked_call = _checked_call(function, hints, in_context)
    passed = _passed.setdefault((function.__code__, repr(hints)), {})  # an array type is another each time
    by_value = any(_names_values(hint) for hint in hints.values())

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        arguments = (_kind(args, by_value), *[(name, _kind(value, by_value)) for name, value in kwargs.items()])
        results = passed.get(arguments)
        if results is None:
            result = checked_call(*args, **kwargs)
            if len(passed) == REMEMBERED:
                passed.clear()
            passed[arguments] = {_kind(result, by_value)}
            return result
        result = function(*args, **kwargs)
        kind = _kind(result, by_value)
        if kind not in results:
            _checked_call(_giving(result, function), hints, in_context)(*args, **kwargs)
            if len(results) < REMEMBERED:
                results.add(kind)
        return result

    return wrapper


def _giving(result: Any, function: types.FunctionType) -> types.FunctionType:
    """What takes the arguments of a function, and gives what that has given."""

    @functools.wraps(function)
    def given(*_args: Any, **_kwargs: Any) -> Any:
        return result

    return typing.cast(types.FunctionType, given)


# Their values count only where a hint is a Literal.
_PLAIN = frozenset({bool, int, float, complex, str, bytes, type(None)})


def _kind(value: Any, by_value: bool) -> Any:
    """All of a value that a hint can ask for, if `_asks_for_kinds` says so: its type, an array's dtype and shape, and
    the kinds of what a tuple holds."""
    kind = type(value)
    if kind in _PLAIN:
        return (kind, value) if by_value else kind
    if issubclass(kind, tuple):
        return (kind, *[_kind(part, by_value) for part in value])
    if hasattr(kind, "dtype") and hasattr(kind, "shape"):
        return (kind, value.dtype, value.shape)
    return kind


def _asks_for_kinds(hint: Any) -> bool:
    """Whether no check of a hint looks at more of a value than `_kind`: not so of what is in a list or a mapping, of
    type variables, or of protocols and other classes with an `isinstance` of their own."""
    origin = typing.get_origin(hint)
    if hint is None or hint is Any or origin is typing.Literal:
        return True
    if origin is collections.abc.Callable:
        return True  # whether it can be called
    if origin in (typing.Union, types.UnionType, tuple):
        return all(part is ... or _asks_for_kinds(part) for part in typing.get_args(hint))
    if origin is not None or not inspect.isclass(hint):
        return False
    if issubclass(hint, AbstractArray):
        return True
    return type(hint).__instancecheck__ in (type.__instancecheck__, abc.ABCMeta.__instancecheck__)


def _names_values(hint: Any) -> bool:
    return typing.get_origin(hint) is typing.Literal or any(_names_values(part) for part in typing.get_args(hint))


def _with_hints(function: types.FunctionType, hints: dict[str, Any]) -> types.FunctionType:
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__annotations__ = function.__kwdefaults__, hints
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    if isinstance(wrapped := getattr(function, "__wrapped__", None), types.FunctionType):
        copy.__dict__["__wrapped__"] = _with_hints(wrapped, hints)  # its arguments are looked at
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
