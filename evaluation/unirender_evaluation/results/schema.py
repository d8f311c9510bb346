"""The JSON Schema of a results file (`results.file`), made from the dataclasses that it holds.

The same dictionary is what `schema_check` validates by and what ships as `data/results.schema.json` for programs in
other languages, so that the three cannot drift apart (a test compares them). After a change of the fields:

    python -m unirender_evaluation.results.schema        # writes data/results.schema.json anew
"""

import dataclasses
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from unirender.system.whole_files import replace_file
from unirender_evaluation.metrics import METRICS
from unirender_evaluation.records import SCHEMA_VERSION, MethodInfo, Record, RunInfo

FORMAT = "unirender-results"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
INFINITIES = ("inf", "-inf")
NAME = {"minLength": 1}
PRINTED = {"pattern": r"^[^\u0000-\u001f\u007f-\u009f\u202a-\u202e\u2066-\u2069]+$"}  # no word to a terminal

# What a field means beyond its type: keywords, and the sentence that an error quotes after "expected".
FIELDS: Mapping[str, Mapping[str, dict[str, Any]]] = {
    "Record": {
        "table": {**NAME, "description": "a table: rendering, inverse, relighting, light, multi-view or physics"},
        "protocol": {**NAME, "description": "what the method was given, one of `definitions.protocols`"},
        "method": {**NAME, "description": "the key of one of `run.methods`"},
        "sample": {**NAME, "description": "the suite's name of the picture or question"},
        "object": {**NAME, "description": "the object's name: what intervals are over"},
        "key": {"description": "the content key, empty where there is none"},
        "subset": {**NAME, "description": 'the population, "main" unless a table is split'},
        "seconds": {"minimum": 0, "description": "wall time of the method on this sample, or null"},
    },
    "MethodInfo": {
        "key": {**NAME, "description": "what records refer to"},
        "label": {**PRINTED, "description": "what a table prints, without control characters"},
        "kind": {"description": "the kind of the row"},
        "published": {"description": "the name of the paper's row that it stands beside, or null"},
        "steps": {"minimum": 1, "description": "denoising steps, at least 1, or null"},
        "samples": {"minimum": 1, "description": "samples averaged for an answer, at least 1, or null"},
        "mask": {"description": "whose mask whole-frame figures use"},
        "stored": {"description": "where the row is from, if it was not measured in this run, or null"},
        "config": {"description": "everything that the row's answers depend on"},
    },
    "RunInfo": {
        "suite": {**NAME, "description": "the suite's name"},
        "suite_hash": {
            "pattern": "^[0-9a-f]{64}$",
            "description": "the sha256 of the suite's truth file, 64 hexadecimal digits",
        },
        "resolution": {"minimum": 1, "description": "pixels a side, at least 1"},
        "methods": {"description": "one entry for each row"},
        "coverage": {"minimum": 0, "maximum": 1, "description": "the masks' mean in [0, 1], or null"},
        "truth_spp": {"minimum": 1, "description": "samples per pixel of the truth, at least 1, or null"},
        "date": {"pattern": r"^(\d{4}-\d{2}-\d{2})?$", "description": "the day of the run, YYYY-MM-DD, or empty"},
        "unchecked": {"description": "why the truth was not rendered again in this run, or empty"},
        "carried": {"description": "when records were measured that an earlier state of the code made, or empty"},
        "limit": {"minimum": 1, "description": "the number of scenes of a partial run, at least 1, or null"},
        "mitsuba": {"description": "the version of Mitsuba that rendered the truth, or null"},
    },
}
LIGHTS = "the lights that the sample's values depend on: its scene's; where it is relit, then that it is relit by"
VALUES = {
    "type": "object",
    "propertyNames": {"pattern": r"^[a-z0-9_]+\.[a-z0-9_]+(@[a-z_]+(-[a-z_]+)*)?$"},
    "additionalProperties": {
        "anyOf": [{"type": "number"}, {"enum": list(INFINITIES)}],
        "description": 'a number, or "inf" for the PSNR of identical pictures; leave out what does not exist',
    },
    "description": "metric key (quantity.metric@variant) -> value",
}


def json_schema() -> dict[str, Any]:
    """The schema of a whole file, draft 2020-12."""
    metric = _object(
        {
            "label": {"type": "string"},
            "unit": {"type": "string", "description": 'the unit, "" without one'},
            "higher_is_better": {"type": "boolean"},
            "formula": {"type": "string"},
        }
    )
    record = _of_dataclass(Record)
    record["properties"]["values"] = VALUES
    run = _of_dataclass(RunInfo)
    del run["properties"]["schema"]  # said once, at the top
    run["properties"]["methods"]["items"] = {"$ref": "#/$defs/method"}
    lights = {"type": "array", "items": {"type": "string", **NAME}, "description": LIGHTS}
    backbones = [name.removeprefix("lpips_") for name in METRICS if name.startswith("lpips_")]
    run["properties"]["lpips"]["items"] = {"enum": backbones}
    whole = _object(
        {
            "format": {"const": FORMAT},
            "schema": {"const": SCHEMA_VERSION},
            "run": {"$ref": "#/$defs/run"},
            "definitions": _object(
                {
                    "protocols": {"type": "object", "additionalProperties": {"type": "string"}},
                    "metrics": {"type": "object", "additionalProperties": metric},
                }
            ),
            "lights": {"type": "object", "additionalProperties": lights},
            "records": {"type": "array", "items": {"$ref": "#/$defs/record"}},
        }
    )
    return {
        "$schema": DIALECT,
        "title": "Results of a unirender benchmark run: its description and every per-sample value",
        **whole,
        "required": [name for name in whole["required"] if name != "lights"],  # which are not known of all
        "$defs": {"method": _of_dataclass(MethodInfo), "record": record, "run": run},
    }


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    """An object that has all of these properties and no others."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _of_dataclass(cls: type) -> dict[str, Any]:
    """An object with the fields of a dataclass; those without a default are required."""
    hints = get_type_hints(cls)
    fields = dataclasses.fields(cls)
    needed = [f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING]
    described = FIELDS[cls.__name__]
    return {
        **_object({f.name: _of_type(hints[f.name]) | described.get(f.name, {}) for f in fields}),
        "required": needed,
    }


def _of_type(hint: Any) -> dict[str, Any]:
    """The JSON schema of a type annotation."""
    simple = {str: "string", int: "integer", float: "number", NoneType: "null", bool: "boolean"}
    if hint in simple:
        return {"type": simple[hint]}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin in (Union, UnionType):
        return {"type": [simple[argument] for argument in arguments]}
    if origin is tuple:
        return {"type": "array", "items": _of_type(arguments[0])}
    if origin is Mapping:
        return {"type": "object", "additionalProperties": _of_type(arguments[1])}
    return {}  # Any, and MethodInfo, which has a definition of its own


def shipped_schema_path() -> Path:
    """Where the schema is in the package."""
    return Path(str(resources.files("unirender_evaluation"))) / "data" / "results.schema.json"


def schema_text() -> str:
    """The content of the shipped file."""
    return json.dumps(json_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    replace_file(shipped_schema_path(), schema_text())
