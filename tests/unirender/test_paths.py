"""Folders of the cache, and who may read what is written."""

import os
import time
from pathlib import Path

import pytest

from unirender.errors import UnirenderError
from unirender.new_folders import new_folder
from unirender.system.paths import cache_dir, cached_folder
from unirender.system.whole_files import replace_file
from unirender_evaluation.suites.truth_file import write_tar
from unirender_reference.shards import write_shard


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


def test_the_cache_is_where_the_variable_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """`~` as well, which only a shell replaces; a user of a container may have no home."""
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.setenv("UNIRENDER_CACHE", "~/big disk")
    assert cache_dir() == Path("/home/ada/big disk")
    monkeypatch.delenv("UNIRENDER_CACHE")
    assert cache_dir() == Path("/home/ada/.cache/unirender")

    def nobody(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", nobody)
    with pytest.raises(UnirenderError, match=r"this user has no home directory, .*; set UNIRENDER_CACHE to a folder"):
        cache_dir()


@pytest.mark.parametrize("umask", [0o002, 0o022, 0o077])
def test_others_may_read_and_write_what_the_umask_lets_them(tmp_path: Path, umask: int) -> None:
    """A group shares a folder, its members' caches and results; or a user keeps his own to himself."""
    tmp_path.chmod(0o2777)  # what is made in it has its group
    before = os.umask(umask)
    try:
        replace_file(tmp_path / "file", "")
        write_shard(tmp_path / "shard.tar", [])
        write_tar(tmp_path / "truth.tar", {})
        with cached_folder(tmp_path / "cached"):
            pass
        with new_folder(tmp_path / "result"):
            pass
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode & 0o7777 for path in tmp_path.iterdir()}
    files = dict.fromkeys(["file", "shard.tar", "truth.tar"], 0o666 & ~umask)
    assert modes == files | dict.fromkeys(["cached", "result"], 0o2777 & ~umask)


def test_a_shard_is_written_where_folders_cannot_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows."""
    monkeypatch.delattr(os, "O_DIRECTORY")

    def refused(*args: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refused)
    assert len(write_shard(tmp_path / "shard.tar", [])) == 64
