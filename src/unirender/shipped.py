"""The checkpoints that come with the package, by name. Light to import."""

import json
from pathlib import Path

CHECKPOINTS = Path(__file__).parent / "checkpoints"  # a pipeline folder each
DEFAULT = "tiny"


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
