"""Validates a JSON document by a schema and says what is wrong in sentences.

Understands the keywords that `schema.json_schema` uses, no others: an unknown one is an error of the programmer, not a
check that is silently left out.
"""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

KEYWORDS = {
    *("$ref", "type", "enum", "const", "anyOf", "pattern", "minLength", "minimum", "maximum"),
    *("properties", "required", "additionalProperties", "propertyNames", "items"),
    *("$schema", "$defs", "title", "description"),
}
TYPES: Mapping[str, tuple[type, ...]] = {
    "string": (str,),
    "integer": (int,),
    "number": (int, float),
    "boolean": (bool,),
    "null": (type(None),),
    "array": (list,),
    "object": (dict,),
}
ARTICLES = {"array": "a list", "object": "an object", "integer": "an integer", "null": "null"}
LARGEST = 1e300  # a number beyond it is a mistake: 1e999 would be read as infinity
LONG = 60  # characters of a value that a sentence quotes


@dataclass(frozen=True)
class Problem:
    """What is wrong, and where: `records[3].values`; empty for the file as a whole."""

    place: str
    what: str

    def __str__(self) -> str:
        return f"{self.place}: {self.what}" if self.place else self.what


def schema_problems(document: Any, schema: Mapping[str, Any]) -> list[Problem]:
    """Everything in a document that a schema does not allow; empty for a valid one."""
    return list(_check(document, schema, schema, ""))


def _check(value: Any, schema: Mapping[str, Any], root: Mapping[str, Any], place: str) -> Iterator[Problem]:
    if "$ref" in schema:
        name = schema["$ref"].removeprefix("#/$defs/")
        yield from _check(value, root["$defs"][name], root, place)
        return
    unknown = schema.keys() - KEYWORDS
    if unknown:
        raise NotImplementedError(f"schema keywords {sorted(unknown)}: teach them to `schema_check`")
    if not _fits(value, schema):
        yield Problem(place, f"got {quoted(value)}, expected {expected(schema)}")
    elif isinstance(value, dict):
        yield from _check_object(value, schema, root, place)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _check(item, schema.get("items", {}), root, f"{place}[{i}]")


def _check_object(
    value: dict[str, Any], schema: Mapping[str, Any], root: Mapping[str, Any], place: str
) -> Iterator[Problem]:
    known, others = schema.get("properties", {}), schema.get("additionalProperties", {})
    for name in schema.get("required", ()):
        if name not in value:
            yield Problem(place, f"field {name!r} is missing, expected {expected(known[name], root)}")
    for name, item in value.items():
        inner = f"{place}.{name}" if place else name
        if name in known:
            yield from _check(item, known[name], root, inner)
        elif others is False:
            yield Problem(place, f"unknown field {name!r}{did_you_mean(name, known)}")
        else:
            pattern = schema.get("propertyNames", {}).get("pattern")
            if pattern and not re.search(pattern, name):
                yield Problem(place, f"got the name {name!r}, expected {expected(schema)}")
            yield from _check(item, others, root, f"{place}[{quoted(name)}]")


def _fits(value: Any, schema: Mapping[str, Any]) -> bool:
    """Whether a value by itself, without what it contains, is allowed."""
    kinds = schema.get("type", list(TYPES))
    kinds = [kinds] if isinstance(kinds, str) else kinds
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    return all(
        (
            any(_is(value, kind) for kind in kinds),
            "enum" not in schema or value in schema["enum"],
            "const" not in schema or (value == schema["const"] and not isinstance(value, bool)),
            "anyOf" not in schema or any(_fits(value, choice) for choice in schema["anyOf"]),
            not isinstance(value, str) or re.search(schema.get("pattern", ""), value) is not None,
            not isinstance(value, str) or len(value) >= schema.get("minLength", 0),
            not numeric or schema.get("minimum", value) <= value <= schema.get("maximum", value),
        )
    )


def _is(value: Any, kind: str) -> bool:
    if isinstance(value, int | float) and not isinstance(value, bool) and not -LARGEST <= value <= LARGEST:
        return False
    return isinstance(value, TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))


def expected(schema: Mapping[str, Any], root: Mapping[str, Any] | None = None) -> str:
    """What a schema allows, in words."""
    if "$ref" in schema and root is not None:
        schema = root["$defs"][schema["$ref"].removeprefix("#/$defs/")]
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    if "const" in schema:
        return repr(schema["const"])
    kinds = schema.get("type", ())
    text = " or ".join(ARTICLES.get(kind, f"a {kind}") for kind in ([kinds] if isinstance(kinds, str) else kinds))
    if "description" not in schema:
        return text or "a value"
    return f"{text} ({schema['description']})" if text else schema["description"]


def quoted(value: Any) -> str:
    """A value as an error message shows it."""
    text = repr(value)
    return text if len(text) <= LONG else f"{text[:LONG]}…"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A suggestion, or the names that there are."""
    names = list(known)
    close = difflib.get_close_matches(name, names, 1)
    return f", did you mean {close[0]!r}?" if close else f", expected one of {', '.join(names)}"
