"""The training state on disk: one file, written aside, synced and renamed, so that a killed run loses nothing older."""

import dataclasses
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from unirender.errors import UnirenderError
from unirender.system.whole_files import whole_file
from unirender.system.writing import writing
from unirender.training.config import TrainConfig
from unirender.training.loop.card import OF_A_RUN

STATE_FILE = "state.pt"
PICTURES = "pictures"
LENGTH = {"steps", "minutes"}  # a resumed run may be given another; minutes: in the account beside a pipeline only


def save_state(folder: Path, state: dict[str, Any]) -> Path:
    """Writes tensors, numbers, strings, lists and dicts to `folder/state.pt`.

    Raises:
        UnirenderError: it cannot be written; the state that was there stays.
    """
    path = folder / STATE_FILE
    with writing(path):
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file:
            torch.save(state, file)
    return path


def load_state(folder: Path, entries: Sequence[str] = ()) -> dict[str, Any] | None:
    """Reads the state back, or None where there is none. Only data is read: no code in the file is run.

    Args:
        folder: of the run.
        entries: that the state has.

    Raises:
        UnirenderError: the file is broken, or lacks one of the entries.
    """
    path = folder / STATE_FILE
    if not path.exists():
        return None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds for a broken file
        reason = str(error) or type(error).__name__
        raise UnirenderError(
            f"{path}: cannot be read as a training state ({reason}); move it away to start anew"
        ) from error
    if missing := [name for name in entries if not isinstance(state, dict) or name not in state]:
        raise UnirenderError(
            f"{path}: has no entry {missing[0]}, expected the state of a run of this command; move it away to start "
            "anew, or choose another --out"
        )
    return state


def check_leftover(folder: Path, result: str) -> None:
    """Looks whether a run folder has a result that a new run would replace.

    Args:
        folder: of the run.
        result: what a run leaves there.

    Raises:
        UnirenderError: it has, and no state to go on from.
    """
    if (folder / result).exists() and not (folder / STATE_FILE).exists():
        raise UnirenderError(
            f"{folder}: holds the {result} of a run and no state to go on from; a new run would replace it, and its "
            "log; pass another --out, or move it away"
        )


def plain(config: TrainConfig) -> dict[str, Any]:
    """The config as a state holds it: what JSON knows."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def with_defaults(stored: dict[str, Any]) -> dict[str, Any]:
    """The plain config of a state; entries that its version did not know yet have their defaults."""
    return _merged(plain(TrainConfig()), stored)


def differences(stored: dict[str, Any], config: TrainConfig) -> list[str]:
    """What a plain config, of a state or a `training.json`, has instead of `config`, by dotted names.

    The length of a run is no difference.
    """
    theirs, own = (dict(_leaves(tree)) for tree in (with_defaults(stored), plain(config)))
    names = sorted((theirs.keys() | own.keys()) - LENGTH)
    return [f"{n} {theirs.get(n)!r} instead of {own.get(n)!r}" for n in names if theirs.get(n) != own.get(n)]


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """`above`, and what only `below` has, in all depths."""
    merged = dict(below)
    for name, value in above.items():
        other = below.get(name)
        merged[name] = _merged(other, value) if isinstance(other, dict) and isinstance(value, dict) else value
    return merged


def _leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def replace_folder(folder: Path, partial: Path) -> Path:
    """Moves a finished folder into place; the one that was there is gone only after that."""
    old = _aside(folder)
    restore_folder(folder)
    if folder.exists():
        folder.rename(old)
    partial.rename(folder)
    shutil.rmtree(old, ignore_errors=True)
    return folder


def restore_folder(folder: Path) -> None:
    """Ends a replacement that was killed between its two moves: the folder is what it was, or the new one."""
    old = _aside(folder)
    if not old.exists():
        return
    if folder.exists():
        shutil.rmtree(old)
    else:
        old.rename(folder)


def tidy(folder: Path) -> None:
    """Takes from a run folder, which no other process writes to, what a killed run left there half written."""
    for name in OF_A_RUN:
        restore_folder(folder / name)
        shutil.rmtree(partial_folder(folder / name), ignore_errors=True)
    for file in folder.glob(f"{PICTURES}/.*.part"):
        file.unlink()


def partial_folder(folder: Path) -> Path:
    """Where a folder is written before it is moved into place."""
    return folder.with_name(f"{folder.name}.partial")


def _aside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.old")
