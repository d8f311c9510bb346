"""How words of a command line become numbers and what may be None; what is refused is said without Python's words."""

import dataclasses
from typing import Any, get_args

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

NUMBERS = {int: "a whole number", float: "a number"}

registry = ConstructorRegistry()

Spec = PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None


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
            raise ValueError(f"got {words[0]!r}, expected {NUMBERS[kind]}.") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, int | kind),
        str_from_instance=lambda value: [str(value)],
    )


@registry.primitive_rule
def optional(asked: PrimitiveTypeInfo) -> Spec:
    """A value or None. The word None is taken, since an option may have another default, but not offered;
    of a choice it is not taken."""
    kinds = [kind for kind in get_args(asked.type) if kind is not type(None)]
    if len(kinds) != 1 or type(None) not in get_args(asked.type):
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], asked.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec
    return dataclasses.replace(
        spec,
        instance_from_str=lambda words: None if words == ["None"] else spec.instance_from_str(words),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )
