"""WebDataset tar shards whose bytes depend on their content only, and the manifest that lists them.

A shard is written under a temporary name, fsynced and renamed: a file called `*.tar` is complete. The manifest is
replaced after every shard, so that a reader can start early; it holds no times and no machine, and is equal for equal
runs however often they were interrupted.
"""

import hashlib
import io
import json
import os
import tarfile
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError

MANIFEST = "manifest.json"
FORMAT = 1


@dataclass(frozen=True)
class ShardRecord:
    """A finished shard as the manifest lists it."""

    name: str
    sha256: str
    bytes: int
    groups: int
    samples: int
    nan_pixels: int


def shard_name(index: int) -> str:
    return f"shard-{index:06d}.tar"


def write_shard(path: Path, groups: Iterable[tuple[str, Mapping[str, bytes]]]) -> str:
    """Writes groups (key, members by name) as a tar; returns its sha256.

    Raises:
        UnirenderError: a key has a dot (WebDataset cuts there: groups would merge) or occurs twice, or the disk fails.
    """
    seen: set[str] = set()
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
                    for key, members in groups:
                        if "." in key or key in seen:
                            raise UnirenderError(f"{path}: group key {key!r}, expected a new key without dots")
                        seen.add(key)
                        for name, data in members.items():
                            info = tarfile.TarInfo(f"{key}.{name}")
                            info.size, info.mode, info.mtime = len(data), 0o644, 0
                            tar.addfile(info, io.BytesIO(data))
                stream.flush()
                os.fsync(stream.fileno())
            sha256 = file_sha256(Path(temporary))
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
            _sync_folder(path.parent)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise UnirenderError(
            f"{path}: cannot be written ({error.strerror}); free some space or choose another --out"
        ) from error
    return sha256


def file_sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_manifest(folder: Path, config: Mapping[str, Any], shards: Iterable[ShardRecord], *, complete: bool) -> str:
    """Replaces the manifest; returns its sha256."""
    records = sorted(shards, key=lambda record: record.name)
    content = {
        "format": FORMAT,
        "complete": complete,
        "config": dict(config),
        "groups": sum(record.groups for record in records),
        "samples": sum(record.samples for record in records),
        "nan_pixels": sum(record.nan_pixels for record in records),
        "shards": [asdict(record) for record in records],
    }
    data = (json.dumps(content, indent=1, sort_keys=True) + "\n").encode()
    temporary = folder / f".{MANIFEST}.{os.getpid()}.part"
    with temporary.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, folder / MANIFEST)
    _sync_folder(folder)
    return hashlib.sha256(data).hexdigest()


def finished_shards(folder: Path, config: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, ShardRecord]:
    """The shards of an earlier run of the same configuration that are listed and whole; stale temporary files vanish.

    Args:
        folder: of the data set.
        config: what decides the bytes.
        sizes: how many groups each shard has to have. A data set can grow: its last, shorter shard is made again.

    Raises:
        UnirenderError: the folder holds another data set.
    """
    for stale in folder.glob(".*.part"):
        stale.unlink(missing_ok=True)
    path = folder / MANIFEST
    if not path.exists():
        if any(folder.glob("*.tar")) and not (folder / shard_name(0)).exists():
            raise UnirenderError(f"{folder}: has .tar files of something else, expected an empty folder; use another")
        return {}
    try:
        content = json.loads(path.read_text())
        records = [ShardRecord(**record) for record in content["shards"]]
        found = content["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise UnirenderError(f"{path}: not a manifest of unirender ({error}); choose another --out") from error
    wanted = json.loads(json.dumps(dict(config)))
    if found != wanted:
        differs = ", ".join(sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key)))
        raise UnirenderError(f"{folder}: holds a data set with other {differs}; choose another --out or delete it")
    surplus = sorted(record.name for record in records if record.groups > sizes.get(record.name, 0))
    if surplus:
        raise UnirenderError(
            f"{folder}: already holds more objects ({surplus[0]}), expected at most as many as asked for; "
            "raise --objects or choose another --out"
        )
    return {
        record.name: record
        for record in records
        if record.groups == sizes[record.name]
        and (folder / record.name).is_file()
        and file_sha256(folder / record.name) == record.sha256
    }


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
