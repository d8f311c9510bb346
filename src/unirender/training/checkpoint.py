"""The training state on disk: one file, written aside, synced and renamed, so that a killed run loses nothing older."""

import os
from pathlib import Path
from typing import Any

import torch

from unirender.errors import UnirenderError

STATE_FILE = "state.pt"


def save_state(folder: Path, state: dict[str, Any]) -> Path:
    """Writes tensors, numbers, strings, lists and dicts to `folder/state.pt`."""
    folder.mkdir(parents=True, exist_ok=True)
    path, partial = folder / STATE_FILE, folder / f"{STATE_FILE}.partial"
    with partial.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    return path


def load_state(folder: Path) -> dict[str, Any] | None:
    """Reads the state back, or None where there is none. Only data is read: no code in the file is run.

    Raises:
        UnirenderError: the file is broken.
    """
    path = folder / STATE_FILE
    if not path.exists():
        return None
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds for a broken file
        raise UnirenderError(
            f"{path}: cannot be read as a training state ({error}); move it away to start anew"
        ) from error
