"""Where data, training runs and caches live on a user's machine."""

import contextlib
import os
import re
import secrets
import shutil
import time
from collections.abc import Collection, Iterator
from pathlib import Path

from unirender.errors import UnirenderError

HALF_MADE = ".*.????????"  # folders of `cached_folder`
HALF_WRITTEN = re.compile(r"\.(.+)\.[0-9a-f]{12}")  # folders of `new_folders.new_folder`
REPLACED = re.compile(r"\.(.+)\.old\.[a-z0-9_]{8}")  # folders of `whole_files.move_into_place`
FORGOTTEN_S = 24 * 3600.0  # seconds after which nobody is still writing to one: it takes minutes


def cache_dir() -> Path:
    """Returns `${UNIRENDER_CACHE:-~/.cache/unirender}` (not created), `~` replaced by the home directory.

    Raises:
        UnirenderError: there is none, as of a user without an entry in the system's list, in a container say.
    """
    named = os.environ.get("UNIRENDER_CACHE") or "~/.cache/unirender"
    try:
        return Path(named).expanduser()
    except RuntimeError as error:
        raise UnirenderError(
            f"{named}: this user has no home directory, expected one for what is kept; set UNIRENDER_CACHE to a folder"
        ) from error


@contextlib.contextmanager
def cached_folder(folder: Path) -> Iterator[Path]:
    """A new folder of the cache, to be filled; it appears when it is complete. Where another process that makes the
    same was faster, its own stays. What killed processes left beside it half made goes after a day.

    Raises:
        UnirenderError: the cache cannot be written.
    """
    temporary = folder.with_name(f".{folder.name[:16]}.{secrets.token_hex(4)}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        for half_made in folder.parent.glob(HALF_MADE):
            _forget(half_made)
        temporary.mkdir()  # others may read it, as the umask says: a cache can be shared
        yield temporary
        try:
            os.rename(temporary, folder)
        except OSError:
            if not folder.exists():
                raise
    except OSError as error:
        raise UnirenderError(
            f"{folder}: cannot be written ({error.strerror}); free some space or set UNIRENDER_CACHE"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def forget_half_made(parent: Path, names: Collection[str]) -> None:
    """Deletes the temporary folders of `new_folders.new_folder(parent / name)` that a killed process left, after a day.

    Of an earlier result that it was about to replace, only where there is another now. Nothing in a folder that may be
    written to but not listed, as one is that others hand in to.
    """
    try:
        beside = list(parent.iterdir())
    except OSError:
        return
    for path in beside:
        replaced = REPLACED.fullmatch(path.name)
        found = replaced or HALF_WRITTEN.fullmatch(path.name)
        if found is None or found[1] not in names or path.is_symlink():
            continue
        if replaced is None or (parent / found[1]).is_dir():
            _forget(path)


def _forget(path: Path) -> None:
    with contextlib.suppress(OSError):  # another process takes it away
        if time.time() - path.stat().st_mtime > FORGOTTEN_S:
            shutil.rmtree(path, ignore_errors=True)
