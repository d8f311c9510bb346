"""The mesh files of a data set: which belong to a split, and the key of each.

Only names are held, as text; a file is looked at when its turn comes.
"""

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from unirender.errors import UnirenderError

KEY_STEM = 40  # characters of a file's name in its key: tar member names end at 100
MAGIC = re.compile(r"[*?\[]")


@dataclass(frozen=True)
class MeshFile:
    """A file of a folder.

    Attributes:
        path: where it is.
        name: its path below the folder, with forward slashes.
    """

    path: Path
    name: str

    @property
    def key(self) -> str:
        """Unique within the folder and without dots: the stem and a hash of `name` (48 bits: of 200,000 files, two
        agree with a probability below 1e-4; 32 bits would make that likely)."""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", Path(self.name).stem)[:KEY_STEM].strip("-") or "mesh"
        return f"{stem}-{hashlib.sha256(self.name.encode(errors='surrogateescape')).hexdigest()[:12]}"

    @property
    def folder(self) -> Path:
        """What `name` counts from."""
        return Path(str(self.path).removesuffix(self.name.replace("/", os.sep)))

    def without_folder(self, text: str) -> str:
        """A message with the paths below the folder in place of whole ones: it is published with the data set."""
        folder = str(self.path).removesuffix(self.name.replace("/", os.sep))
        for place in {folder, os.path.join(os.path.realpath(folder), "")} - {os.sep}:
            text = text.replace(" ".join(place.split()), "").replace(place, "")
        return text


def files_hash(files: Iterable[MeshFile]) -> str:
    """sha256 over the files' names and sizes (-1: gone): whether a folder still holds what was rendered."""
    digest = hashlib.sha256()
    for file in files:
        try:
            size = file.path.stat().st_size
        except OSError:
            size = -1
        digest.update(f"{file.name}\0{size}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


@dataclass(frozen=True)
class MeshFolder:
    """The files of a split, in a fixed order.

    Attributes:
        base: absolute path of the folder.
        names: paths of the files below it.
        unreadable: folders below it that cannot be listed, each with the reason.
    """

    base: Path
    names: Sequence[str]
    unreadable: Sequence[tuple[str, str]] = ()

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> MeshFile:
        return MeshFile(self.base / self.names[index], self.names[index])


def in_split(index: int, split: Literal["train", "test"], holdout: int) -> bool:
    """Whether file number `index`, in the order of `find_meshes`, belongs to a split: "test" gets every `holdout`-th,
    "train" all others; 0: each gets all. The one rule of training sets and of suites, so that they never share a file.
    """
    return not holdout or (index % holdout == holdout - 1) == (split == "test")


def mesh_folder(
    pattern: str | Path, split: Literal["train", "test"] = "train", holdout: int = 0, limit: int | None = None
) -> MeshFolder:
    """The mesh files of a folder or glob that belong to a split.

    Args:
        pattern: a folder, searched recursively, or a glob.
        split: whose files; see `in_split`.
        holdout: likewise.
        limit: take no more files than this.

    Raises:
        UnirenderError: there are no such files.
    """
    from unirender_reference.meshes import find_meshes

    base = pattern_base(pattern)
    prefix = len(os.path.join(base, ""))

    def below(path: Path) -> str:
        return os.path.abspath(path)[prefix:].replace(os.sep, "/")

    names: list[str] = []
    unreadable: list[tuple[str, str]] = []
    found = find_meshes(pattern, lambda folder, reason: unreadable.append((below(folder), reason)))
    for index, path in enumerate(found):
        if in_split(index, split, holdout):
            names.append(below(path))
            if len(names) == limit:
                break
    if not names:
        held = f" for --split {split} with --holdout {holdout}" if holdout else ""
        raise UnirenderError(
            f"{pattern}: no mesh files{held}, expected .glb, .gltf, .obj or .ply files; give another folder or pattern"
        )
    return MeshFolder(base, names, unreadable)


def pattern_base(pattern: str | Path) -> Path:
    """The folder that names count from: the folder itself, or what stands before the first wildcard; absolute."""
    path = Path(pattern).expanduser()
    if not path.is_dir():
        fixed = next((i for i, part in enumerate(path.parts) if MAGIC.search(part)), len(path.parts) - 1)
        path = Path(*path.parts[:fixed])
    return Path(os.path.abspath(path))
