"""What a run says beside its results: which answers are missing, and why a file cannot be written."""

import errno
import os
from pathlib import Path

import pytest
from tiny_suites import make_suite

from unirender.errors import UnirenderError
from unirender_evaluation.methods.trivial import UneditedInput
from unirender_evaluation.records import Record, append_record, write_records
from unirender_evaluation.rows import make_row, prediction_rows
from unirender_evaluation.runs.folder import (
    missing_answers,
    say_missing,
    say_rows_without_values,
    unanswered,
    write_missing,
    writing_run,
)
from unirender_evaluation.tasks import tasks


def test_missing_answers_are_counted_and_listed(tmp_path: Path) -> None:
    suite = make_suite(tmp_path / "suite", objects=1)
    scene = suite.scenes[0]
    edit = next(tasks(suite, "rendering", "from-image", [scene]))
    folder = tmp_path / "mine" / edit.folder
    folder.mkdir(parents=True)
    for name in (f"{edit.answer}.png", "environment.exr"):
        (folder / name).write_bytes(b"")  # whether one is there, not what is in it
    rows = [make_row(UneditedInput(), "trivial"), *prediction_rows({"mine": tmp_path / "mine"})]
    missing = missing_answers(suite, rows, [scene])
    questions, asked = missing["mine"]
    assert missing.keys() == {"mine"}
    assert len(questions) == asked - 2
    said: list[str] = []
    write_missing(tmp_path, missing)
    say_missing(tmp_path, missing, said.append, "has files for")
    assert said == [f"mine: has files for 2 of {asked} questions; the others: {tmp_path / 'missing.txt'}"]
    lines = (tmp_path / "missing.txt").read_text().splitlines()
    assert lines == [f"mine: {question}" for question in questions]
    assert lines == sorted(lines), "the order of the suite says which object and material a name stands for"
    assert not any(scene.key in line or f"{edit.folder}/{edit.answer}" in line for line in lines)
    assert any(f"{edit.folder}/edit_" in line for line in lines)
    write_missing(tmp_path, {})
    assert not (tmp_path / "missing.txt").exists(), "that of an earlier run says nothing of this one"


@pytest.mark.parametrize("as_folder", [False, True])
def test_a_question_without_a_value_is_not_answered(tmp_path: Path, as_folder: bool) -> None:
    """A plug-in returned None, or nothing that is scored; a folder has a file of maps that are not asked for there."""
    suite = make_suite(tmp_path / "suite", objects=1)
    scenes = [suite.scenes[0]]
    edit, other = list(tasks(suite, "rendering", "from-image", scenes))[:2]
    (tmp_path / "mine" / edit.folder).mkdir(parents=True)
    (tmp_path / "mine" / edit.folder / "albedo.png").write_bytes(b"")
    plugin, (folder,) = make_row(UneditedInput(), "external", "mine"), prediction_rows({"mine": tmp_path / "mine"})
    rows = [make_row(UneditedInput(), "trivial"), folder if as_folder else plugin]
    record = Record(edit.table, edit.protocol, rows[1].info.key, edit.sample, "o", {"x": 1.0})
    missing = unanswered(suite, rows, scenes, [record])
    questions, asked = missing["mine"]
    assert len(questions) == asked - 1
    places = [f"{t.table}/{t.protocol}: {t.folder}/{t.answer}" if as_folder else t.identity for t in (edit, other)]
    assert [place in questions for place in places] == [False, True]
    assert unanswered(suite, rows[:1], scenes, [record]) == {}
    said: list[str] = []
    files = missing_answers(suite, rows, scenes)
    say_missing(tmp_path, unanswered(suite, rows, scenes, []), said.append, without_files=files)
    why = " (1 more have a file, but no map that is scored there)" if as_folder else ""
    assert said == [f"mine: answers 0 of {asked} questions{why}; the others: {tmp_path / 'missing.txt'}"]


def test_a_plugin_that_stands_in_no_table_is_named() -> None:
    rows = [make_row(UneditedInput(), kind, kind) for kind in ("external", "trivial")]
    said: list[str] = []
    say_rows_without_values(rows, [], said.append)
    assert len(said) == 1
    assert said[0].startswith("external: is in no table")
    record = Record("rendering", "from-image", rows[0].info.key, "s", "o", {})
    say_rows_without_values(rows, [record], said.append)
    assert len(said) == 1


@pytest.mark.parametrize(
    ("number", "to_do"),
    [(errno.ENOSPC, "free space"), (errno.EDQUOT, "free space"), (errno.EROFS, "make it writable")],
)
def test_a_full_disk_is_said(tmp_path: Path, number: int, to_do: str) -> None:
    unnamed = f"a file of the run, in {tmp_path} or among the system's temporary files"
    for named, shown in ((None, unnamed), *((name, name) for name in (str(tmp_path / "run.json"), "/elsewhere/file"))):
        said = f"cannot write {shown}: reason; {to_do}, the same command continues"
        with pytest.raises(UnirenderError, match=said), writing_run(tmp_path):
            raise OSError(number, "reason", named)


def test_a_disk_that_is_full_while_a_file_is_written_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system names none where a write fails."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    record = Record("inverse", "single-image", "m", "s", "o", {}, "key")
    monkeypatch.setattr(os, "fsync", full)
    appended, replaced = tmp_path / "records.jsonl", tmp_path / "unused.jsonl"
    appended.symlink_to("/dev/full")
    for path, write in (
        (appended, lambda: append_record(appended, record)),
        (replaced, lambda: write_records(replaced, [record])),
    ):
        said = f"cannot write {path}: No space left on device; free space"
        with pytest.raises(UnirenderError, match=said), writing_run(tmp_path):
            write()


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    for error in (OSError(errno.EIO, "reason"), PermissionError(errno.EACCES, "reason", "/elsewhere"), ValueError()):
        with pytest.raises(type(error)), writing_run(tmp_path):
            raise error
