"""The parts of a model folder in diffusers format: each is read whole, or refused in one line that says why."""

import contextlib
import json
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from unirender.errors import UnirenderError

TOKENIZER_FILES = (("vocab.json", "merges.txt"), ("tokenizer.json",))


def read_config(folder: Path, key: str, expected: str) -> dict[str, Any]:
    """`config.json` of one part.

    Args:
        folder: of the part.
        key: under which the config names the part's class.
        expected: that class.

    Raises:
        UnirenderError: there is none, it is broken, or it is of another class.
    """
    path = folder / "config.json"
    if not path.is_file():
        raise UnirenderError(
            f"{path}: is missing, expected the config of a part {expected}; pass a Stable Diffusion folder in "
            "diffusers format"
        )
    try:
        config = dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise UnirenderError(f"{path}: cannot be read as JSON ({error}); copy the folder again") from error
    got = config.get(key)
    if got not in (expected, [expected]):
        raise UnirenderError(f"{path}: got {key} {got!r}, expected {expected!r}, as Stable Diffusion 1 and 2 have it")
    return config


def load_weights(kind: Any, folder: Path) -> Any:
    """A part with all its weights, in float32 and frozen.

    Args:
        kind: its class, of diffusers or of transformers.
        folder: of the part.

    Raises:
        UnirenderError: the weights cannot be read, do not fit the config, or are not all there.
    """
    try:
        model, info = kind.from_pretrained(
            str(folder), dtype=torch.float32, use_safetensors=True, local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # diffusers, transformers and safetensors raise half a dozen kinds for a broken file
        raise UnirenderError(
            f"{folder}: cannot be read as {kind.__name__} with weights as safetensors ({one_line(error)}); copy it "
            "again"
        ) from error
    if missing := sorted(info["missing_keys"]):  # both libraries only warn of them, and leave them at random
        raise UnirenderError(
            f"{folder}: {len(missing)} weights are missing (first: {missing[0]}), expected all of {kind.__name__}; "
            "copy the folder again"
        )
    return model.eval().requires_grad_(False)


def load_tokenizer(kind: Any, folder: Path) -> Any:
    """A tokenizer of transformers.

    Args:
        kind: its class.
        folder: with `vocab.json` and `merges.txt`, or with `tokenizer.json`.

    Raises:
        UnirenderError: the files are missing or broken.
    """
    # without these files transformers makes up a vocabulary of three words, and says nothing
    if not any(all((folder / name).is_file() for name in names) for names in TOKENIZER_FILES):
        raise UnirenderError(
            f"{folder}: no tokenizer, expected the files vocab.json and merges.txt (or tokenizer.json) of the model"
        )
    try:
        return kind.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # half a dozen kinds for a broken file
        raise UnirenderError(f"{folder}: cannot be read as a tokenizer ({one_line(error)}); copy it again") from error


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Without the progress bar that transformers shows for a file that is read in a moment."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def one_line(error: Exception) -> str:
    """What an error of diffusers, transformers or safetensors says, for a message of ours."""
    return textwrap.shorten(str(error), 200).rstrip(".") or type(error).__name__
