"""The record of a data set while it is written: a line for each finished shard, and now and then the manifest.

A manifest of many shards takes long to write, so it is replaced at most every `SECONDS`. Until then a shard's record
stands in `shards.jsonl`, one appended and synced line each; the file is gone when the manifest has everything.
"""

import contextlib
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError
from unirender.system.writing import writing
from unirender_reference.shards import JOURNAL, TO_DO, ShardRecord, write_manifest

SECONDS = 30.0


class Journal:
    """Keeps the records of a folder.

    Args:
        folder: of the data set.
        header: what the manifest says besides its records (`shards.write_manifest`).
        records: of finished shards, by name.
        stale: the manifest in the folder lists shards that are to be made again, and is replaced at once.
    """

    def __init__(
        self, folder: Path, header: Mapping[str, Any], records: Mapping[str, ShardRecord], stale: bool
    ) -> None:
        self.records = dict(records)
        self._folder = folder
        self._header = header
        self._written = float("-inf")
        self._pending = False
        if stale:
            self._write(complete=False)
            self._written = float("-inf")

    def add(self, record: ShardRecord) -> None:
        """Records a shard that is complete.

        Raises:
            UnirenderError: it cannot be written.
        """
        self.records[record.name] = record
        self._pending = True
        if time.monotonic() - self._written >= SECONDS:
            self._write(complete=False)
            return
        path = self._folder / JOURNAL
        with writing(path, TO_DO), path.open("a") as stream:
            stream.write(json.dumps(record.entry()) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        """Writes the manifest of a run that ends too soon, if it lacks something."""
        if self._pending:
            with contextlib.suppress(UnirenderError):  # the journal has it, and the disk may be what ended the run
                self._write(complete=False)

    def complete(self) -> str:
        """Writes the manifest of the whole data set; returns its sha256."""
        return self._write(complete=True)

    def _write(self, *, complete: bool) -> str:
        sha256 = write_manifest(self._folder, self._header, self.records.values(), complete=complete)
        (self._folder / JOURNAL).unlink(missing_ok=True)
        self._written, self._pending = time.monotonic(), False
        return sha256
