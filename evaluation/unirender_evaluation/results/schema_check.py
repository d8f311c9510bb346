"""Validates a JSON document by a schema and says what is wrong in sentences.

Understands the keywords that `schema.json_schema` uses, no others: an unknown one is an error of the programmer, not a
check that is silently left out.
"""

import difflib
import functools
import itertools
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
    """Everything in a document that a schema does not allow; empty for a valid one.

    Raises:
        NotImplementedError: the schema has a keyword that is not understood here.
    """
    _check_keywords(schema)
    return list(_check(document, _resolved(schema, schema), schema, ""))


def _check_keywords(schema: Mapping[str, Any]) -> None:
    if unknown := schema.keys() - KEYWORDS:
        raise NotImplementedError(f"schema keywords {sorted(unknown)}: teach them to `schema_check`")
    named = [schema.get(key, {}).values() for key in ("properties", "$defs")]
    alone = [schema[key] for key in ("items", "additionalProperties", "propertyNames") if key in schema]
    for part in itertools.chain(*named, schema.get("anyOf", ()), alone):
        if isinstance(part, Mapping):  # `additionalProperties` may be a truth value
            _check_keywords(part)


def _resolved(schema: Mapping[str, Any], root: Mapping[str, Any]) -> Mapping[str, Any]:
    """The schema that a `$ref` stands for; any other as it is."""
    while "$ref" in schema:
        schema = root["$defs"][schema["$ref"].removeprefix("#/$defs/")]
    return schema


def _check(value: Any, schema: Mapping[str, Any], root: Mapping[str, Any], place: str) -> Iterator[Problem]:
    if not _fits(value, schema):
        yield Problem(place, f"got {quoted(value)}, expected {expected(schema)}")
    elif isinstance(value, dict):
        yield from _check_object(value, schema, root, place)
    elif isinstance(value, list):
        items = _resolved(schema.get("items", {}), root)
        for i, item in enumerate(value):
            if not _is_done(item, items):
                yield from _check(item, items, root, f"{place}[{i}]")


def _check_object(
    value: dict[str, Any], schema: Mapping[str, Any], root: Mapping[str, Any], place: str
) -> Iterator[Problem]:
    known, others = schema.get("properties", {}), schema.get("additionalProperties", {})
    others = others if others is False else _resolved(others, root)
    pattern = schema.get("propertyNames", {}).get("pattern", "")
    for name in schema.get("required", ()):
        if name not in value:
            yield Problem(place, f"field {name!r} is missing, expected {expected(known[name], root)}")
    for name, item in value.items():
        if name in known:
            own = _resolved(known[name], root)
            if not _is_done(item, own):
                yield from _check(item, own, root, f"{place}.{name}" if place else name)
        elif others is False:
            yield Problem(place, f"unknown field {name!r}{did_you_mean(name, known)}")
        else:
            if not _matches(pattern, name):
                yield Problem(place, f"got the name {name!r}, expected {expected(schema)}")
            if not _is_done(item, others):
                yield from _check(item, others, root, f"{place}[{quoted(name)}]")


def _is_done(value: Any, schema: Mapping[str, Any]) -> bool:
    """Whether a value is allowed and contains no others: a file has a million, most of which end here."""
    return not isinstance(value, (dict, list)) and _fits(value, schema)


def _fits(value: Any, schema: Mapping[str, Any]) -> bool:
    """Whether a value by itself, without what it contains, is allowed."""
    kinds, wanted = _kinds(type(value)), schema.get("type")
    if not kinds or (
        wanted is not None and (wanted not in kinds if isinstance(wanted, str) else kinds.isdisjoint(wanted))
    ):
        return False
    if "number" in kinds:
        if not -LARGEST <= value <= LARGEST or not schema.get("minimum", value) <= value <= schema.get(
            "maximum", value
        ):
            return False
    elif "string" in kinds and not (
        len(value) >= schema.get("minLength", 0) and ("pattern" not in schema or re.search(schema["pattern"], value))
    ):
        return False
    if "enum" in schema and value not in schema["enum"]:
        return False
    if "const" in schema and (value != schema["const"] or "boolean" in kinds):
        return False
    return "anyOf" not in schema or any(_fits(value, choice) for choice in schema["anyOf"])


@functools.cache
def _kinds(of: type) -> frozenset[str]:
    """The names in a schema of the type of a value; a truth value is no number."""
    if issubclass(of, bool):
        return frozenset(["boolean"])
    return frozenset(kind for kind, types in TYPES.items() if issubclass(of, types))


@functools.lru_cache(maxsize=1024)
def _matches(pattern: str, name: str) -> bool:
    """Whether the name of a field has a pattern; thousands of records have the same few names."""
    return re.search(pattern, name) is not None


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
    """A suggestion, whatever the case of its letters, or the names that there are."""
    names = {each.casefold(): each for each in known}
    close = difflib.get_close_matches(name.casefold(), names, 1)
    return f", did you mean {names[close[0]]!r}?" if close else f", expected one of {', '.join(names.values())}"
