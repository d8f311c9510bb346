"""What the adapters of public diffusers pipelines share: their settings, the model folder, and the picture they see.

A folder is in diffusers format: `unet/`, `vae/`, `text_encoder/`, `tokenizer/` and `scheduler/`, weights as
safetensors. It is read whole or refused in one line, and never fetched from anywhere.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from jaxtyping import Float
from torch import Tensor

from unirender.color import srgb_decode, srgb_encode
from unirender.errors import UnirenderError
from unirender.models.diffusers_folder import TOKENIZER_FILES, load_tokenizer, load_weights, read_config, silent
from unirender.models.precision import resolve_device, resolve_dtype
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.versions import installed_version

CLASSES = {
    "unet": ("_class_name", "UNet2DConditionModel"),
    "vae": ("_class_name", "AutoencoderKL"),
    "text_encoder": ("architectures", "CLIPTextModel"),
}
SCHEDULER = "scheduler/scheduler_config.json"
PARTS = (*CLASSES, "tokenizer", "scheduler")
BACKGROUNDS = {"white": 1.0, "grey": 0.5, "black": 0.0}  # display values


@dataclass
class FolderMethod:
    """The settings of a benchmark method that is a model folder; what a `--method` can say after its `?`.

    Attributes:
        folder: of the model.
        name: of the row; empty = that of the folder.
        steps: denoising steps; None = what the model's authors use.
        ensemble: predictions that are combined into one.
        seed: of the noise; every picture starts from it, so that results do not depend on an order.
        resolution: pixels of the longer side at which the model works; 0 = the picture's own, None = what its authors
            use. Results have the picture's size again.
        background: what the model sees outside the mask: white, grey or black.
        device: auto, cpu, cuda or mps.
        dtype: auto, float32, bfloat16 or float16.

    Raises:
        UnirenderError: a setting is outside its range, or the folder lacks something.
    """

    folder: Path
    name: str = ""
    steps: int | None = None
    ensemble: int = 1
    seed: int = 0
    resolution: int | None = None
    background: str = "white"
    device: str = "cpu"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        self.name = self.name or self.folder.resolve().name
        for setting, least in (("steps", 1), ("ensemble", 1), ("resolution", 0)):
            value = getattr(self, setting)
            if value is not None and value < least:
                raise UnirenderError(f"{setting}: got {value}, expected at least {least}")
        if not -(2**63) <= self.seed < 2**64:
            raise UnirenderError(f"seed: got {self.seed}, expected an integer of 64 bits")
        if self.background not in BACKGROUNDS:
            raise UnirenderError(f"background: got {self.background!r}, expected one of {', '.join(BACKGROUNDS)}")
        self.device = resolve_device(self.device).type
        self.dtype = str(resolve_dtype(self.dtype, torch.device(self.device))).removeprefix("torch.")
        check_folder(self.folder)

    @cached_property
    def weights(self) -> str:
        """sha256 of the folder."""
        return folder_sha256(self.folder)

    def settings(self, steps: int, resolution: int) -> dict[str, Any]:
        """What results depend on, with the steps and the resolution that are used: the beginning of a `config`."""
        return {
            "adapter": type(self).__name__,
            "weights": self.weights,
            "steps": steps,
            "ensemble": self.ensemble,
            "seed": self.seed,
            "resolution": resolution,
            "background": self.background,
            "device": self.device,
            "dtype": self.dtype,
            "transformers": installed_version("transformers"),  # of the text encoder; no row of ours has one
        }

    def generator(self) -> torch.Generator:
        """A generator on the CPU at the seed: the same noise on every device."""
        return torch.Generator().manual_seed(self.seed)

    def picture(self, image_srgb: Image, mask: Mask) -> Float[Tensor, "1 3 h w"]:
        """What the model sees, as display values."""
        return torch.from_numpy(on_background(image_srgb, mask, self.background)).movedim(-1, 0)[None]


def on_background(image_srgb: Image, mask: Mask, background: str) -> Image:
    """A straight picture over one of `BACKGROUNDS`, mixed in linear light; display values in [0, 1]."""
    behind = srgb_decode(np.full(3, BACKGROUNDS[background], np.float32))
    return np.clip(srgb_encode(srgb_decode(image_srgb) * mask + behind * (1 - mask)), 0.0, 1.0)


def inside(value: Float[np.ndarray, "h w c"], mask: Mask) -> Float[np.ndarray, "h w c"]:
    """A map where the object is, 0 elsewhere."""
    return np.where(mask > 0, value, 0.0).astype(np.float32)


def unit_normal(value: Float[np.ndarray, "h w 3"], mask: Mask) -> Float[np.ndarray, "h w 3"]:
    """Directions made unit, 0 outside the mask; a vector of length 0 stays one."""
    length = np.linalg.norm(value, axis=-1, keepdims=True)
    return inside(value / np.maximum(length, 1e-6), mask)


def read_json(path: Path, meaning: str) -> dict[str, Any]:
    """A JSON object.

    Raises:
        UnirenderError: there is no such file, or it holds something else.
    """
    if not path.is_file():
        raise UnirenderError(f"{path}: is missing, expected {meaning}; pass a model folder in diffusers format")
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise UnirenderError(f"{path}: cannot be read as JSON ({error}); copy the folder again") from error


def part_configs(folder: Path) -> dict[str, dict[str, Any]]:
    """The configurations of U-Net, autoencoder and text encoder.

    Raises:
        UnirenderError: one is missing, broken or of another class.
    """
    return {part: read_config(folder / part, *expected) for part, expected in CLASSES.items()}


def check_folder(folder: Path) -> None:
    """Looks whether all parts are there, without reading weights.

    Raises:
        UnirenderError: there is no such folder, or a part is missing, broken or of another class.
    """
    if not folder.is_dir():
        raise UnirenderError(f"{folder}: no such folder, expected a model in diffusers format")
    for part in part_configs(folder):
        if not _weights(folder / part):
            raise UnirenderError(
                f"{folder / part}: no weights, expected .safetensors without a variant such as fp16 in its name; copy "
                "the files of full precision too"
            )
    if not any(all((folder / "tokenizer" / name).is_file() for name in names) for names in TOKENIZER_FILES):
        raise UnirenderError(f"{folder / 'tokenizer'}: no tokenizer, expected the files vocab.json and merges.txt")
    read_json(folder / SCHEDULER, "the scheduler's configuration")


def _weights(part: Path) -> list[Path]:
    """Files of weights that are read: neither pickles nor other precisions."""
    return [path for path in sorted(part.glob("*.safetensors")) if "." not in path.stem.split("-")[0]]


def folder_sha256(folder: Path) -> str:
    """sha256 over what is read of a model folder: weights, configurations, and the words of the tokenizer."""
    digest = hashlib.sha256()
    texts = [path for part in PARTS for path in sorted((folder / part).iterdir()) if path.suffix in (".json", ".txt")]
    index = [path for path in (folder / "model_index.json",) if path.is_file()]
    for path in (*index, *texts, *(path for part in CLASSES for path in _weights(folder / part))):
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").digest()
        digest.update(path.relative_to(folder).as_posix().encode() + content)
    return digest.hexdigest()


def load_parts(
    folder: Path, schedulers: Mapping[str, Any] | type, device: str, dtype: str, **scheduler_changes: Any
) -> dict[str, Any]:
    """The parts of a folder by the names that diffusers' pipelines take.

    Args:
        folder: of the model.
        schedulers: classes that it may name, by name; or one that works with its noise schedule whatever it names.
        device: where U-Net, autoencoder and text encoder go.
        dtype: their precision.
        **scheduler_changes: entries of the scheduler's configuration that are others than in the folder.

    Raises:
        UnirenderError: a part cannot be read, or transformers is not installed.
    """
    try:
        from transformers import CLIPTextModel, CLIPTokenizer
    except ImportError as error:
        raise UnirenderError(
            "a text encoder needs the package transformers, which is not installed; pip install 'unirender[sd]'"
        ) from error
    scheduler = load_scheduler(folder, schedulers, **scheduler_changes)
    tokenizer = load_tokenizer(CLIPTokenizer, folder / "tokenizer")
    with silent():
        text_encoder = load_weights(CLIPTextModel, folder / "text_encoder")
    modules = {
        "text_encoder": text_encoder,
        "unet": load_weights(UNet2DConditionModel, folder / "unet"),
        "vae": load_weights(AutoencoderKL, folder / "vae"),
    }
    if dtype != "float32":  # as they were read
        modules = {name: module.to(getattr(torch, dtype)) for name, module in modules.items()}
    moved = {name: module.to(device) for name, module in modules.items()}
    return moved | {"tokenizer": tokenizer, "scheduler": scheduler}


def load_scheduler(folder: Path, schedulers: Mapping[str, Any] | type, **changes: Any) -> Any:
    """The scheduler of a folder; arguments and errors as in `load_parts`."""
    config = read_json(folder / SCHEDULER, "the scheduler's configuration")
    kind = config.get("_class_name")
    if isinstance(schedulers, Mapping) and kind not in schedulers:
        raise UnirenderError(f"{folder / SCHEDULER}: got the scheduler {kind!r}, expected {' or '.join(schedulers)}")
    scheduler_class: Any = schedulers[str(kind)] if isinstance(schedulers, Mapping) else schedulers
    return scheduler_class.from_config(config, **changes)
