"""What the machine refuses: memory, a full disk, a name that is too long, as one sentence. Light to import."""

import errno
import os
import re

from unirender.errors import UnirenderError

OUT_OF_MEMORY = re.compile(
    r"can(?:'t|not) allocate memory|out of memory|failed to map segment from shared object", re.IGNORECASE
)
SYMLINK_LOOP = (
    "Symlink loop from "  # how a `RuntimeError` of `Path.resolve` begins; from Python 3.13 on it is an OSError
)
TO_DO = {  # where the system refuses, for whatever reason of its own
    errno.EACCES: "allow it, or name another place",
    errno.EDQUOT: "free some space",
    errno.EFBIG: "raise the limit of a file's size (ulimit -f), or name another place",
    errno.EIO: "look after the disk",
    errno.ELOOP: "name a file or folder that is there",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENAMETOOLONG: "shorten the name",
    errno.ENFILE: "end other programs, or raise the machine's limit of open files",
    errno.ENOSPC: "free some space",
    errno.EPERM: "allow it, or name another place",
    errno.EROFS: "make it writable, or name another place",
    errno.ESTALE: "run the command again, since the file has changed meanwhile",
}


def out_of_memory(error: BaseException) -> bool:
    """Whether there was not enough memory: of the machine, or of its GPU; PyTorch has no class of its own for both, and
    a library for which there was no room is an `ImportError`."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError | ImportError) and OUT_OF_MEMORY.search(str(error)) is not None
    )


def refused_by_system(error: BaseException) -> UnirenderError | None:
    """What the system refused (a full disk, a name too long, a limit), as one sentence; None: it is another error."""
    if isinstance(error, RuntimeError) and str(error).startswith(SYMLINK_LOOP):
        error = OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(error).removeprefix(SYMLINK_LOOP).strip("'"))
    if isinstance(error, FileNotFoundError) and not _is_somewhere():
        return UnirenderError("the folder that you are in is not there any more; go to another one (cd)")
    if not isinstance(error, OSError) or error.errno not in TO_DO:
        return None
    what = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else "a file or the standard output"
    return UnirenderError(f"{what}: cannot be read or written ({error.strerror}); {TO_DO[error.errno]}")


def _is_somewhere() -> bool:
    """Whether the folder that the process is in is there."""
    try:
        return bool(os.getcwd())
    except FileNotFoundError:
        return False
