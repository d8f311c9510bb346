"""Folders of the cache."""

from pathlib import Path

import pytest

from unirender.errors import UnirenderError
from unirender.paths import cached_folder


def test_a_folder_of_the_cache_is_whole_or_not_there(tmp_path: Path) -> None:
    folder = tmp_path / "cache" / "key"

    def fails_halfway() -> None:
        with cached_folder(folder) as made:
            (made / "half").touch()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fails_halfway()
    assert list(folder.parent.iterdir()) == []
    with cached_folder(folder) as slower, cached_folder(folder) as faster:
        (slower / "slower").touch()
        (faster / "faster").touch()
    assert [path.name for path in folder.parent.rglob("*")] == ["key", "faster"]
    (tmp_path / "file").touch()
    message = r"cannot be written \(.*\); free some space or set UNIRENDER_CACHE"
    with pytest.raises(UnirenderError, match=message), cached_folder(tmp_path / "file" / "key"):
        pass
