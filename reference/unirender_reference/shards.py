"""WebDataset tar shards whose bytes depend on their content only, and the manifest that lists them.

A shard is written under a temporary name, fsynced and renamed: a file called `*.tar` is complete. The manifest holds no
times and no machine, and is equal for equal runs however often they were interrupted (`journal` says when it is
written). A shard of mesh files lists those that failed, and a hash of the names and sizes of all whose turn it was;
`failures.jsonl` repeats the failures of all shards.
"""

import hashlib
import io
import json
import tarfile
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from unirender.errors import UnirenderError
from unirender.system.whole_files import file_sha256, whole_file
from unirender.system.writing import writing

MANIFEST = "manifest.json"
FAILURES = "failures.jsonl"
JOURNAL = "shards.jsonl"
FORMAT = 1
TO_DO = "free some space or choose another --out"  # where a file cannot be written
OPTIONAL = ("sources", "failures", "floor", "negative_pixels", "unreadable_lights")


@dataclass(frozen=True)
class Failure:
    """A mesh file without some or all of its groups.

    Attributes:
        file: its path below the folder of meshes.
        reason: why.
        groups: how many.
        machine: the file is not to blame (a dead worker, a time limit): the next run tries its shard again.
    """

    file: str
    reason: str
    groups: int = 1
    machine: bool = False

    def entry(self) -> dict[str, Any]:
        """The failure as JSON."""
        return {name: value for name, value in asdict(self).items() if name != "machine" or value}


@dataclass(frozen=True)
class FloorCount:
    """How many buffers were sampled up to a noise floor, how many reached it, and the lowest that was reached (dB)."""

    buffers: int
    reached: int
    minimum_db: float


@dataclass(frozen=True)
class RenderedGroup:
    """A group ready to be stored: its key, its members by name, what it cost."""

    key: str
    members: dict[str, bytes]
    samples: int
    nan_pixels: int
    render_seconds: float
    seconds: float
    floor: FloorCount | None = None
    negative_pixels: int = 0
    unreadable_lights: tuple[str, ...] = ()


@dataclass(frozen=True)
class ShardRecord:
    """A finished shard as the manifest lists it; what it has nothing of (`OPTIONAL`) is left out there.

    `negative_pixels` counts pixels of interpolated pictures with a channel below 0, `unreadable_lights` has a line for
    each of the user's light files that draws of this shard passed over: its path below their folder, and why.
    """

    name: str
    sha256: str
    bytes: int
    groups: int
    samples: int
    nan_pixels: int
    sources: str = ""
    failures: tuple[Failure, ...] = ()
    floor: FloorCount | None = None
    negative_pixels: int = 0
    unreadable_lights: tuple[str, ...] = ()

    @property
    def planned(self) -> int:
        """Groups whose turn it was."""
        return self.groups + sum(failure.groups for failure in self.failures)

    def entry(self) -> dict[str, Any]:
        """The record as JSON."""
        values = {**asdict(self), "failures": [failure.entry() for failure in self.failures]}
        return {name: value for name, value in values.items() if value or name not in OPTIONAL}

    @property
    def is_final(self) -> bool:
        """Whether trying again would change nothing."""
        return not any(failure.machine for failure in self.failures)


def parse_record(entry: Mapping[str, Any]) -> ShardRecord:
    """The inverse of `ShardRecord.entry`."""
    later: dict[str, Any] = {
        "failures": tuple(Failure(**failure) for failure in entry.get("failures", ())),
        "unreadable_lights": tuple(entry.get("unreadable_lights", ())),
    }
    if "floor" in entry:
        later["floor"] = FloorCount(**entry["floor"])
    return ShardRecord(**{**entry, **later})


def total_floor(counts: Iterable[FloorCount | None]) -> FloorCount | None:
    """The counts of several groups or shards together; None where there are none."""
    known = [count for count in counts if count is not None]
    if not known:
        return None
    return FloorCount(
        sum(count.buffers for count in known),
        sum(count.reached for count in known),
        min(count.minimum_db for count in known),
    )


def shard_name(index: int) -> str:
    return f"shard-{index:06d}.tar"


def write_shard(path: Path, groups: Iterable[tuple[str, Mapping[str, bytes]]]) -> str:
    """Writes groups (key, members by name) as a tar; returns its sha256.

    Raises:
        UnirenderError: a key has a dot (WebDataset cuts there: groups would merge) or occurs twice, or the disk fails.
    """
    try:
        with whole_file(path) as stream:
            _write_tar(stream, path, groups)
    except OSError as error:  # not `writing`: the groups are rendered in between
        raise UnirenderError(f"{path}: cannot be written ({error.strerror}); {TO_DO}") from error
    return file_sha256(path)


def _write_tar(stream: IO[bytes], path: Path, groups: Iterable[tuple[str, Mapping[str, bytes]]]) -> None:
    """The groups as a tar whose bytes depend on nothing else; `path` is for errors."""
    seen: set[str] = set()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for key, members in groups:
            if "." in key or key in seen:
                raise UnirenderError(f"{path}: group key {key!r}, expected a new key without dots")
            seen.add(key)
            for name, data in members.items():
                info = tarfile.TarInfo(f"{key}.{name}")
                info.size, info.mode, info.mtime = len(data), 0o644, 0
                tar.addfile(info, io.BytesIO(data))


def write_manifest(folder: Path, header: Mapping[str, Any], shards: Iterable[ShardRecord], *, complete: bool) -> str:
    """Replaces the manifest, and the list of failures; returns the manifest's sha256.

    Args:
        folder: of the data set.
        header: `config` (what decides the bytes), `versions` (with what they are made), and `unreadable` folders of
            meshes, if any (`file`, `reason`).
        shards: those that are finished.
        complete: whether they are all there will be.
    """
    records = sorted(shards, key=lambda record: record.name)
    content = {
        "format": FORMAT,
        "complete": complete,
        **header,
        "groups": sum(record.groups for record in records),
        "samples": sum(record.samples for record in records),
        "nan_pixels": sum(record.nan_pixels for record in records),
        "shards": [record.entry() for record in records],
    }
    data = (json.dumps(content, indent=1, sort_keys=True) + "\n").encode()
    _replace(folder / MANIFEST, data)
    failures = [failure.entry() for failure in all_failures(records)]
    for failure in failures:
        del failure["groups"]
    failures = [*header.get("unreadable", ()), *failures]
    if failures:
        _replace(folder / FAILURES, "".join(json.dumps(failure) + "\n" for failure in failures).encode())
    else:
        (folder / FAILURES).unlink(missing_ok=True)
    return hashlib.sha256(data).hexdigest()


def all_failures(records: Iterable[ShardRecord]) -> list[Failure]:
    """The failures of all shards in the order of the files, each reason of a file once."""
    found: Counter[tuple[str, str, bool]] = Counter()
    for record in sorted(records, key=lambda record: record.name):
        for failure in record.failures:
            found[failure.file, failure.reason, failure.machine] += failure.groups
    return [Failure(file, reason, groups, machine) for (file, reason, machine), groups in found.items()]


def _replace(path: Path, data: bytes) -> None:
    with writing(path, TO_DO), whole_file(path) as stream:
        stream.write(data)
