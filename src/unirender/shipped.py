"""Folders of checkpoints: those that come with the package, by name, and the hash of one. Light to import."""

import hashlib
import json
from pathlib import Path

from unirender.errors import UnirenderError

CHECKPOINTS = Path(__file__).parent / "checkpoints"  # a pipeline folder each
DEFAULT = "tiny"
ACCOUNTS = ("training.json", "validation.json")  # files beside the weights that say how they came about


def shipped_names() -> tuple[str, ...]:
    """Names of the checkpoints in the package, in order."""
    return tuple(sorted(folder.name for folder in CHECKPOINTS.glob("*/") if (folder / "model_index.json").is_file()))


def checkpoint_folder(checkpoint: str | Path | None = None) -> Path:
    """The folder of a checkpoint.

    Args:
        checkpoint: path of a pipeline folder; or the name of one that ships, unless something of that name lies in the
            current folder; None: `tiny`.
    """
    if checkpoint is None:
        return CHECKPOINTS / DEFAULT
    path = Path(checkpoint)
    return CHECKPOINTS / path.name if str(path) in shipped_names() and not path.exists() else path


def trained_pixels(folder: Path) -> int:
    """The size of the pictures that a checkpoint was trained on, by the file that the training wrote beside it."""
    return json.loads((folder / "training.json").read_text())["train"]["model"]["resolution"]


def shipped_for(pixels: int) -> Path:
    """The folder of the shipped checkpoint for pictures of a width: the largest that is not for wider ones.

    For pictures that are smaller than every checkpoint's it is the smallest.
    """
    by_size = sorted((trained_pixels(CHECKPOINTS / name), name) for name in shipped_names())
    fitting = [name for size, name in by_size if size <= pixels] or [by_size[0][1]]
    return CHECKPOINTS / fitting[-1]


def checkpoint_label(checkpoint: str | Path | None = None) -> str:
    """What an account of a run calls a checkpoint: its folder's name, or `tiny (shipped)`."""
    folder = checkpoint_folder(checkpoint)
    return f"{folder.name} (shipped)" if folder.parent == CHECKPOINTS else folder.resolve().name


def checkpoint_sha256(folder: Path) -> str:
    """sha256 over the weights and configurations of a checkpoint folder, not over the account of its training.

    Raises:
        UnirenderError: there are none.
    """
    digest = hashlib.sha256()
    files = sorted(p for p in folder.rglob("*") if p.suffix in (".safetensors", ".json") and p.name not in ACCOUNTS)
    if not files:
        raise UnirenderError(f"no checkpoint in {folder}: expected .safetensors and .json files")
    for path in files:
        digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()
