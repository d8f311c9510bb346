"""The records of a run by their content keys: what is done is never done again.

A key is the sha256 of (scene truth, task, method configuration, versions of the parts that the row uses): a second run,
or one more method, computes only what has no record. Records are appended as they are made, so that a killed run
resumes.
"""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError
from unirender_evaluation.records import Record, append_record, write_records
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.versions import SEPARATOR

KEY_PREFIX = 12
KEPT = 4  # records of one measurement by other code, that one may return to


def content_key(suite: Suite, scene: Scene, what: str, config: Mapping[str, Any], code: str) -> str:
    """What a record depends on: the scene's truth, the question, the method's configuration, the code (`Versions.of`).

    The first `KEY_PREFIX` digits are the core's alone, so that records of another core can be told.
    """
    text = json.dumps([suite.scene_hash(scene), what, config, code], sort_keys=True, default=str)
    core = hashlib.sha256(code.partition(SEPARATOR)[0].encode()).hexdigest()
    return core[:KEY_PREFIX] + hashlib.sha256(text.encode()).hexdigest()[KEY_PREFIX:]


@dataclass
class Store:
    """The run folder's records: what is there by content key, appended as it is made, rewritten in order at the end.

    `records.jsonl` holds what the last run measured; what it did not ask for waits in `unused.jsonl` beside it: it was
    a part of a larger run, or of other code, to which one may return. Of other code the last `KEPT` records of each
    measurement wait.
    """

    path: Path
    known: dict[str, Record] = field(default_factory=dict)
    used: dict[str, Record] = field(default_factory=dict)

    @property
    def unused_path(self) -> Path:
        """Where the records that the last run did not ask for are."""
        return self.path.with_name("unused.jsonl")

    @classmethod
    def open(cls, path: Path, mend: bool = True) -> "Store":
        """Reads what earlier runs left, in both files.

        Args:
            path: of `records.jsonl`.
            mend: cuts off half a line that a killed run left; without, nothing is written.

        Raises:
            UnirenderError: a line is no record, or a file cannot be read.
        """
        store = cls(path)
        for file in (store.unused_path, path):
            store.known |= {record.key: record for record in _kept(file, mend)}
        return store

    def has(self, key: str) -> bool:
        """Whether a record is there; marks it as part of this run."""
        if key in self.known:
            self.used[key] = self.known[key]
        return key in self.used

    def add(self, record: Record) -> None:
        """Stores a record, unless it is there (its picture was made again)."""
        if record.key not in self.used:
            append_record(self.path, record)
        self.used[record.key] = record

    def lay_by(self, record: Record) -> None:
        """Stores a record for later runs that this one did not ask for, unless it is there."""
        if record.key not in self.known:
            append_record(self.unused_path, record)
        self.known[record.key] = record

    def of_other_code(self) -> int:
        """How many records are there that other code of the core has made than this run's."""
        code = self._code()
        return sum(key[:KEY_PREFIX] not in code for key in self.known)

    def close(self) -> list[Record]:
        """Sorts this run's records, writes and returns them, and lays the others by."""
        records = sorted(self.used.values(), key=lambda r: (r.table, r.protocol, r.method, r.sample))
        if waiting := self._waiting():
            write_records(self.unused_path, waiting)
        write_records(self.path, records)
        if not waiting:
            self.unused_path.unlink(missing_ok=True)
        return records

    def _code(self) -> set[str]:
        """What the keys of this run's records begin with."""
        return {key[:KEY_PREFIX] for key in self.used}

    def _waiting(self) -> list[Record]:
        """The records that this run did not ask for and that are kept."""
        code, found, kept = self._code(), Counter[tuple[str, ...]](), []
        for key, record in reversed(self.known.items()):  # the latest first
            if key in self.used:
                continue
            if key[:KEY_PREFIX] not in code:
                found[record.identity] += 1
                if found[record.identity] > KEPT:
                    continue
            kept.append(record)
        return kept[::-1]


def _kept(file: Path, mend: bool) -> Iterator[Record]:
    """The records of a file, if it is there, but for half a line at its end."""
    try:
        data = file.read_bytes() if file.exists() else b""
    except OSError as error:
        raise UnirenderError(f"{file}: cannot be read ({error.strerror}), expected a file of records") from error
    complete = data[: data.rfind(b"\n") + 1]
    for number, line in enumerate(complete.splitlines(), start=1):
        try:
            yield Record.from_json(line.decode())
        except ValueError as error:
            raise UnirenderError(
                f"{file}, line {number}: {error}; restore the file, or delete that line to measure its value again"
            ) from error
    if mend and complete != data:
        os.truncate(file, len(complete))  # and not written anew: a run that is killed meanwhile would lose all


@dataclass(frozen=True)
class Job:
    """One record that a run wants."""

    key: str  # its content key
    label: str  # for the progress bar
    make: Callable[[], Record]  # computes it
    kept: bool = True  # whether the picture that belongs to it is there (or none is wanted)
    possible: bool = True  # whether what it needs is here; else a record that is stored counts, and none is made

    def is_done(self, has: Callable[[str], bool]) -> bool:
        """Whether nothing is to do; `has` says whether a record is there."""
        there = has(self.key)
        return (there and self.kept) or not self.possible
