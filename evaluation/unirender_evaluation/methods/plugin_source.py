"""The files that a stranger's method is made of, by which its records are told from those of an edited one.

They are the module that was named, and those that define the method's class and the classes below it; and what these
import, by the import statements anywhere in them, from their own folder and below, or from a package that is no
installed copy: one that is installed for editing (`pip install -e`), or that the method has put on the path. The
statements are read, not run: what counts depends neither on what else has been imported nor on what a method imports
later. Of a file among the installed packages its own package counts, no other, and of Python's own library nothing.
What is found in other ways belongs into a method's `config`.
"""

import ast
import hashlib
import importlib.util
import inspect
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError

INSTALLED = ("site-packages", "dist-packages")
STANDARD_LIBRARY = Path(sysconfig.get_path("stdlib")).resolve()
OURS = ("unirender", "unirender_evaluation", "unirender_reference")  # which have versions of their own


def source_sha256(kind: type, *makers: Any) -> str:
    """The sha256 of the contents of a method's files.

    Args:
        kind: the method's class.
        *makers: what was called to make it, and the module that has it.

    Raises:
        UnirenderError: it has none, as what is defined in a session: an edited one could not be told from it.
    """
    files, _ = _files_and_roots(kind, makers)
    if not files:
        raise UnirenderError(
            f"{kind.__qualname__} is defined in no file, expected one, since an edited method is told by its file; in "
            "a notebook write the class with %%writefile my_method.py"
        )
    contents = sorted(hashlib.sha256(file.read_bytes()).digest() for file in files)
    return hashlib.sha256(b"".join(contents)).hexdigest()


def raised_in(error: BaseException) -> str:
    """Where a method's own code raised an error, or called what did, as the end of a sentence: ` (my_method.py, line
    12)`; empty where that is in no file of a stranger's, or is installed."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename)
        if file.is_file() and not (_is_installed(file) or _is_pythons(file.resolve()) or _is_ours(file.resolve())):
            return f" ({file.name}, line {frame.lineno})"
    return ""


def shadowed(kind: type, *makers: Any) -> Iterator[tuple[Path, Path]]:
    """Files beside a method's that its import statements name, each with the file that Python imports in its place.

    That is another method's, or lies earlier on the path. A name of Python's own library means Python's.
    """
    files, roots = _files_and_roots(kind, makers)
    for file in sorted(file for file in files if not _is_installed(file)):
        root, package = _root(file)
        for name in sorted({name.partition(".")[0] for name in _names(file, package)} - sys.stdlib_module_names):
            beside = [found for folder in (root, *roots) for found in _files_of(folder, [name])]
            place = [] if name in OURS or not beside else _places(name)
            folders = {found.parent for found in beside}  # a compiled module stands beside its source
            if place and place[0].is_file() and place[0].parent not in folders:
                yield beside[0], place[0]


def _files_and_roots(kind: type, makers: tuple[Any, ...]) -> tuple[set[Path], set[Path]]:
    """A method's files, and the folders in which those lie that are not installed."""
    own = {file for file in map(_file, (kind, *makers)) if file is not None}
    files = own | {file for file in map(_file, kind.__mro__) if file is not None and not _is_pythons(file)}
    roots = {_root(file)[0] for file in own if not _is_installed(file)}
    waiting = [file for file in files if file in own or not _is_installed(file)]
    while waiting:
        new = set(_imported(waiting.pop(), roots)) - files
        files |= new
        waiting += new
    return files, roots


def _file(defined: Any) -> Path | None:
    with suppress(OSError, TypeError):
        file = Path(inspect.getfile(defined)).resolve()
        return file if file.is_file() else None
    return None


def _is_installed(file: Path) -> bool:
    return any(part in INSTALLED for part in file.parts)


def _is_ours(file: Path) -> bool:
    return any(file.is_relative_to(place.parent) for name in OURS for place in _places(name))


def _is_pythons(file: Path) -> bool:
    return file.is_relative_to(STANDARD_LIBRARY) and not _is_installed(file)


def _imported(file: Path, roots: set[Path]) -> Iterator[Path]:
    """The files that the import statements of one name, below its own package's folder or one of the `roots`."""
    root, package = _root(file)
    for name in _names(file, package):
        parts = name.split(".")
        if parts[0] in OURS or (_is_installed(file) and parts[:1] != package[:1]):
            continue
        for folder in {root} if _is_installed(file) else {root, *roots, *_edited(parts[0])}:
            yield from _files_of(folder, parts)


def _edited(name: str) -> tuple[Path, ...]:
    """The folder where a package or module lies that somebody may edit; none where it is installed, Python's or
    nowhere."""
    found = [place.parent if place.name == "__init__.py" else place for place in _places(name)]
    return tuple(place.parent for place in found if not _is_installed(place) and not _is_pythons(place))


def _places(name: str) -> list[Path]:
    """The file of a module or package, or the folders of a package without one, as Python finds them; none where it
    finds nothing."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return []
    origins = [] if spec is None else [spec.origin or "", *(spec.submodule_search_locations or ())]
    places = [Path(origin).resolve() for origin in origins if origin and Path(origin).exists()]
    return places[:1] if places and places[0].is_file() else places


def _names(file: Path, package: list[str]) -> Iterator[str]:
    """Absolute names of all that a file may import: `from a import b` may name a module or what it has."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # compiled, or for another Python
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            base = [*above, *filter(None, [node.module])]
            yield from (".".join([*base, alias.name]) for alias in node.names)


def _root(file: Path) -> tuple[Path, list[str]]:
    """The folder where the file's package lies, and the package's name."""
    root, package = file.parent, []
    while (root / "__init__.py").is_file():
        root, package = root.parent, [root.name, *package]
    return root, package


def _files_of(root: Path, parts: list[str]) -> Iterator[Path]:
    """Those of a module below a folder and of the packages around it, as far as they are there."""
    for depth in range(1, len(parts) + 1):
        place = root.joinpath(*parts[:depth])
        for file in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
            if file.is_file():
                yield file.resolve()
