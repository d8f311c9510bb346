"""The JSON Schema of results: shipped as the code makes it, and our reading of it against another implementation's."""

import copy
import dataclasses
import json
import re
from collections.abc import Callable
from typing import Any

import jsonschema
import pytest
from small_results import small_document

from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.results.schema import json_schema, schema_text, shipped_schema_path
from unirender_evaluation.results.schema_check import schema_problems


def test_the_shipped_schema_is_the_codes() -> None:
    shipped = shipped_schema_path().read_text(encoding="utf-8")
    assert shipped == schema_text(), "run python -m unirender_evaluation.results.schema"
    jsonschema.Draft202012Validator.check_schema(json.loads(shipped))


def test_it_has_every_field_of_what_a_run_writes() -> None:
    schema = json_schema()
    for name, cls in (("record", Record), ("method", MethodInfo), ("run", RunInfo)):
        fields = {f.name for f in dataclasses.fields(cls)} - ({"schema"} if cls is RunInfo else set())
        assert schema["$defs"][name]["properties"].keys() == fields
    assert schema["$defs"]["record"]["required"] == ["table", "protocol", "method", "sample", "object", "values"]


def changed(*path: Any, to: Any = ..., drop: bool = False) -> Callable[[dict[str, Any]], None]:
    """What sets, or drops, an item of a document."""

    def apply(document: Any) -> None:
        for step in path[:-1]:
            document = document[step]
        if drop:
            del document[path[-1]]
        else:
            document[path[-1]] = to

    return apply


PSNR = "albedo.psnr@masked-srgb-raw"
BROKEN = {
    "unknown field": (changed("run", "mask", to=1), "run: unknown field 'mask'"),
    "misspelt": (changed("run", "coverag", to=0.1), "did you mean coverage?"),
    "missing": (changed("run", "suite_hash", drop=True), "run: field 'suite_hash' is missing, expected a string (the"),
    "missing part": (changed("records", drop=True), "field 'records' is missing, expected a list"),
    "hash": (changed("run", "suite_hash", to="abc"), "run.suite_hash: got 'abc', expected a string (the sha256 of"),
    "type": (changed("run", "resolution", to="64"), "run.resolution: got '64', expected an integer (pixels a side"),
    "bool": (changed("run", "resolution", to=True), "run.resolution: got True"),
    "range": (changed("run", "coverage", to=1.5), "run.coverage: got 1.5, expected a number or null (the masks'"),
    "date": (changed("run", "date", to="31.1.2026"), "run.date: got '31.1.2026', expected a string (the day"),
    "list": (changed("run", "seeds", to=0), "run.seeds: got 0, expected a list"),
    "item": (changed("run", "seeds", to=[0, "1"]), "run.seeds[1]: got '1', expected an integer"),
    "backbone": (changed("run", "lpips", to=["squeeze"]), "run.lpips[0]: got 'squeeze', expected one of vgg, alex"),
    "kind": (changed("run", "methods", 0, "kind", to="best"), "run.methods[0].kind: got 'best', expected one of ours"),
    "label": (changed("run", "methods", 0, "label", to="a\x1b[2J"), "run.methods[0].label: got 'a\\x1b[2J', expected"),
    "steps": (changed("run", "methods", 0, "steps", to=0), "run.methods[0].steps: got 0"),
    "empty": (changed("records", 2, "sample", to=""), "records[2].sample: got '', expected a string (the suite's name"),
    "values": (changed("records", 0, "values", to=[1]), "records[0].values: got [1], expected an object (metric key"),
    "value": (changed("records", 0, "values", PSNR, to="good"), f"values['{PSNR}']: got 'good', expected a number"),
    "null": (changed("records", 0, "values", PSNR, to=None), "got None, expected a number, or \"inf\""),
    "key": (changed("records", 0, "values", "Albedo PSNR", to=1), "records[0].values: got the name 'Albedo PSNR'"),
    "seconds": (changed("records", 0, "seconds", to=-1), "records[0].seconds: got -1"),
    "metric": (changed("definitions", "metrics", "psnr", "formula", drop=True), "definitions.metrics['psnr']: field"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_field_is_named_and_refused_by_both_implementations(name: str) -> None:
    change, said = BROKEN[name]
    document, other = small_document(), jsonschema.Draft202012Validator(json_schema())
    assert schema_problems(document, json_schema()) == []
    assert other.is_valid(document)
    broken = copy.deepcopy(document)
    change(broken)
    problems = schema_problems(broken, json_schema())
    assert len(problems) == 1
    assert said in str(problems[0])
    assert not other.is_valid(broken)


def test_a_number_beyond_all_measure_is_no_number() -> None:
    for number in (1e301, 10**400):
        document = small_document()
        document["records"][0]["values"][PSNR] = number
        assert len(schema_problems(document, json_schema())) == 1


def test_a_keyword_that_is_not_understood_is_an_error_not_a_pass() -> None:
    with pytest.raises(NotImplementedError, match="uniqueItems"):
        schema_problems([1, 1], {"type": "array", "uniqueItems": True})


def test_a_name_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    document, searched = small_document(), []
    record = document["records"][0]
    document["records"] = 50 * [record | {"values": {f"albedo.m{i}": 0.5 for i in range(8)}}]
    search = re.search
    monkeypatch.setattr(re, "search", lambda pattern, text: searched.append(text) or search(pattern, text))
    assert schema_problems(document, json_schema()) == []
    assert len(searched) == len(set(searched)) > 8  # a file has a million values, of a few hundred names


def test_a_schema_is_read_once_whatever_the_number_of_values() -> None:
    read = []

    class Schema(dict):
        def get(self, key: str, default: Any = None) -> Any:
            read.append(key)
            return super().get(key, default)

    def reads(values: int) -> int:
        read.clear()
        each = Schema({"type": "number", "minimum": 0, "description": "a share"})
        document = {f"m{i}": 0.5 for i in range(values)} | {"bad": -1}
        problems = schema_problems(document, {"type": "object", "additionalProperties": each})
        assert [str(problem) for problem in problems] == ["['bad']: got -1, expected a number (a share)"]
        return len(read)

    assert reads(1000) == reads(1)
