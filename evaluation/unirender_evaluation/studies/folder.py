"""The folder that a study writes to: one run at a time, and no file that is half written."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from rich.console import Console

from unirender.system.whole_files import replace_file
from unirender_evaluation.studies.about import line
from unirender_evaluation.tables.text import TextTable
from unirender_reference.folder_lock import locked, made_folder


@contextlib.contextmanager
def open_folder(path: Path) -> Iterator[Path]:
    """A folder to write to, made if it is not there, and held against a second run."""
    with made_folder(path), locked(path):
        yield path


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Writes texts (UTF-8) and pictures, each moved into place when complete."""
    for name, content in files.items():
        replace_file(folder / name, content)


def write_study(
    stem: Path, tables: Sequence[TextTable], below: Mapping[str, object], content: str, counts: str, console: Console
) -> None:
    """Writes `.md` (tables, and what one must know below them) and `.json`, and shows the tables."""
    text = "\n".join([*(table.markdown() for table in tables), line(below)])
    write_files(stem.parent, {f"{stem.name}.md": text, f"{stem.name}.json": content})
    for table in tables:
        table.show(console)
    console.print(f"{counts}; {stem}.md, .json", highlight=False, markup=False)
