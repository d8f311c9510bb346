"""The result schema: what a benchmark run writes down, one line per sample, and how it is read back.

A run is a folder with two files:

- `records.jsonl`: one `Record` a line; every per-sample value is kept, so that tables, intervals and paired tests can
  be made again, by us or by a stranger, without running a method;
- `run.json`: the `RunInfo`: suite, hashes, versions and one `MethodInfo` per row.

A value that does not exist (metric not defined, backbone not available) is *absent*; NaN is refused. An infinite value
(PSNR of identical images) is stored as the string "inf", because JSON has no infinity.
"""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from unirender.errors import UnirenderError
from unirender.system.whole_files import naming, replace_file

SCHEMA_VERSION = 1

T = TypeVar("T")

MethodKind = Literal["ours", "paper", "optimisation", "baseline", "trivial", "ceiling", "reference", "external"]
METHOD_KINDS: tuple[str, ...] = get_args(MethodKind)


@dataclass(frozen=True)
class Record:
    """All values of one method on one sample of one table under one protocol.

    `values` maps metric keys (`unirender_evaluation.metrics.metric_key`, e.g. `albedo.psnr@masked-srgb-raw`) to floats;
    all variants lie side by side in it. Samples of one object are not independent: `object` is what
    intervals are over.
    """

    table: str  # "rendering", "inverse", "relighting", "light", "physics", "multi-view"
    protocol: str  # key of `tables.PROTOCOLS`, e.g. "from-image", "given", "given-light"
    method: str  # key of a MethodInfo
    sample: str  # key of the suite's sample (and edit, where one input has several)
    object: str  # the object's name
    values: Mapping[str, float]  # metric key -> value; inf allowed, NaN not
    key: str = ""  # sha256 of (scene, method config, code version): what a resumed run looks up
    subset: str = "main"  # population: "main", or e.g. "textured"; tables never mix two
    seconds: float | None = None  # wall time of the method on this sample, None = not measured

    def __post_init__(self) -> None:
        for name in ("table", "protocol", "method", "sample", "object", "subset"):
            value = getattr(self, name)
            if not isinstance(value, str) or not value:
                raise UnirenderError(f"record field {name!r}: got {value!r}, expected a non-empty string")
        if not isinstance(self.key, str):
            raise UnirenderError(f"record field 'key': got {self.key!r}, expected a string")
        for metric, value in self.values.items():
            if not _is_number(value):
                raise _no_number(f"{self.table}/{self.method}/{self.sample}/{metric}", value)
        object.__setattr__(self, "values", dict(self.values))

    @property
    def identity(self) -> tuple[str, ...]:
        """Which measurement it is, whatever code has made it."""
        return self.table, self.protocol, self.method, self.sample, self.subset

    def to_json(self) -> str:
        """Returns one line of strict JSON (infinities as strings)."""
        return json.dumps(self.to_plain(), allow_nan=False, sort_keys=True)

    def to_plain(self) -> dict[str, Any]:
        """Returns what `to_json` writes, before it is text."""
        return vars(self) | {"values": {k: _encode(v) for k, v in self.values.items()}}

    @classmethod
    def from_json(cls, line: str) -> "Record":
        """Inverse of `to_json`.

        Raises:
            UnirenderError: if the line is no JSON object, or a field is missing, unknown or of the wrong kind.
        """
        try:
            data = json.loads(line)
        except (ValueError, RecursionError) as error:  # no JSON, a number of thousands of digits, nested too deeply
            raise UnirenderError(f"not a JSON line: {line[:80]!r} ({error})") from error
        return cls.from_plain(data)

    @classmethod
    def from_plain(cls, data: Any) -> "Record":
        """Inverse of `to_plain`; raises UnirenderError as `from_json` does."""
        return _build(cls, data | {"values": _decode_values(data.get("values"))} if isinstance(data, dict) else data)


@dataclass(frozen=True)
class MethodInfo:
    """One row of the tables: what ran, and under which published name (if any) it appears in the paper."""

    key: str  # what records refer to, e.g. "unirender-mean"
    label: str  # what a table prints, e.g. "Ours (mean, 1 step)"
    kind: MethodKind
    published: str | None = None  # row name in published.json whose numbers stand beside, e.g. "Ours"
    steps: int | None = None  # denoising steps; None = does not apply
    samples: int | None = None  # samples averaged per prediction
    seed: int | None = None
    mask: Literal["own", "pasted"] = "pasted"  # whole-frame figures: the method's own mask, or the true one pasted
    stored: str | None = None  # not measured in this run: "2026-11-21, suite 3f2a..., code 8c1d..."
    note: str = ""  # printed below the table
    config: Mapping[str, Any] = field(default_factory=dict)  # the resolved configuration

    def __post_init__(self) -> None:
        if self.kind not in METHOD_KINDS:
            raise UnirenderError(f"method {self.key!r}: got kind {self.kind!r}, expected one of {METHOD_KINDS}")
        object.__setattr__(self, "config", dict(self.config))  # a read-only view cannot be written down


@dataclass(frozen=True)
class RunInfo:
    """What every table of a run prints as its protocol, together with the rows."""

    suite: str
    suite_hash: str
    resolution: int
    methods: tuple[MethodInfo, ...]
    coverage: float | None = None  # mean of the true masks over the suite, [0, 1]
    exposure: str = "folded into the light (gauge of the suite)"
    lpips: tuple[str, ...] = ()  # backbones that were available: "alex", "vgg"
    mitsuba: str | None = None  # version that rendered the truth
    truth_spp: int | None = None
    code: str = ""  # version or hash of the code
    date: str = ""  # ISO date of the run
    unchecked: str = ""  # why the truth was not rendered again in this run, if it was not
    carried: str = ""  # of which date and code records are that an earlier state of the code measured, if any are
    limit: int | None = None  # --limit: tables are watermarked
    seeds: tuple[int, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)  # versions, CPU
    schema: int = SCHEMA_VERSION

    def __repr__(self) -> str:
        when = self.date or "no date"
        return f"RunInfo(suite {self.suite} at {self.resolution} px, {when}, {len(self.methods)} methods)"

    def method(self, key: str) -> MethodInfo:
        """Returns the row of that key; raises UnirenderError if the run has none."""
        for info in self.methods:
            if info.key == key:
                return info
        known = ", ".join(info.key for info in self.methods) or "none"
        raise UnirenderError(f"unknown method {key!r}: the run describes {known}")


def write_records(path: Path, records: Iterable[Record]) -> None:
    """Writes records as JSONL, atomically (temporary file, fsync, rename)."""
    replace_file(path, "".join(record.to_json() + "\n" for record in records))


def write_csv(path: Path, records: Iterable[Record]) -> None:
    """Writes one line per value, for spreadsheets and data frames: what was measured, then `metric` and `value`."""
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\n")
    names = ("table", "protocol", "subset", "method", "sample", "object")
    writer.writerow((*names, "metric", "value"))
    for record in records:
        for metric, value in sorted(record.values.items()):
            writer.writerow((*(getattr(record, name) for name in names), metric, repr(float(value))))
    replace_file(path, buffer.getvalue())


def append_record(path: Path, record: Record) -> None:
    """Appends one record; a reader ignores nothing, so a torn last line is an error that `read_records` names."""
    with naming(path), path.open("a", encoding="utf-8") as file:
        file.write(record.to_json() + "\n")


def read_records(path: Path) -> list[Record]:
    """Reads a JSONL file of records.

    Raises:
        UnirenderError: on an unreadable file or line (with its number), on a last line that a killed run left without
            its newline, or if two lines are the same measurement.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UnirenderError(f"cannot read records from {path}: {error}") from error
    lines = text.split("\n")
    if lines.pop():
        raise UnirenderError(f"{path}: the last line has no newline (a run was killed while writing); run it again")
    records, seen = [], set()
    for number, line in enumerate(lines, start=1):
        try:
            record = Record.from_json(line)
        except UnirenderError as error:
            raise UnirenderError(f"{path}, line {number}: {error}") from error
        if record.identity in seen:
            raise UnirenderError(f"{path}, line {number}: {record.identity} occurs twice; delete one of the two")
        seen.add(record.identity)
        records.append(record)
    return records


def write_run(path: Path, run: RunInfo) -> None:
    """Writes a `RunInfo` as JSON, atomically."""
    replace_file(path, json.dumps(dataclasses.asdict(run), indent=2, sort_keys=True, allow_nan=False) + "\n")


def read_run(path: Path) -> RunInfo:
    """Reads a `RunInfo`.

    Raises:
        UnirenderError: if the file cannot be read, or was written under another schema version.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UnirenderError(f"cannot read the run's description from {path}: {error}") from error
    if not isinstance(data, dict) or data.get("schema") != SCHEMA_VERSION:
        got = data.get("schema") if isinstance(data, dict) else type(data).__name__
        raise UnirenderError(f"{path}: got schema {got!r}, expected {SCHEMA_VERSION}; make the run again")
    return run_from_plain(data)


def run_from_plain(data: dict[str, Any]) -> RunInfo:
    """A `RunInfo` from the JSON object that `write_run` writes; raises UnirenderError on unknown or missing fields."""
    lists = {name: data.get(name, []) for name in ("methods", "lpips", "seeds")}
    if wrong := [name for name, value in lists.items() if not isinstance(value, list)]:
        raise UnirenderError(f"run field {wrong[0]!r}: got {lists[wrong[0]]!r:.60}, expected a list")
    methods = tuple(_build(MethodInfo, item) for item in lists["methods"])
    return _build(RunInfo, data | {name: tuple(value) for name, value in lists.items()} | {"methods": methods})


def _build(cls: type[T], data: Any) -> T:
    if not isinstance(data, dict):
        raise UnirenderError(f"expected a JSON object for {cls.__name__}, got {type(data).__name__}")
    try:
        return cls(**data)
    except UnirenderError:
        raise
    except (TypeError, ValueError) as error:
        raise UnirenderError(f"{cls.__name__}: {error}".replace("__init__() ", "")) from error


def _encode(value: float) -> float | str:
    return float(value) if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def _decode_values(values: Any) -> dict[str, float]:
    if not isinstance(values, dict):
        raise UnirenderError(f"record field 'values': got {type(values).__name__}, expected an object")
    infinities: dict[Any, Any] = {"inf": math.inf, "-inf": -math.inf}
    decoded = {
        name: infinities.get(value, value) if isinstance(value, str) else value for name, value in values.items()
    }
    for name, value in decoded.items():
        if not _is_number(value):
            raise _no_number(name, value)
    return decoded


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and not math.isnan(value)


def _no_number(name: str, value: Any) -> UnirenderError:
    return UnirenderError(
        f"value of {name!r} is {value!r}, expected a number that is not NaN; leave out what does not exist"
    )
