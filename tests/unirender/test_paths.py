"""Folders of the cache."""

import os
import time
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


def test_what_a_kill_left_half_made_goes_after_a_day(tmp_path: Path) -> None:
    with cached_folder(tmp_path / "key") as made:
        old, new = (made.with_name(f".key.abcdefg{number}") for number in (1, 2))
        for folder, days in ((old, 2), (new, 0), (tmp_path / "other", 2)):
            folder.mkdir()
            (folder / "pixels.npy").touch()
            made_at = time.time() - days * 86400
            os.utime(folder, (made_at, made_at))
    with cached_folder(tmp_path / "next"):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"key", "next", "other", new.name}
