"""Where data, training runs and caches live on a user's machine."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from unirender.errors import UnirenderError


def cache_dir() -> Path:
    """Returns `${UNIRENDER_CACHE:-~/.cache/unirender}` (not created)."""
    return Path(os.environ.get("UNIRENDER_CACHE") or Path.home() / ".cache" / "unirender")


@contextlib.contextmanager
def cached_folder(folder: Path) -> Iterator[Path]:
    """A new folder of the cache, to be filled; it appears when it is complete. Where another process that makes the
    same was faster, its own stays.

    Raises:
        UnirenderError: the cache cannot be written.
    """
    temporary = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name[:16]}.", dir=folder.parent))
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
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
