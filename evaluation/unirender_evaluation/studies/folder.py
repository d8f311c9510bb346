"""The folder that a study writes to: one run at a time, and no file that is half written."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from unirender.whole_files import replace_file
from unirender_reference.folder_lock import locked, made_folder


@contextlib.contextmanager
def open_folder(path: Path) -> Iterator[Path]:
    """A folder to write to, made if it is not there, and held against a second run.

    Raises:
        UnirenderError: it cannot be made, or another run writes to it.
    """
    with made_folder(path), locked(path):
        yield path


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Writes texts (UTF-8) and pictures, each moved into place when complete."""
    for name, content in files.items():
        replace_file(folder / name, content)
