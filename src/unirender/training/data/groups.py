"""From WebDataset shards to packed groups: decode each EXR once, then index memory.

A shard is a tar whose samples are *groups*: an object under a few lights with its materials. Members of group KEY:
`KEY.shared.exr` (albedo, normal, mask), `KEY.l0.environment.exr`, `KEY.l0.diffuse.exr`, `KEY.l0.r030.specular.exr`,
`KEY.l0.m050_r030.exr` (the image; metallic and roughness in percent) and `KEY.json` (with `vary`). Where roughness and
metallic are the object's own maps, `KEY.shared.exr` holds them too, and a light has `KEY.l0.maps.specular.exr` and
`KEY.l0.maps.exr`.

Decoding the fifty EXRs of a group takes longer than a training step, so `open_packed` decodes a shard once into three
memory-mapped files under `${UNIRENDER_CACHE}/packed/<sha256 of the shard>`:

    pixels.npy       float16 [n, 3, h, w]          images, s and d
    shared.npy       float16 [groups, 7, h, w]     albedo, normal, mask; 9 where a group has maps of the others
    environment.npy  float32 [lights, 4, 3, 16, 32]  the light at the model's size under 0 to 3 quarter turns
    index.json       which row is what
"""

import contextlib
import json
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float16

from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr_bytes
from unirender.system.paths import cache_dir, cached_folder
from unirender.system.whole_files import file_sha256
from unirender.training.data.packing import Group, Packer, Pair

PACK_VERSION = 3  # part of the cache's path: raise it when what is packed, or refused, changes
END_OF_ARCHIVE = bytes(1024)  # two blocks, with which a tar ends


@dataclass(frozen=True)
class Shard:
    """A packed shard in its `folder` of the cache: arrays are read-only memory maps, which other processes map, too."""

    folder: Path
    name: str
    sha256: str
    pixels: Float16[np.ndarray, "n 3 h w"]
    shared: Float16[np.ndarray, "g c h w"]
    environment: Float[np.ndarray, "l 4 3 16 32"]
    groups: tuple[Group, ...]

    def __reduce__(self) -> tuple[Callable[..., "Shard"], tuple[Path, str, str]]:
        return _open, (self.folder, self.name, self.sha256)


def list_shards(folder: str | Path) -> dict[Path, str | None]:
    """The complete shards of a data folder in order of name, each with the sha256 the manifest gives, if it lists it.

    The folder has shards itself, or is a training set in parts: its folders have them. Works while shards are still
    being written: a shard gets its `.tar` name when it is complete. A shard in which every mesh file failed, so that
    the manifest gives it no groups, is left out.

    Raises:
        UnirenderError: there is none, or one that the manifest lists is missing or of another size.
    """
    parts = _parts(Path(folder))
    found = {path: sha256 for part in parts for path, sha256 in _own_shards(part).items()}
    if not found:
        kind = "only shards without groups" if any(any(part.glob("*.tar")) for part in parts) else "no .tar shard found"
        raise UnirenderError(f"{folder}: {kind}, expected a folder written by `unirender dataset`")
    return found


def unread_shards(folder: str | Path) -> str | None:
    """In words: which folders below a data folder have shards that `list_shards` passes over; None: there are none."""
    folder = Path(folder)
    holding = {path.parent for path in folder.rglob("*.tar")}
    unread = sorted(part.relative_to(folder).as_posix() for part in holding - set(_parts(folder)))
    if not unread:
        return None
    return (
        f"{folder}: shards in {', '.join(unread[:3])}{' ...' if len(unread) > 3 else ''} are not read: those of the "
        "folder itself are, or, where it has none, those of the folders in it; pass another --data, or move them"
    )


def split_of(folder: str | Path) -> str | None:
    """The side, `train` or `test`, that a data folder was rendered for, as its manifests say; None where none says.

    Raises:
        UnirenderError: parts of both sides: what is learned from them cannot be tested on either.
    """
    sides: dict[str, list[str]] = {}
    for part in _parts(Path(folder)):
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError, RecursionError):  # one's own need none
            side = json.loads((part / "manifest.json").read_text())["config"]["split"]
            sides.setdefault(str(side), []).append(part.name)
    if len(sides) > 1:
        both = " and ".join(f"{', '.join(names)} of --split {side}" for side, names in sorted(sides.items()))
        raise UnirenderError(
            f"{folder}: holds {both}, expected one side: nothing would be left to test on; pass the folder of the "
            "train side, or move the others away"
        )
    return next(iter(sides), None)


def _parts(folder: Path) -> list[Path]:
    """The folder itself, or those in it, that have shards."""
    return [folder] if _is_data(folder) else sorted(part for part in folder.glob("*/") if _is_data(part))


def _is_data(folder: Path) -> bool:
    return (folder / "manifest.json").exists() or any(folder.glob("*.tar"))


def _own_shards(folder: Path) -> dict[Path, str | None]:
    """Those that lie in the folder itself.

    Raises:
        UnirenderError: a broken manifest, or one that lists a shard that is missing or of another size.
    """
    listed: dict[str, str] = {}
    sizes: dict[str, int] = {}
    empty: set[str] = set()
    manifest = folder / "manifest.json"
    if manifest.exists():
        try:
            journal = _journal_entries(folder / "shards.jsonl")  # first: the manifest takes its lines over
            entries = journal + json.loads(manifest.read_text())["shards"]
            listed = {str(entry["name"]): str(entry["sha256"]) for entry in entries}
            sizes = {str(entry["name"]): int(entry["bytes"]) for entry in entries if "bytes" in entry}
            empty = {str(entry["name"]) for entry in entries if entry.get("groups") == 0}
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise UnirenderError(f"{manifest}: not a readable manifest ({error!r}); remake the dataset") from error
    present = {path.name: path for path in sorted(folder.glob("*.tar"))}
    missing = sorted(set(listed) - set(present))
    if missing:
        raise UnirenderError(f"{folder}: shards {', '.join(missing)} of the manifest are missing; remake the dataset")
    for name in sorted(sizes.keys() & present.keys()):
        if (size := present[name].stat().st_size) != sizes[name]:
            raise UnirenderError(
                f"{present[name]}: has {size:,} bytes, expected the {sizes[name]:,} of the manifest; run the same "
                "`unirender dataset` again, which renders it anew"
            )
    return {path: listed.get(name) for name, path in present.items() if name not in empty}


def _journal_entries(path: Path) -> list[dict[str, Any]]:
    """What a run that is writing has to add to its manifest, a line for each shard; one cut short does not count."""
    entries = []
    with contextlib.suppress(FileNotFoundError):
        for line in path.read_text().splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                entries.append(json.loads(line))
    return entries


def read_groups(path: str | Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yields (key, members by name without the key) of a tar shard, in its order.

    Raises:
        UnirenderError: not a readable tar, one that was cut off, or a member occurs twice (two groups would merge).
    """
    path = Path(path)
    key, members, seen = "", {}, set()
    try:
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                if not info.isfile():
                    continue
                name, _, rest = Path(info.name).name.partition(".")
                if name != key:
                    if members:
                        yield key, members
                    if name in seen:
                        raise UnirenderError(
                            f"{path}: group {name} occurs twice, or other members stand between its own, expected each "
                            "key once and its members together"
                        )
                    key, members = name, {}
                    seen.add(name)
                if rest in members:
                    raise UnirenderError(
                        f"{path}: member {info.name} occurs twice, expected each once; remake the shard"
                    )
                stream = tar.extractfile(info)
                members[rest] = stream.read() if stream else b""
            _check_end(path, tar.offset, key)
    except (tarfile.TarError, OSError) as error:
        raise UnirenderError(f"{path}: not a readable tar shard ({error}); copy it again, or remake it") from error
    if members:
        yield key, members


def _check_end(path: Path, offset: int, last: str) -> None:
    """Looks whether the end of a tar stands after its last group: a file that was cut off reads like a shorter one."""
    with path.open("rb") as file:
        file.seek(offset)
        if file.read(len(END_OF_ARCHIVE)) != END_OF_ARCHIVE:
            raise UnirenderError(
                f"{path}: stops after group {last} without the two empty blocks that end a tar: it was cut off or is "
                "damaged; copy it again, or remake it"
            )


def read_environments(path: str | Path) -> Iterator[tuple[str, dict[int, Float[np.ndarray, "eh ew 3"]]]]:
    """Yields (key, lights at their stored resolution by their rows in `Shard.environment`) of a tar shard.

    Raises:
        UnirenderError: as `read_groups`, or a light is no readable EXR.
    """
    row = 0
    for key, members in read_groups(path):
        names = sorted(name for name in members if name.endswith(".environment.exr"))
        read = (read_exr_bytes(members[name], name=f"{path}: group {key}.{name}")[0] for name in names)
        yield key, {number: channels_rgb(channels) for number, channels in enumerate(read, start=row)}
        row += len(names)


def open_packed(path: str | Path, sha256: str | None = None, name: str | None = None) -> Shard:
    """Opens a shard for training, packing it first if that has not been done.

    Args:
        path: the tar.
        sha256: its hash as the manifest gives it: verified when the shard is packed, trusted afterwards.
        name: of the shard in its data folder; the file's if None.

    Raises:
        UnirenderError: the hash is another, or the shard cannot be read or does not keep the contract.
    """
    path = Path(path)
    known = sha256 or file_sha256(path)
    folder = cache_dir() / "packed" / f"{known}-v{PACK_VERSION}"
    if not folder.exists():
        if sha256 is not None:
            check_sha256(path, sha256)
        _pack(path, folder)
    return _open(folder, name or path.name, known)


def check_sha256(path: Path, sha256: str) -> None:
    """Looks whether a shard is what its manifest says.

    Raises:
        UnirenderError: it is another, or cannot be read.
    """
    if (actual := file_sha256(path)) != sha256:
        raise UnirenderError(
            f"{path}: sha256 is {actual}, the manifest says {sha256}; delete the shard and remake the dataset"
        )


def _open(folder: Path, name: str, sha256: str) -> Shard:
    """A packed shard, from its folder of the cache."""
    arrays = {array: mapped(folder / f"{array}.npy") for array in ("pixels", "shared", "environment")}
    try:
        groups = tuple(
            Group(**{**group, "pairs": tuple(Pair(**pair) for pair in group["pairs"])})
            for group in json.loads((folder / "index.json").read_text())
        )
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise damaged(folder, error) from error
    return Shard(folder=folder, name=name, sha256=sha256, groups=groups, **arrays)


def mapped(path: Path) -> np.ndarray:
    """A plain read-only view of an array of the cache, which stays on the disk.

    Raises:
        UnirenderError: it is gone, or cut off.
    """
    try:
        return np.asarray(np.load(path, mmap_mode="r"))
    except Exception as error:  # NumPy raises half a dozen kinds for a broken header, and another for an empty file
        raise damaged(path.parent, error) from error


def store(path: Path, array: np.ndarray) -> None:
    """Writes an array of the cache.

    Raises:
        OSError: it cannot be written, with words on why: of a full disk NumPy has no number that the system has words
            for.
    """
    try:
        np.save(path, array)
    except OSError as error:
        raise OSError(error.errno or 0, error.strerror or str(error)) from error


def damaged(folder: Path, error: Exception) -> UnirenderError:
    """What is said of a folder of the cache that is not what was written."""
    return UnirenderError(
        f"{folder}: this folder of the cache is damaged ({error!s:.200}); delete it, it is then made again"
    )


def _pack(path: Path, folder: Path) -> None:
    """Decodes a shard into `folder`, which appears when it is complete."""
    packer = Packer(str(path))
    groups = [packer.add(key, members) for key, members in read_groups(path)]
    if not groups:
        raise UnirenderError(f"{path}: the shard has no groups; delete it and remake the dataset")
    with cached_folder(folder) as made:
        for name, array in packer.arrays().items():
            store(made / f"{name}.npy", array)
        (made / "index.json").write_text(json.dumps([asdict(group) for group in groups]))
