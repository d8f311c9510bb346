"""A pipeline folder is read whole, or refused in one sentence that names it."""

import contextlib
import json
import textwrap
from collections.abc import Iterator
from pathlib import Path

from diffusers.models.modeling_utils import ModelMixin
from diffusers.pipelines.pipeline_utils import DiffusionPipeline

from unirender.errors import UnirenderError
from unirender.shipped import checkpoint_folder, shipped_names

INDEX_FILE = "model_index.json"


def find_pipeline(checkpoint: str | Path | None) -> Path:
    """The folder of a checkpoint, as `unirender.shipped.checkpoint_folder` finds it.

    Raises:
        UnirenderError: no such folder, or no pipeline in it.
    """
    path = checkpoint_folder(checkpoint)
    if not (path / INDEX_FILE).is_file():
        inside = path / "pipeline"
        if (inside / INDEX_FILE).is_file():
            raise UnirenderError(f"{path}: is the folder of a training run; its pipeline is {inside}")
        raise UnirenderError(
            f"{path}: no pipeline folder ({INDEX_FILE} is missing), expected one written by `unirender train`, "
            f"or one of the names {', '.join(shipped_names())}"
        )
    return path


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """What goes wrong while a pipeline folder is read is an error about the folder.

    Raises:
        UnirenderError: anything did.
    """
    try:
        _check_index(path / INDEX_FILE)
        yield
    except (UnirenderError, MemoryError):
        raise
    except Exception as error:  # diffusers and safetensors raise half a dozen kinds for a broken file
        cause = textwrap.shorten(str(error), 300).rstrip(".") or type(error).__name__
        raise UnirenderError(
            f"{path}: cannot be read as a checkpoint ({cause}); if the files are damaged, copy the folder again"
        ) from error


def check_complete(pipeline: DiffusionPipeline) -> None:
    """Of weights that the file lacks diffusers only warns; it leaves them without values.

    Raises:
        ValueError: there are such weights.
    """
    for name, part in pipeline.components.items():
        if not isinstance(part, ModelMixin):
            continue
        missing = sorted(key for key, value in part.state_dict().items() if value.is_meta)
        if missing:
            raise ValueError(f"{len(missing)} weights of {name} are missing, the first is {missing[0]}")


def _check_index(file: Path) -> None:
    try:
        index = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from error
    if not isinstance(index, dict):
        raise ValueError(f"{file.name}: got {type(index).__name__}, expected a JSON object")
