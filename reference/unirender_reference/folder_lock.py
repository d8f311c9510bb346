"""The folder of a data set or of a run: made, and written by one process at a time."""

import contextlib
import errno
import importlib.util
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from unirender.errors import UnirenderError

LOCK = ".lock"
_log = logging.getLogger("unirender.dataset")


@contextlib.contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Makes a folder; if what follows fails, those that were made and are still empty go again.

    Raises:
        UnirenderError: it cannot be made.
    """
    new = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UnirenderError(f"{path}: cannot be made ({error.strerror}); choose another --out") from error
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # not empty, or not even made
            for folder in new:
                folder.rmdir()
        raise


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds the folder's lock; the system lets go of it when the process is killed.

    The file `LOCK` is there meanwhile. Found without a writer, it means nothing. A file system without locks is a
    warning, and so is Windows.

    Raises:
        UnirenderError: another process holds it.
    """
    if importlib.util.find_spec("fcntl") is None:
        _warn(folder, "Windows")
        yield
        return
    path = folder / LOCK
    handle = _acquire(folder, path)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # before it is let go: nobody else's file
        os.close(handle)


def _warn(folder: Path, why: str) -> None:
    _log.warning("%s: no locks here (%s); let no second run write to it", folder, why)


def _acquire(folder: Path, path: Path) -> int:
    """A handle that holds the lock of the folder; an error where another process has it."""
    import fcntl

    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise UnirenderError(f"{path}: cannot be made ({error.strerror}); choose another --out") from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                os.close(handle)
                raise UnirenderError(
                    f"{folder}: another run is writing here; wait for it, or choose another --out"
                ) from error
            _warn(folder, str(error.strerror))
            return handle
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(path)):
                return handle
        os.close(handle)  # the last holder removed it in between
