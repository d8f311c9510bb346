"""The result schema: round trips, and every refusal."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest

from unirender.errors import UnirenderError
from unirender_evaluation.records import (
    MethodInfo,
    Record,
    RunInfo,
    append_record,
    read_records,
    read_run,
    write_csv,
    write_records,
    write_run,
)
from unirender_evaluation.store import Store


def record(sample: str = "a", **changes: Any) -> Record:
    fields: dict[str, Any] = {
        "table": "inverse",
        "protocol": "single-image",
        "method": "ours",
        "sample": sample,
        "object": "cube",
        "values": {"albedo.psnr@masked-srgb-raw": 21.5, "albedo.psnr@whole-srgb-raw": math.inf},
        "key": "00",
    }
    return Record(**(fields | changes))


def run() -> RunInfo:
    methods = (MethodInfo("ours", "Ours", "ours", "Ours", 1, 1, 0, config={"mode": "mean"}),)
    return RunInfo("tiny", "abc", 64, methods, coverage=0.3, lpips=("alex",), seeds=(0, 1), limit=2)


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    write_records(path, [record("a"), record("b", seconds=0.5, subset="textured")])
    append_record(path, record("c"))
    assert read_records(path) == [record("a"), record("b", seconds=0.5, subset="textured"), record("c")]
    assert "Infinity" not in path.read_text()  # strict JSON


def test_csv_has_a_line_per_value_and_loses_no_digit(tmp_path: Path) -> None:
    exact = record("b", values={"normal.cosine": 0.1 + 0.2}, object='a "quoted", name')
    write_csv(tmp_path / "r.csv", [record("a"), exact])
    with (tmp_path / "r.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["sample"], row["metric"], float(row["value"])) for row in rows] == [
        ("a", "albedo.psnr@masked-srgb-raw", 21.5),
        ("a", "albedo.psnr@whole-srgb-raw", math.inf),
        ("b", "normal.cosine", 0.1 + 0.2),
    ]
    assert rows[2]["object"] == 'a "quoted", name'


def test_a_run_comes_back_as_it_was(tmp_path: Path) -> None:
    write_run(tmp_path / "run.json", run())
    assert read_run(tmp_path / "run.json") == run()
    assert run().method("ours").label == "Ours"
    with pytest.raises(UnirenderError, match="unknown method 'theirs'"):
        run().method("theirs")


def test_a_torn_last_line_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    path.write_text(record("a").to_json() + "\n" + record("b").to_json()[:40])
    with pytest.raises(UnirenderError, match="no newline"):
        read_records(path)


def test_one_measurement_twice_is_an_error(tmp_path: Path) -> None:
    write_records(tmp_path / "r.jsonl", [record("a"), record("a")])
    with pytest.raises(UnirenderError, match=r"line 2: .* occurs twice"):
        read_records(tmp_path / "r.jsonl")


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("not json", "line 1: not a JSON line"),
        ("[1]", "line 1: expected a JSON object"),
        ('{"table": "inverse"}', "line 1"),
        (record().to_json().replace('"subset"', '"subste"'), "subste"),
        (record().to_json().replace("21.5", '"good"'), "expected a number"),
        (record().to_json().replace("21.5", "9" * 5000), "line 1: not a JSON line"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, line: str, match: str) -> None:
    (tmp_path / "r.jsonl").write_text(line + "\n")
    with pytest.raises(UnirenderError, match=match):
        read_records(tmp_path / "r.jsonl")


def test_nan_is_refused_before_it_is_written() -> None:
    with pytest.raises(UnirenderError, match="not NaN"):
        record(values={"x": math.nan})
    with pytest.raises(UnirenderError, match="non-empty"):
        record(sample="")


def test_another_schema_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    with pytest.raises(UnirenderError, match="cannot read"):
        read_run(path)
    write_run(path, run())
    path.write_text(path.read_text().replace('"schema": 1', '"schema": 0'))
    with pytest.raises(UnirenderError, match="got schema 0, expected 1"):
        read_run(path)


@pytest.mark.parametrize(
    ("field", "value", "match"),
    [
        ("methods", 3, "run field 'methods': got 3, expected a list"),
        ("lpips", 0.5, "run field 'lpips': got 0.5, expected a list"),
        ("methods", [{"key": "a", "label": "A", "kind": "ours", "config": "x"}], "^MethodInfo: "),
        ("methods", ["x"], "expected a JSON object for MethodInfo, got str"),
    ],
)
def test_a_run_with_fields_of_another_kind_is_refused(field: str, value: object, match: str, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    write_run(path, run())
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    with pytest.raises(UnirenderError, match=match):
        read_run(path)


def test_what_a_killed_run_left_is_kept_and_a_broken_line_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "records.jsonl"
    write_records(path, [record("a"), record("b", key="01")])
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"table": "inv')

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("written anew: a run that is killed meanwhile would lose all records")

    monkeypatch.setattr(Path, "write_text", refuse)
    monkeypatch.setattr(Path, "write_bytes", refuse)
    assert len(Store.open(path).known) == 2
    monkeypatch.undo()
    assert path.read_bytes() == whole
    for line in (b"\xff\x00", b"{}"):
        path.write_bytes(whole + line + b"\n")
        with pytest.raises(UnirenderError, match=r"records.jsonl, line 3: .*delete that line"):
            Store.open(path)
