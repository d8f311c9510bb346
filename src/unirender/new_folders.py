"""Folders of results that are there whole or not at all, whatever stops the process that writes them.

A folder with `meta.json` is one result, one with `summary.json` those of a folder of pictures: by these files it is
known what may be replaced.
"""

import contextlib
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from unirender.arguments import as_path
from unirender.errors import UnirenderError, UsageError
from unirender.system.paths import forget_half_made
from unirender.system.whole_files import move_into_place, naming

META_FILE, SUMMARY_FILE = "meta.json", "summary.json"
FILE_SUFFIXES = (".exr", ".glb", ".gltf", ".json", ".png", ".xml")


@contextlib.contextmanager
def new_folder(path: str | Path, *, overwrite: bool | None = None, tidy: bool = True) -> Iterator[Path]:
    """A temporary folder that becomes `path` when the block ends without an error, and vanishes otherwise.

    It lies beside `path`, hidden; one that a killed process left there goes after a day (`forget_half_made`).

    Only a result folder (one with `meta.json`) is ever replaced, and none that others were written into.

    Args:
        path: where it is to be.
        overwrite: whether a result that is there is replaced; None: it is not, and nobody can ask for it.
        tidy: whether to look for what killed processes left.

    Raises:
        UsageError: `path` is the working directory or lies around it.
        UnirenderError: `path` exists and is not empty, and `overwrite` is not given or it is no result folder; or it
            cannot be made or replaced.
    """
    shown, path = path, as_path(path, "folder").resolve()
    if path == Path.cwd() or path in Path.cwd().parents:
        raise UsageError(f"{shown}: is the folder that you are in (or one around it), expected a new one; name another")
    if path.exists() and not path.is_dir():
        raise UnirenderError(f"{shown}: is a file, expected a folder to write to")
    if path.is_dir() and any(path.iterdir()):
        if not overwrite:
            option = "" if overwrite is None else ", or overwrite it (--overwrite)"
            raise UnirenderError(f"{shown}: exists and is not empty; choose another folder{option}")
        if (path / SUMMARY_FILE).is_file():
            raise UnirenderError(
                f"{shown}: has a {SUMMARY_FILE}, so that it holds the results of a folder of pictures, expected one "
                "result to overwrite; choose another folder"
            )
        if not (path / META_FILE).is_file():
            raise UnirenderError(
                f"{shown}: has no {META_FILE}, expected an earlier result to overwrite; choose another folder"
            )
    # Its name comes first: a signal may arrive between the folder and who would take it back.
    temporary = path.parent / f".{path.name}.{secrets.token_hex(6)}"
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if tidy:
                forget_half_made(path.parent, {path.name})
            temporary.mkdir()
        except OSError as error:
            reason = f"{path.parent} is no folder" if isinstance(error, FileExistsError) else error.strerror
            raise UnirenderError(f"{shown}: cannot be written ({reason}); choose another folder") from error
        with naming(Path(shown)):
            yield temporary
        try:
            move_into_place(temporary, path)
        except OSError as error:
            raise UnirenderError(f"{shown}: cannot be replaced ({error.strerror}); choose another folder") from error
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


@contextlib.contextmanager
def folder_beside(path: str | Path, output: str | Path, temporary: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A second folder of a result: a part of `output`, or a new one of its own that appears with it.

    Args:
        path: where it is to be.
        output: the result's folder.
        temporary: what `new_folder(output)` gave.
        overwrite: as in `new_folder`.

    Raises:
        UsageError: it is named like a file, or is the output folder or lies around it.
        UnirenderError: as `new_folder`.
    """
    inner, outer = Path(path).resolve(), Path(output).resolve()
    if inner.suffix in FILE_SUFFIXES:
        raise UsageError(f"{path}: named like a file, expected a folder to write to")
    if inner == outer or inner in outer.parents:
        raise UsageError(f"{path}: is the output folder {output} (or one around it), expected one inside or beside it")
    if outer not in inner.parents:
        with new_folder(path, overwrite=overwrite) as folder:
            yield folder
        return
    folder = temporary / inner.relative_to(outer)
    folder.mkdir(parents=True)
    yield folder
