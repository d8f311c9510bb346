"""Files and folders that are there whole or not at all, whatever stops the process that writes them."""

import contextlib
import errno
import hashlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Literal

from unirender.errors import UnirenderError


def replace_file(path: Path, content: str | bytes) -> Path:
    """Writes a file, text as UTF-8, and its folder where there is none; returns the path.

    It is written aside, synced and renamed: whoever reads `path`, after a crash or while others write it too, finds the
    old content or the new. A link stays, and the file that it leads to is the one that is written. A device or a pipe,
    such as `/dev/stdout`, is written to as it is.

    Raises:
        OSError: it cannot be written; what was there stays.
    """
    data = content if isinstance(content, bytes) else content.encode()
    if is_special(path):
        with naming(path):
            path.write_bytes(data)
        return path
    place = Path(os.path.realpath(path))  # of a link to itself, too: `resolve` raises what is no OSError
    if place.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    place.parent.mkdir(parents=True, exist_ok=True)
    with _renamed(place, aside(place), "xb") as file:
        file.write(data)
    return path


def is_special(path: Path) -> bool:
    """Whether it is a device or a pipe."""
    return path.exists() and not path.is_file() and not path.is_dir()


def aside(path: Path) -> Path:
    """A hidden name beside a file or folder, which nobody else uses: for what is renamed to `path` when it is complete.

    Made by `open` or `mkdir` it has the rights that the user's umask leaves, and a folder's group where that is passed
    on; what `tempfile` makes is its owner's alone.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")


def whole_file(path: Path) -> contextlib.AbstractContextManager[BinaryIO]:
    """A stream to what will be the file when the block ends; where that fails, what was there stays, and nothing else.

    For a folder that one process writes to: all write aside to one name, so that a killed one leaves no more than that.
    """
    return _renamed(path, path.with_name(f".{path.name}.part"), "wb")


@contextlib.contextmanager
def _renamed(path: Path, temporary: Path, mode: Literal["wb", "xb"]) -> Iterator[BinaryIO]:
    """A stream to `temporary`, which is synced and becomes `path` when the block ends."""
    try:
        with naming(path), temporary.open(mode) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """For a block that writes a file: an error of the system that names none, as a full disk's does, gets its name.

    One without a number is a library's own, such as Pillow's or NumPy's; with a name it would not show its words.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def file_sha256(path: str | Path) -> str:
    """sha256 of a file's bytes, hexadecimal.

    Raises:
        UnirenderError: it cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UnirenderError(f"{path}: cannot be read ({error.strerror}); restore the file") from error


def move_into_place(temporary: Path, path: Path) -> None:
    """Renames a folder to `path`, in place of the folder that may be there; where that fails, all is as before."""
    if not path.is_dir():
        os.rename(temporary, path)
        return
    before = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
    try:
        os.rename(path, before / "old")
    except BaseException:
        before.rmdir()
        raise
    try:
        os.rename(temporary, path)
    except BaseException:
        os.rename(before / "old", path)
        before.rmdir()
        raise
    try:
        shutil.rmtree(before)
    except BaseException:  # a signal: the new folder is in place, and the old one goes all the same
        shutil.rmtree(before, ignore_errors=True)
        raise
