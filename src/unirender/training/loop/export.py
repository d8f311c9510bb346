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
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.system.writing import writing
from unirender.training.data.device_data import DeviceSource
from unirender.training.data.source import BatchSource, ShardSource
from unirender.training.loop.card import CARD_FILE, card_text
from unirender.training.loop.checkpoint import partial_folder, replace_folder
from unirender.training.loop.facts import training_facts

if TYPE_CHECKING:
    from unirender.training.loop.trainer import Trainer

TRAINING_FILE, SCORES_FILE = "training.json", "validation.json"


def averaged_pipeline(
    trainer: "Trainer", dtype: torch.dtype = torch.float32, device: torch.device | None = None
) -> UniRenderPipeline:
    """A pipeline of the averaged weights as they are now, a copy; on the trainer's device without another one.

    An autoencoder is the trainer's own, in float32. Roughness and metallic are maps where those of the data are.
    """
    model, _ = build_model(trainer.config.model, trainer.vae)
    trainer.ema.copy_to(model)
    for own, trained in zip(model.buffers(), trainer.model.buffers(), strict=True):  # the prompt embedding
        own.copy_(trained)
    nn.Module.to(model.eval(), device or trainer.device, dtype)  # in place
    pipeline = UniRenderPipeline(model, trainer.loss.scheduler, trainer.vae, material=_material(trainer.source))
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def _material(source: BatchSource | None) -> str:
    """How a pipeline answers that was trained on the data of a source; of a source of one's own nothing is known."""
    if isinstance(source, DeviceSource):
        source = source.source
    return "map" if isinstance(source, ShardSource) and source.open().has_material_maps else "scalar"


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
        raise UnirenderError(
            f"{path}: cannot be read as the record of a training ({error}); copy it again, or move it away"
        ) from error


def save_weights(pipeline: UniRenderPipeline, folder: Path) -> None:
    """`save_pretrained`, with the rights that the umask leaves: diffusers writes weights for their owner alone."""
    pipeline.save_pretrained(folder, safe_serialization=True)
    rights = (folder / "model_index.json").stat().st_mode & 0o777
    for weights in folder.rglob("*.safetensors"):
        weights.chmod(rights)


def export_pipeline(trainer: "Trainer", folder: Path, beside: Mapping[str, str] = MappingProxyType({})) -> Path:
    """Writes the averaged weights as a pipeline with what is known of the run beside it.

    That is `training.json`, with the same of the runs that it continues, and a model card, `README.md`.

    Other files, by name, stand in `beside`. The folder is moved into place when it is complete. Weights are stored in
    float16; `UniRenderPipeline.from_pretrained` loads them as float32 unless told otherwise.

    Raises:
        UnirenderError: it cannot be written; what was there stays.
    """
    partial = partial_folder(folder)
    shutil.rmtree(partial, ignore_errors=True)
    pipeline = averaged_pipeline(trainer, torch.float16, torch.device("cpu"))
    facts = training_facts(trainer) | {"stored_as": "float16"}
    chosen = json.loads(beside[SCORES_FILE]) if SCORES_FILE in beside else None
    if chosen is not None:  # the log may have other scores of this step, on other scenes
        facts["scores"] = {name: score["value"] for name, score in chosen["scores"].items()}
        facts |= {} if trainer.run.scored_on is None else {"scored_on": trainer.run.scored_on}
    try:
        with writing(folder):
            save_weights(pipeline, partial)
            (partial / TRAINING_FILE).write_text(json.dumps(facts, indent=2) + "\n")
            for name, text in beside.items():
                (partial / name).write_text(text)
            (partial / CARD_FILE).write_text(card_text(folder.name, facts, chosen), encoding="utf-8")
            return replace_folder(folder, partial)
    except UnirenderError:
        shutil.rmtree(partial, ignore_errors=True)
        raise
