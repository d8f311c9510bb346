"""What is known of a training run: the content of `training.json`, and what its model card is written from.

A fact that is not known is left out.
"""

import platform
from pathlib import Path
from typing import TYPE_CHECKING, Any

import diffusers
import torch

import unirender
from unirender.training.data.device_data import DeviceSource
from unirender.training.data.source import BatchSource, ShardSource
from unirender.training.logs.run_log import LOG_FILE, read_lines
from unirender.training.loop.checkpoint import plain

if TYPE_CHECKING:
    from unirender.training.data.dataset import GroupDataset
    from unirender.training.loop.trainer import Trainer

CPU_INFO = Path("/proc/cpuinfo")
HASH_DIGITS = 10  # by which a shard is known: of 100 others one is taken for one of 10,000 in a case of a million


def training_facts(trainer: "Trainer") -> dict[str, Any]:
    """Length, hardware, software, data, losses and configuration of a run as it stands; plain data, no paths.

    The scores are those of the validation at the present step, if the log has one, on the scenes that it names.
    """
    run, log = trainer.run, _Log(trainer.run.out, trainer.step)
    scores = log.latest("validation") or {}
    scores = scores if scores.get("step") == trainer.step else {}
    facts = {
        "preset": run.preset,
        "parameters": sum(p.numel() for p in trainer.model.parameters()),
        "steps": trainer.step,
        "samples": trainer.step * trainer.config.batch_size,
        "minutes": round(trainer.seconds / 60, 2),
        "device": str(trainer.device),
        "autocast": str(trainer.dtype).removeprefix("torch."),
        "hardware": _hardware(trainer),
        "software": {
            "unirender": unirender.__version__,
            "torch": torch.__version__,
            "diffusers": diffusers.__version__,
        },
        "data": data_facts(trainer.source),
        "losses": log.latest("samples_per_s"),
        "scores": scores.get("validation"),
        "scored_on": scores.get("scored_on", run.scored_on),
        "train": _resolved(trainer),
        "continues": trainer.continues,
    }
    return {name: value for name, value in facts.items() if value is not None}


def data_facts(source: BatchSource | None) -> dict[str, Any] | None:
    """Name, fingerprint and size of an open data folder; None for a source that is none."""
    if isinstance(source, DeviceSource):
        source = source.source
    if not isinstance(source, ShardSource) or source.dataset is None:
        return None
    return dataset_facts(source.folder, source.dataset)


def dataset_facts(folder: Path, dataset: "GroupDataset") -> dict[str, Any]:
    """Name, fingerprint and size of a data folder, and by what its shards are known again."""
    return {
        "folder": folder.resolve().name,
        "fingerprint": dataset.fingerprint,
        "shard_hashes": shard_hashes(dataset),
        "shards": len(dataset.shard_names),
        "groups": len(dataset.keys),
        "pairs": dataset.num_pairs,
    }


def shard_hashes(dataset: "GroupDataset") -> str:
    """The first digits of each shard's sha256, in order, with a space between two: one line, whatever their number."""
    return " ".join(shard.sha256[:HASH_DIGITS] for shard in dataset.shards)


def processor_name(device: torch.device) -> str | None:
    """What computes: the name of the GPU, or of the CPU."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if CPU_INFO.is_file():
        names = [line.partition(":")[2].strip() for line in CPU_INFO.read_text().splitlines() if "model name" in line]
        if names:
            return names[0]
    return platform.processor() or platform.machine() or None


def _hardware(trainer: "Trainer") -> dict[str, Any]:
    """Processor, and threads that computed side by side in each of the processes."""
    facts: dict[str, Any] = {"processor": processor_name(trainer.device), "processes": trainer.processes.size}
    if trainer.device.type == "cpu":
        facts["threads"] = trainer.run.parallel * torch.get_num_threads()
    return {name: value for name, value in facts.items() if value is not None}


def _resolved(trainer: "Trainer") -> dict[str, Any]:
    """The configuration with the length that the run has: that of its preset may be another."""
    config, run = plain(trainer.config), trainer.run
    length = {"steps": run.steps, "minutes": run.minutes}
    return {name: value for name, value in (config | length).items() if name not in length or value is not None}


class _Log:
    """The lines of a run's log up to a step; the newest of a kind is the one with an entry of a name."""

    def __init__(self, folder: Path, step: int) -> None:
        self.lines = [line for line in read_lines(folder / LOG_FILE) if line["step"] <= step]

    def latest(self, name: str) -> dict[str, Any] | None:
        return next((line for line in reversed(self.lines) if name in line), None)
