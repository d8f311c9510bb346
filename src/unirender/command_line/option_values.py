"""How words of a command line become numbers, choices and what may be None; what is refused is said without Python's
words."""

import dataclasses
from typing import Any, Literal, get_args, get_origin

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from unirender.system.wording import one_of

NUMBERS = {int: "a whole number", float: "a number"}

registry = ConstructorRegistry()

Spec = PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None


class WrongValue(ValueError):
    """The word after an option, and what is expected there."""

    def __init__(self, word: str, expected: str) -> None:
        super().__init__(f"{word}: {expected}")


@registry.primitive_rule
def number(asked: PrimitiveTypeInfo) -> Spec:
    """An int or a float."""
    kind: Any = asked.type
    if kind not in NUMBERS:
        return None

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise WrongValue(words[0], f"expected {NUMBERS[kind]}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, int | kind),
        str_from_instance=lambda value: [str(value)],
    )


@registry.primitive_rule
def choice(asked: PrimitiveTypeInfo) -> Spec:
    """One of some words."""
    if get_origin(asked.type) is not Literal:
        return None
    names = get_args(asked.type)

    def read(words: list[str]) -> Any:
        if words[0] not in names:
            raise WrongValue(words[0], one_of(words[0], names))
        return words[0]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=read,
        is_instance=lambda value: value in names,
        str_from_instance=lambda value: [value],
    )


@registry.primitive_rule
def several(asked: PrimitiveTypeInfo) -> Spec:
    """Any number of numbers or choices. (tyro's own rule would not say which of the words is wrong.)"""
    kinds = get_args(asked.type)
    if get_origin(asked.type) is not tuple or kinds[1:] != (...,):
        return None
    if kinds[0] not in NUMBERS and get_origin(kinds[0]) is not Literal:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], asked.markers))
    assert not isinstance(spec, UnsupportedTypeAnnotationError), "a number or a choice"
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"[{spec.metavar} [...]]",
        instance_from_str=lambda words: tuple(spec.instance_from_str([word]) for word in words),
        is_instance=lambda value: isinstance(value, tuple) and all(map(spec.is_instance, value)),
        str_from_instance=lambda value: [word for each in value for word in spec.str_from_instance(each)],
    )


@registry.primitive_rule
def optional(asked: PrimitiveTypeInfo) -> Spec:
    """A value or None. The word None is taken, since an option may have another default, but not offered; among the
    words of a choice it is none."""
    kinds = [kind for kind in get_args(asked.type) if kind is not type(None)]
    if len(kinds) != 1 or type(None) not in get_args(asked.type):
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], asked.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec
    takes_none = get_origin(kinds[0]) is not Literal
    return dataclasses.replace(
        spec,
        instance_from_str=lambda words: None if takes_none and words == ["None"] else spec.instance_from_str(words),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )
