"""Which meshes a pattern means: a folder, a glob or one file, streamed in a fixed order.

Nothing is opened: a folder of 200,000 files costs one `os.scandir` and the names of the folders under way.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from unirender.arguments import as_path
from unirender.errors import UnirenderError

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
OTHERS = {  # models that others read: what to do
    **dict.fromkeys(
        (".3ds", ".abc", ".ac", ".blend", ".dae", ".fbx", ".lwo", ".usd", ".usda", ".usdc", ".usdz", ".x3d"),
        "export it as GLB, from Blender or with assimp",
    ),
    ".3mf": "export it as STL or OBJ",
    ".vrm": "it is a GLB by another name; name it .glb",
    ".zip": "unpack it",
}
_WILD = re.compile(r"[*?[]")


def find_meshes(pattern: str | Path, unreadable: Callable[[Path, str], None] | None = None) -> Iterator[Path]:
    """Streams the mesh files that a pattern means, each once, in an order that depends on the names alone.

    Args:
        pattern: a folder, which is searched with all its folders; one file; or a glob, in which `**` stands for any
            number of folders. Names sort within each folder, a folder's files before its folders. Hidden files are
            left out, hidden folders and links to folders are not entered.
        unreadable: called with each inner folder that cannot be listed, and the reason; the search goes on. None: they
            are an error, but after everything else has been found.

    Yields:
        Paths whose suffix is one of `SUFFIXES`.

    Raises:
        UnirenderError: the path does not exist, or cannot be listed, or nothing in it is a mesh; at the first step of
            the iteration. At its end: inner folders cannot be listed and `unreadable` is None.
    """
    text = os.path.expanduser(str(as_path(pattern, "meshes")))
    missed: list[tuple[Path, str]] = []
    report = unreadable or (lambda folder, reason: missed.append((folder, reason)))
    if os.path.isdir(text):
        found = _walk(Path(text), lambda parts: True, lambda parts: True, report)
    elif os.path.exists(text):
        found = iter([Path(text)] if Path(text).suffix.lower() in SUFFIXES else [])
    elif _WILD.search(text):
        found = _glob(Path(text), report)
    else:
        raise UnirenderError(f"meshes {pattern}: no such file or folder; expected a folder, a mesh or a glob")
    empty = True
    for path in found:
        empty = False
        yield path
    if missed:
        folder, cause = missed[0]
        others = f", nor can {len(missed) - 1} other folders" if len(missed) > 1 else ""
        raise UnirenderError(f"meshes {folder}: cannot be listed ({cause}){others}; check the permissions")
    if empty:
        other = _other(Path(text))
        there = "" if other is None else f"; {other.name} is there: {OTHERS[other.suffix.lower()]}"
        if link := _link(Path(text)):
            there += f"; {link.name} is a link to a folder, which is not entered: name the folder itself"
        raise UnirenderError(f"meshes {pattern}: no mesh found; expected files ending in {', '.join(SUFFIXES)}{there}")


def _other(path: Path) -> Path | None:
    """A model of another kind at or below a path, or in a pattern's folder; None where there is none."""
    files: Iterable[Path] = [path]
    if path.is_dir():
        files = (Path(at, name) for at, _, names in os.walk(path) for name in sorted(names))
    elif not path.is_file():  # a pattern: not below its folder, which may be a whole home directory
        _, _, names = next(os.walk(path.parent), ("", [], []))
        files = [path.parent / name for name in sorted(names)]
    return next((file for file in files if file.suffix.lower() in OTHERS), None)


def _link(path: Path) -> Path | None:
    """A link to a folder in a folder; None where there is none."""
    inner = sorted(path.iterdir()) if path.is_dir() else []
    return next((entry for entry in inner if entry.is_symlink() and entry.is_dir()), None)


def _glob(pattern: Path, report: Callable[[Path, str], None]) -> Iterator[Path]:
    """The files below the pattern's plain folder whose path from there matches the rest of the pattern."""
    parts = pattern.parts
    plain = next(i for i, part in enumerate(parts) if _WILD.search(part))
    root, rest = Path(*parts[:plain]), parts[plain:]
    if not root.is_dir():
        raise UnirenderError(f"meshes {pattern}: no folder {root}; expected one before the first wildcard")
    fixed = rest.index("**") if "**" in rest else len(rest)  # so many levels are matched one by one

    def enters(folders: tuple[str, ...]) -> bool:
        if fixed == len(rest) and len(folders) >= len(rest):
            return False
        return all(fnmatchcase(name, part) for name, part in zip(folders, rest[:fixed], strict=False))

    return _walk(root, lambda path: _matches(path, rest), enters, report)


def _matches(path: tuple[str, ...], parts: tuple[str, ...]) -> bool:
    """Whether the names of a path fit the parts of a pattern; `**` fits any number of names, also none."""
    if not parts:
        return not path
    if parts[0] == "**":
        return parts == ("**",) or any(_matches(path[i:], parts[1:]) for i in range(len(path)))
    return bool(path) and fnmatchcase(path[0], parts[0]) and _matches(path[1:], parts[1:])


def _is_mesh(name: str) -> bool:
    return name.lower().endswith(SUFFIXES) and not name.startswith(".")


def _walk(
    root: Path,
    wanted: Callable[[tuple[str, ...]], bool],
    enters: Callable[[tuple[str, ...]], bool],
    report: Callable[[Path, str], None],
) -> Iterator[Path]:
    """Files below a folder that are `wanted`, in name order; a folder that cannot be listed is reported."""

    def failed(error: OSError) -> None:
        folder, reason = Path(str(error.filename)), error.strerror or str(error)
        if folder == root:
            raise UnirenderError(f"meshes {folder}: cannot be listed ({reason}); check its permissions") from error
        report(folder, reason)

    for at, folders, names in os.walk(root, onerror=failed):
        below = Path(at).relative_to(root).parts
        folders[:] = sorted(name for name in folders if not name.startswith(".") and enters((*below, name)))
        yield from (root.joinpath(*below, name) for name in sorted(names) if _is_mesh(name) and wanted((*below, name)))
