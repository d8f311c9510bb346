"""Where data, training runs and caches live on a user's machine."""

import os
from pathlib import Path


def cache_dir() -> Path:
    """Returns `${UNIRENDER_CACHE:-~/.cache/unirender}` (not created)."""
    return Path(os.environ.get("UNIRENDER_CACHE") or Path.home() / ".cache" / "unirender")
