"""A pipeline folder is read whole, or refused in one sentence that names it."""

import contextlib
import inspect
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from diffusers.configuration_utils import ConfigMixin, FrozenDict
from safetensors import SafetensorError, safe_open

from unirender.errors import UnirenderError
from unirender.models.config import GONE
from unirender.models.diffusers_folder import one_line
from unirender.shipped import checkpoint_folder, shipped_names
from unirender.system.system_errors import out_of_memory
from unirender.system.wording import meant, near

INDEX_FILE = "model_index.json"
PLACE = "_name_or_path"  # in the configuration of what diffusers has read
OF_AVERAGE = ("decay", "min_decay", "optimization_step", "update_after_step", "use_ema_warmup", "inv_gamma", "power")
OF_DIFFUSERS = {"quantization_config", *OF_AVERAGE}  # what it adds to a network's configuration, by its EMAModel, too
OF_FILES = (OSError, SafetensorError)


def find_pipeline(checkpoint: str | Path | None) -> Path:
    """The folder of a checkpoint, as `unirender.shipped.checkpoint_folder` finds it.

    Raises:
        UnirenderError: no such folder, or no pipeline in it.
    """
    if not isinstance(checkpoint, str | Path | None):
        raise UnirenderError(
            f"checkpoint: got {checkpoint!r:.60}, expected the path of a pipeline folder, or one of the names "
            f"{', '.join(shipped_names())}"
        )
    path = checkpoint_folder(checkpoint)
    if not (path / INDEX_FILE).is_file():
        inside = path / "pipeline"
        if (inside / INDEX_FILE).is_file():
            raise UnirenderError(f"{path}: is the folder of a training run; its pipeline is {inside}")
        raise UnirenderError(
            f"{path}: no pipeline folder ({INDEX_FILE} is missing), expected one written by `unirender train`, "
            f"or one of the names {', '.join(shipped_names())}; of a hub, download the folder first"
            f"{meant(near(str(path), shipped_names()))}"
        )
    return path


@contextlib.contextmanager
def reading(path: Path, given: bool = False) -> Iterator[None]:
    """What goes wrong while a pipeline folder is read is an error about the folder, but for too little memory.

    Args:
        path: of the folder.
        given: the caller's own settings take the place of some; what is wrong may be one of them.

    Raises:
        UnirenderError: anything did.
    """
    try:
        _check_index(path / INDEX_FILE)
        yield
    except MemoryError:
        raise
    except UnirenderError as error:  # of what is built, which knows no files
        if given:
            raise
        raise UnirenderError(f"{path}: {error}") from error
    except Exception as error:  # diffusers and safetensors raise half a dozen kinds for a broken file
        if out_of_memory(error):
            raise
        advice = "; if the files are damaged, copy the folder again" if isinstance(error, OF_FILES) else ""
        raise UnirenderError(f"{path}: cannot be read as a checkpoint ({one_line(error)}){advice}") from error


def check_complete(model: torch.nn.Module, folder: Path) -> None:
    """Of weights that the files lack diffusers only warns, and leaves them as they are made, or without values.

    Args:
        model: as it was read.
        folder: with its weights as safetensors, in one file or several; of other files nothing is said.

    Raises:
        UnirenderError: there are such weights.
    """
    stored: set[str] = set()
    for file in folder.glob("*.safetensors"):
        with safe_open(file, framework="pt") as weights:
            stored.update(weights.keys())
    missing = sorted(model.state_dict().keys() - stored) if stored else []
    if missing:
        raise UnirenderError(
            f"{folder}: {len(missing)} weights are missing, the first is {missing[0]}; copy the folder again"
        )


def check_options(part: ConfigMixin, file: Path) -> None:
    """Of options that a class does not know diffusers only warns, and answers as if they were not there. They are a
    newer version's, an older one's, or misspelt.

    Args:
        part: as it was read.
        file: its configuration.

    Raises:
        UnirenderError: there are such options.
    """
    known = OF_DIFFUSERS | inspect.signature(type(part).__init__).parameters.keys()
    config: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    unknown = sorted(n for n in config.keys() - known if n[0] != "_" and (n not in GONE or config[n] != GONE[n]))
    if gone := [name for name in unknown if name in GONE]:
        raise UnirenderError(
            f"{file}: has {gone[0]} {config[gone[0]]!r}, which is gone, expected {GONE[gone[0]]!r}; choose another "
            "checkpoint, or use it with the version that it was trained with"
        )
    if unknown:
        raise UnirenderError(
            f"{file}: options {', '.join(unknown)} are not known to this {type(part).__name__}, whose answers may "
            "depend on them; update unirender, or take them out if they are misspelt"
        )


def copy_weights(model: torch.nn.Module) -> None:
    """Parts a model from the files that it was read from.

    Of weights in the files' own type safetensors only maps the pages: who writes the files anew changes them, or ends
    the process with a bus error where a file becomes shorter. And they lie in memory as in the file, off the
    boundaries that a sum's last bit depends on.
    """
    for tensor in (*model.parameters(), *model.buffers()):
        tensor.data = tensor.data.clone()


def forget_place(part: ConfigMixin | None) -> None:
    """Takes from a part's configuration the folder that it was read from, which diffusers would save with it."""
    if part is not None:
        kept = {name: value for name, value in part.config.items() if name != PLACE}
        part._internal_dict = FrozenDict(kept)  # pyright: ignore[reportAttributeAccessIssue] - diffusers has no other way


def _check_index(file: Path) -> None:
    try:
        index = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise OSError(f"{file.name}: {error}") from error
    if not isinstance(index, dict):
        raise OSError(f"{file.name}: got {type(index).__name__}, expected a JSON object")
