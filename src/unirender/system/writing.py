"""What is said where something cannot be written: which file, and why. Light to import."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from unirender.errors import UnirenderError
from unirender.system.ends import causes

AGAIN = "mend that and run the same command again"


def unusable(folder: Path) -> str | None:
    """Why nothing can be written to a folder, which need not be there yet; None: it can be."""
    try:
        place = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        if not place.is_dir():
            return f"{place} is no folder"
        links = (path for path in (folder, *folder.absolute().parents) if path.is_symlink())
        if (dangling := next((path for path in links if not path.exists()), None)) is not None:
            return f"{dangling} is a link to nothing"
        with tempfile.TemporaryFile(dir=place):  # of which nothing stays
            return None
    except OSError as error:
        return error.strerror or str(error)


def check_out(out: Path) -> None:
    """Looks at the folder of a run before anything is built.

    Raises:
        UnirenderError: nothing can be written to it.
    """
    if (reason := unusable(out)) is not None:
        raise UnirenderError(f"{out}: cannot be written ({reason}), expected a folder; choose another --out")


@contextlib.contextmanager
def writing(what: Path | str, to_do: str = AGAIN) -> Iterator[None]:
    """For a block that writes what is named, and reads nothing of the user's.

    Raises:
        UnirenderError: it cannot be written.
    """
    try:
        yield
    except UnirenderError:
        raise
    except Exception as error:
        if (reason := _reason(error)) is None:
            raise
        raise UnirenderError(f"{what}: cannot be written ({reason}); {to_do}") from error


def _reason(error: Exception) -> str | None:
    """Why a file could not be written; None: it is another error.

    PyTorch raises a `RuntimeError` while it handles the system's own, safetensors an error that only quotes it.
    """
    from safetensors import SafetensorError

    if isinstance(error, SafetensorError):
        return " ".join(str(error).split())
    for cause in causes(error):
        if isinstance(cause, OSError):
            return cause.strerror or str(cause)
    return None
