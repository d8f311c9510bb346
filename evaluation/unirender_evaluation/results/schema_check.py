"""Validates a JSON document by a schema and says what is wrong in sentences.

Understands the keywords that `schema.json_schema` uses, no others: an unknown one is an error of the programmer, not a
check that is silently left out.
"""

import functools
import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from unirender.system.wording import instead

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
    return list(_check(document, Rule(schema, schema), ""))


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


class Rule:
    """A part of a schema, read once for all of the values that it is held against: a file has a million.

    Attributes:
        schema: the part, or what its `$ref` stands for.
    """

    def __init__(self, schema: Mapping[str, Any], root: Mapping[str, Any]) -> None:
        self.root, self.schema = root, _resolved(schema, root)
        read = self.schema.get
        wanted = read("type", tuple(TYPES))
        self._kinds = frozenset([wanted] if isinstance(wanted, str) else wanted)
        self._least, self._most = read("minimum", -LARGEST), read("maximum", LARGEST)
        self._shortest, self._pattern, self._choices = read("minLength", 0), read("pattern"), read("enum")
        self._alternatives = [Rule(part, root) for part in read("anyOf", ())]

    def allows(self, value: Any) -> bool:
        """Whether a value by itself, without what it contains, is allowed."""
        kinds = _kinds(type(value))
        if kinds.isdisjoint(self._kinds):
            return False
        if "number" in kinds:
            if not self._least <= value <= self._most:
                return False
        elif "string" in kinds and not (
            len(value) >= self._shortest and (self._pattern is None or re.search(self._pattern, value))
        ):
            return False
        if self._choices is not None and value not in self._choices:
            return False
        if "const" in self.schema and (value != self.schema["const"] or "boolean" in kinds):
            return False
        return not self._alternatives or any(rule.allows(value) for rule in self._alternatives)

    @functools.cached_property
    def properties(self) -> "dict[str, Rule]":
        """Those of the fields of an object that have a name."""
        return {name: Rule(part, self.root) for name, part in self.schema.get("properties", {}).items()}

    @functools.cached_property
    def others(self) -> "Rule | None":
        """That of all other fields of an object; None where there may be none."""
        others = self.schema.get("additionalProperties", {})
        return None if others is False else Rule(others, self.root)

    @functools.cached_property
    def items(self) -> "Rule":
        """That of the items of a list."""
        return Rule(self.schema.get("items", {}), self.root)


def _check(value: Any, rule: Rule, place: str) -> Iterator[Problem]:
    if not rule.allows(value):
        yield Problem(place, f"got {quoted(value)}, expected {expected(rule.schema)}")
    elif isinstance(value, dict):
        yield from _check_object(value, rule, place)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            if not _is_done(item, rule.items):
                yield from _check(item, rule.items, f"{place}[{i}]")


def _check_object(value: dict[str, Any], rule: Rule, place: str) -> Iterator[Problem]:
    known, others = rule.properties, rule.others
    pattern = rule.schema.get("propertyNames", {}).get("pattern", "")
    for name in rule.schema.get("required", ()):
        if name not in value:
            yield Problem(place, f"field {name!r} is missing, expected {expected(known[name].schema)}")
    for name, item in value.items():
        if name in known:
            if not _is_done(item, known[name]):
                yield from _check(item, known[name], f"{place}.{name}" if place else name)
        elif others is None:
            yield Problem(place, f"unknown field {name!r}{instead(name, known)}")
        else:
            if not _matches(pattern, name):
                yield Problem(place, f"got the name {name!r}, expected {expected(rule.schema)}")
            if not _is_done(item, others):
                yield from _check(item, others, f"{place}[{quoted(name)}]")


def _is_done(value: Any, rule: Rule) -> bool:
    """Whether a value is allowed and contains no others: most of them end here."""
    return not isinstance(value, (dict, list)) and rule.allows(value)


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


def expected(schema: Mapping[str, Any]) -> str:
    """What a schema allows, in words."""
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
