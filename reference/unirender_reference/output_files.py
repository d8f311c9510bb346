"""Where a command puts a file that was asked for: looked at before the work begins, and written complete or not at all.

What is no plain file, such as `/dev/stdout` or a pipe, is written to as it is.
"""

import contextlib
import errno
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UnirenderError
from unirender.system.whole_files import is_special
from unirender.system.writing import unusable, writing

if TYPE_CHECKING:
    from PIL import Image

ELSEWHERE = "choose another place"
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_file(option: str, path: Path | None) -> None:
    """Looks whether a file can be written; its folder need not be there yet. Nothing of the try stays.

    Args:
        option: that names it.
        path: of the file; None: there is none to be written.

    Raises:
        UnirenderError: it cannot.
    """
    if path is None or is_special(path):
        return
    if path.is_dir():
        raise UnirenderError(f"{option} {path}: is a folder, expected the name of a file")
    if (reason := unusable(path.absolute().parent)) is not None:
        raise UnirenderError(f"{option} {path}: cannot be written ({reason}); {ELSEWHERE}")


def write_file(option: str, path: Path, content: str | bytes) -> None:
    """Writes a file, and its folder where there is none.

    Raises:
        UnirenderError: it cannot be written; what was there stays.
    """
    from unirender.system.whole_files import replace_file

    with writing(f"{option} {path}", ELSEWHERE):
        replace_file(path, content)


def png_bytes(sheet: "Image.Image") -> bytes:
    """A sheet as the content of a PNG."""
    stored = io.BytesIO()
    sheet.save(stored, format="PNG", optimize=True)
    return stored.getvalue()


@contextlib.contextmanager
def full_disk(folder: Path) -> Iterator[None]:
    """For a block that also reads: of what goes wrong in it, only that there is no room is the folder's.

    Raises:
        UnirenderError: there is none.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        raise UnirenderError(
            f"{folder}: cannot be written ({error.strerror}); free some space and run the same command again to go on"
        ) from error
