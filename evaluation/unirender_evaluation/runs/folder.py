"""What a run says beside its results: which questions a stranger's row does not answer, and why a file cannot be
written."""

import contextlib
import errno
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from unirender.errors import UnirenderError
from unirender.system.whole_files import replace_file
from unirender_evaluation.records import Record
from unirender_evaluation.rows import Row
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import tasks

MISSING = "missing.txt"
TO_DO = {
    errno.ENOSPC: "free space",
    errno.EDQUOT: "free space",
    errno.EROFS: "make it writable",
    errno.EACCES: "make it writable",
}


@contextlib.contextmanager
def writing_run(folder: Path) -> Iterator[None]:
    """For a block that writes a run's folder.

    Raises:
        UnirenderError: a disk is full, or not writable any more; other errors come as they are.
    """
    try:
        yield
    except OSError as error:
        named = isinstance(error.filename, str)
        inside = named and Path(error.filename).absolute().is_relative_to(folder.absolute())
        if error.errno not in TO_DO or (error.errno == errno.EACCES and not inside):  # that may be a file to be read
            raise
        what = error.filename if named else f"a file of the run, in {folder} or among the system's temporary files"
        raise UnirenderError(
            f"cannot write {what}: {error.strerror}; {TO_DO[error.errno]}, the same command continues"
        ) from error


def missing_answers(suite: Suite, rows: Sequence[Row], scenes: list[Scene]) -> dict[str, tuple[list[str], int]]:
    """Of each row that is a folder, by its label: the questions without a file, and how many the run has."""
    folders = [row for row in rows if row.predictions is not None]
    every = [task for question in PROTOCOLS for task in tasks(suite, *question, scenes)] if folders else []
    return {
        row.info.label: (_names(row, (task for task in every if not row.answers(task, scenes))), len(every))
        for row in folders
    }


def unanswered(
    suite: Suite, rows: Sequence[Row], scenes: list[Scene], records: Sequence[Record]
) -> dict[str, tuple[list[str], int]]:
    """Of each stranger's row, by its label: the questions without a value among the records, and how many there are.

    A plug-in returned None there; of a folder there is no file, or one of maps that the question does not ask for.
    """
    strangers = [row for row in rows if row.info.kind == "external"]
    every = [task for question in PROTOCOLS for task in tasks(suite, *question, scenes)] if strangers else []
    found = {(r.method, f"{r.table}/{r.protocol}/{r.sample}") for r in records}
    return {
        row.info.label: (_names(row, (t for t in every if (row.info.key, t.identity) not in found)), len(every))
        for row in strangers
    }


def _names(row: Row, questions: Iterable[Task]) -> list[str]:
    """Questions as a stranger knows them, sorted: to a folder by the file that would answer, whose neutral name says
    neither object nor material, nor does its place in the list."""
    if row.predictions is None:
        return sorted(task.identity for task in questions)
    return sorted(f"{task.table}/{task.protocol}: {task.folder}/{task.answer}" for task in questions)


def write_missing(folder: Path, missing: Mapping[str, tuple[list[str], int]]) -> None:
    """Writes the questions without an answer as `missing.txt`, a line each; no file where no row of a stranger runs."""
    if not missing:
        (folder / MISSING).unlink(missing_ok=True)
        return
    lines = [f"{label}: {question}\n" for label, (questions, _) in missing.items() for question in questions]
    replace_file(folder / MISSING, "".join(lines))


def say_missing(
    folder: Path,
    missing: Mapping[str, tuple[list[str], int]],
    say: Callable[[str], None],
    what: str = "answers",
    without_files: Mapping[str, tuple[list[str], int]] = MappingProxyType({}),
) -> None:
    """Says how many questions have an answer, or `what` there is of them, and, where it is told which of them have no
    file, how many of the others have one that says nothing."""
    for label, (questions, asked) in missing.items():
        unscored = len(questions) - len(without_files[label][0]) if label in without_files else 0
        why = f" ({unscored} more have a file, but no map that is scored there)" if unscored else ""
        listed = f"; the others: {folder / MISSING}" if questions else ""
        say(f"{label}: {what} {asked - len(questions)} of {asked} questions{why}{listed}")


def say_rows_without_values(rows: Sequence[Row], records: Sequence[Record], say: Callable[[str], None]) -> None:
    """Says which plug-ins stand in no table, since all that they returned is empty."""
    used = {record.method for record in records}
    for row in rows:
        if row.info.kind == "external" and row.predictions is None and row.info.key not in used:
            say(
                f"{row.info.label}: is in no table, all its answers were None or had no map that is scored; expected a "
                "picture, or from `decompose` an Intrinsics with albedo, normal, roughness, metallic or environment"
            )
