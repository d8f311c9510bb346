"""A run that trains the inverse direction alone, of a network without a picture encoder: what it moves and leaves."""

import dataclasses
from pathlib import Path

import pytest
import torch
from both_directions import OneBatch, decompose, render
from tiny_models import TRAIN, make_batch

from unirender.errors import UsageError
from unirender.training.config_check import check_config
from unirender.training.presets import PRESETS, TrainConfig
from unirender.training.run import Train
from unirender.training.start import read_start
from unirender.training.trainer import RunConfig, Trainer

NO_RENDERING = dataclasses.replace(TRAIN.loss, cycle=0.0)
INVERSE = dataclasses.replace(TRAIN, trains="inverse", p_render=0.0, loss=NO_RENDERING)


def trainer(folder: Path, config: TrainConfig = INVERSE, steps: int = 3) -> Trainer:
    return Trainer(config, RunConfig(folder, steps=steps), torch.device("cpu"), torch.float32)


def test_it_moves_the_attribute_decoder_and_nothing_of_what_is_rendered(tmp_path: Path) -> None:
    run = trainer(tmp_path / "run")
    before = {name: value.clone() for name, value in run.model.state_dict().items()}
    parts, maps = (run.model, run.loss.conditioning), make_batch(2)
    found, image = decompose(parts, maps), render(parts, maps)
    run.fit(OneBatch())
    moved = [name for name, value in run.model.state_dict().items() if not torch.equal(value, before[name])]
    assert {name.split(".")[0] for name in moved} == {"attribute_unet", "image_to_attributes"}
    assert not [name for name in moved if "down_blocks" in name or "mid_block" in name]
    assert torch.equal(render(parts, maps), image)
    assert not torch.equal(decompose(parts, maps), found)  # the twin


def test_its_preset_begins_with_the_shipped_checkpoint_and_not_without_any(tmp_path: Path) -> None:
    config = PRESETS["small_inverse"]
    check_config(config)
    run = trainer(tmp_path / "run", dataclasses.replace(config, batch_size=2), steps=1)
    read_start(config.model, Path("small")).apply(run)
    with pytest.raises(UsageError, match="expected --init with a trained one"):
        Train(Path("data"), preset="small_inverse").check()
