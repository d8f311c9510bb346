"""From a training run to what users load: the averaged weights as a pipeline folder, and the figures it came from."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from unirender.errors import UnirenderError
from unirender.models.build import build_model
from unirender.models.dual_stream import DualStreamModel
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.checkpoint import replace_folder

if TYPE_CHECKING:
    from unirender.training.trainer import Trainer

TRAINING_FILE = "training.json"


def averaged_pipeline(
    trainer: "Trainer", dtype: torch.dtype = torch.float32, device: torch.device | None = None
) -> UniRenderPipeline:
    """A pipeline of the averaged weights as they are now, a copy; on the trainer's device without another one."""
    model, _ = build_model(trainer.config.model)
    trainer.ema.copy_to(model)
    nn.Module.to(model.eval(), device or trainer.device, dtype)  # in place
    pipeline = UniRenderPipeline(dual_stream=model, scheduler=trainer.loss.scheduler)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def read_history(folder: Path) -> list[dict[str, Any]]:
    """The runs behind the weights of a pipeline folder, oldest first, as their `training.json` tells; [] without one.

    Raises:
        UnirenderError: the file is broken.
    """
    path = folder / TRAINING_FILE
    if not path.is_file():
        return []
    try:
        facts = json.loads(path.read_text())
        return [*facts.pop("continues", []), facts]
    except (ValueError, AttributeError, TypeError) as error:
        raise UnirenderError(f"{path}: cannot be read as the record of a training ({error})") from error


def load_network(folder: Path) -> DualStreamModel:
    """The network of a pipeline folder, in float32.

    Raises:
        UnirenderError: no such folder, or no pipeline in it.
    """
    return UniRenderPipeline.from_pretrained(folder).dual_stream


def export_pipeline(
    trainer: "Trainer",
    folder: Path,
    dtype: torch.dtype = torch.float16,
    beside: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Writes the averaged weights as a pipeline with `training.json` beside it: steps, samples, minutes and preset.

    The same of the runs that it continues stands there too.

    Other files, by name, stand in `beside`. The folder is moved into place when it is complete. Weights are stored as
    `dtype`; `UniRenderPipeline.from_pretrained` loads them as float32 unless told otherwise.
    """
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    pipeline = averaged_pipeline(trainer, dtype, torch.device("cpu"))
    pipeline.save_pretrained(partial, safe_serialization=True)
    for path in partial.rglob("*.safetensors"):  # diffusers writes them readable by their owner only
        path.chmod(0o644)
    facts = {
        "steps": trainer.step,
        "samples": trainer.step * trainer.config.batch_size,
        "minutes": round(trainer.seconds / 60, 2),
        "device": str(trainer.device),
        "autocast": str(trainer.dtype).removeprefix("torch."),
        "train": trainer.state_dict()["config"],
        "continues": trainer.continues,
    }
    (partial / TRAINING_FILE).write_text(json.dumps(facts, indent=2) + "\n")
    for name, text in beside.items():
        (partial / name).write_text(text)
    return replace_folder(folder, partial)
