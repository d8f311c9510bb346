"""What a run knows of itself: losses and scores are those of the step that the weights have."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_models import TRAIN

from unirender.training.config import RunConfig
from unirender.training.data.source import ShardSource
from unirender.training.loop import facts
from unirender.training.loop.facts import data_facts, processor_name, training_facts
from unirender.training.loop.trainer import Trainer

LOG: tuple[dict[str, Any], ...] = (
    {"step": 10, "samples_per_s": 5.0, "image": 0.4},
    {"step": 10, "validation": {"albedo.psnr": 15.0}},
    {"step": 20, "samples_per_s": 5.0, "image": 0.3},
    {"step": 20, "validation": {"albedo.psnr": 16.0}, "scored_on": "4 scenes"},
)


def facts_at(step: int, folder: Path) -> dict[str, Any]:
    """Of a run with that log."""
    trainer = Trainer(TRAIN, RunConfig(folder, steps=20, scored_on="now"), torch.device("cpu"), torch.float32)
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in LOG))
    trainer.step = step
    return training_facts(trainer)


@pytest.mark.parametrize(
    ("step", "image", "psnr"), [(10, 0.4, 15.0), (20, 0.3, 16.0), (15, 0.4, None), (5, None, None)]
)
def test_the_log_counts_up_to_the_step_of_the_weights(
    step: int, image: float | None, psnr: float | None, tmp_path: Path
) -> None:
    """A killed run resumes behind the end of its log; and scores of an earlier step are not those of these weights."""
    found = facts_at(step, tmp_path)
    assert (found["steps"], found["samples"]) == (step, step * TRAIN.batch_size)
    assert found.get("losses", {}).get("image") == image
    assert found.get("scores", {}).get("albedo.psnr") == psnr
    assert found["scored_on"] == ("4 scenes" if step == 20 else "now")  # where the line says it, not what is asked now


@pytest.mark.parametrize(("steps", "minutes", "expected"), [(8, None, {"steps": 8}), (None, 2.5, {"minutes": 2.5})])
def test_the_configuration_has_the_length_of_the_run(
    steps: int | None, minutes: float | None, expected: dict[str, float], tmp_path: Path
) -> None:
    """And not the 20,000 steps of its preset, beside the 8 that it had."""
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=steps, minutes=minutes), torch.device("cpu"), torch.float32)
    found = training_facts(trainer)["train"]
    assert {name: found[name] for name in ("steps", "minutes") if name in found} == expected
    assert found["batch_size"] == TRAIN.batch_size


def test_a_run_without_a_log_or_open_data_says_nothing_of_them(tmp_path: Path) -> None:
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=1), torch.device("cpu"), torch.float32)
    found = training_facts(trainer)
    assert not {"losses", "scores", "data"} & set(found)
    assert json.loads(json.dumps(found)) == found
    assert data_facts(None) is None
    assert data_facts(ShardSource(tmp_path, 2, seed=0)) is None  # not opened: nothing is known yet


def test_the_processor_is_named_as_the_system_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts, "CPU_INFO", tmp_path / "cpuinfo")
    cpu = torch.device("cpu")
    elsewhere = processor_name(cpu)  # where there is no such file
    (tmp_path / "cpuinfo").write_text("processor : 0\nmodel name\t: Some CPU @ 2 GHz\nmodel name\t: Another\n")
    assert processor_name(cpu) == "Some CPU @ 2 GHz"
    (tmp_path / "cpuinfo").write_text("processor : 0\nFeatures : fp asimd\n")  # ARM names none
    assert processor_name(cpu) == elsewhere
    assert elsewhere is None or elsewhere.strip()
