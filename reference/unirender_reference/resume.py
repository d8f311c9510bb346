"""What of a data set is there already, and whether the same run may go on with it."""

import contextlib
import json
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError
from unirender.system.whole_files import file_sha256
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.mesh_folder import files_hash
from unirender_reference.plan import GroupPlan
from unirender_reference.shards import JOURNAL, MANIFEST, ShardRecord, parse_record, shard_name
from unirender_reference.versions import check_versions

HASHED = 4  # shards whose bytes are read again when a run goes on; of the others the size has to do


def finished_shards(
    folder: Path, header: Mapping[str, Any], sizes: Mapping[str, int], *, verify: bool = False
) -> tuple[dict[str, ShardRecord], bool]:
    """The shards of an earlier run that need not be made again; stale temporary files vanish.

    Those are listed in the manifest or the journal and whole, and all that failed in them is final.

    Args:
        folder: of the data set.
        header: as for `write_manifest`.
        sizes: how many groups each shard has to have. A data set can grow: its last, shorter shard is made again.
        verify: read all bytes again; else those of the last `HASHED` shards, and of the others the size is compared.

    Returns:
        The records by name, and whether the manifest lists any others.

    Raises:
        UnirenderError: the folder holds another data set, or one made with other versions.
    """
    for stale in folder.glob(".*.part"):
        stale.unlink(missing_ok=True)
    if not (folder / MANIFEST).exists():
        _check_unlisted(folder)
        return {}, False
    listed = _listed(folder, header)
    records = listed | _journal(folder / JOURNAL)
    _check_surplus(folder, records, sizes, of_files=bool(header["config"].get("meshes")))
    hashed = set(records if verify else sorted(records)[-HASHED:])
    finished = {
        record.name: record
        for record in records.values()
        if record.planned == sizes[record.name]
        and record.is_final
        and _is_whole(folder / record.name, record, hashed=record.name in hashed)
    }
    return finished, any(finished.get(name) != record for name, record in listed.items())


def _check_unlisted(folder: Path) -> None:
    """Refuses shards without a manifest, but for the first one of a run that was killed before it wrote any."""
    there = sorted(tar.name for tar in folder.glob("*.tar"))
    if there and not (there == [shard_name(0)] and _is_rendered(folder / there[0])):
        raise UnirenderError(
            f"{folder}: has {there[0]} and no {MANIFEST}, so that it may be anybody's and is not overwritten; "
            "choose another --out, or move the .tar files away"
        )


def _listed(folder: Path, header: Mapping[str, Any]) -> dict[str, ShardRecord]:
    """The records of the manifest; refuses one of another data set, or made with other versions."""
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text())
        listed = {record.name: record for record in map(parse_record, content["shards"])}
        found, made_with = content["config"], content.get("versions") or {}
    except (ValueError, KeyError, TypeError) as error:
        raise UnirenderError(f"{path}: not a manifest of unirender ({error}); choose another --out") from error
    check_versions(folder, made_with, header["versions"])
    wanted = json.loads(json.dumps(header["config"]))
    if found != wanted:
        keys = sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key))
        differs = ", ".join(f"{key} {found.get(key)!s:.16} instead of {wanted.get(key)!s:.16}" for key in keys)
        raise UnirenderError(f"{folder}: holds a data set with {differs}; choose another --out or delete it")
    return listed


def _check_surplus(
    folder: Path, records: Mapping[str, ShardRecord], sizes: Mapping[str, int], *, of_files: bool
) -> None:
    """Refuses shards that hold more groups than are asked for; `of_files`: the objects are files of the user's."""
    surplus = sorted(record.name for record in records.values() if record.planned > sizes.get(record.name, 0))
    if surplus and of_files:
        raise UnirenderError(
            f"{folder}: {surplus[0]} was made of more mesh files than --meshes has now, expected at least as many: was "
            "one removed, or --objects lowered? Put it back, or choose another --out"
        )
    if surplus:
        raise UnirenderError(
            f"{folder}: already holds more objects ({surplus[0]}), expected at most as many as asked for; "
            "raise --objects or choose another --out"
        )


def _is_rendered(path: Path) -> bool:
    """Whether a shard's first group is of `unirender dataset`, which may have been killed before its first manifest."""
    with contextlib.suppress(tarfile.TarError, OSError, ValueError), tarfile.open(path) as tar:
        for member in tar:
            if member.name.endswith(".json") and (stream := tar.extractfile(member)) is not None:
                about = json.loads(stream.read())
                return isinstance(about, dict) and "object_provenance" in about
    return False


def _journal(path: Path) -> dict[str, ShardRecord]:
    """The records of a journal; a line that a kill cut short counts for nothing."""
    records: dict[str, ShardRecord] = {}
    if path.exists():
        for line in path.read_text().splitlines():
            with contextlib.suppress(ValueError, TypeError):
                record = parse_record(json.loads(line))
                records[record.name] = record
    return records


def _is_whole(path: Path, record: ShardRecord, *, hashed: bool) -> bool:
    if not path.is_file() or path.stat().st_size != record.bytes:
        return False
    return not hashed or file_sha256(path) == record.sha256


def sources_hash(plans: list[GroupPlan]) -> str:
    """The hash of a shard's files; empty without files."""
    files = dict.fromkeys(plan.mesh for plan in plans if plan.mesh is not None)
    return files_hash(files) if files else ""


def check_sources(config: DatasetConfig, record: ShardRecord, plans: list[GroupPlan]) -> None:
    """Compares a finished shard with the files that are there now.

    Raises:
        UnirenderError: it was made from others.
    """
    if record.sources != sources_hash(plans):
        raise UnirenderError(
            f"{config.out}: {record.name} was made from other files than {config.meshes} holds now (names or sizes "
            f"differ), expected the same; delete {record.name} to render it again, or choose another --out"
        )
