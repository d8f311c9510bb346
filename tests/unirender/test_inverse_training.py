"""A run that trains the inverse direction alone, of a network without a picture encoder: what it moves and leaves."""

import dataclasses
from pathlib import Path

import pytest
import torch
from both_directions import OneBatch, decompose, render
from tiny_models import TRAIN, make_batch

from unirender.errors import UsageError
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.command import Train
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.config_check import check_config
from unirender.training.presets import PRESETS
from unirender.training.start import read_start
from unirender.training.trainer import Trainer

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
    decoder = (
        "image_to_attributes",
        *(f"attribute_unet.{part}" for part in ("up_blocks", "conv_norm_out", "conv_out")),
    )
    assert not [name for name in moved if not name.startswith(decoder)]
    assert not [part for part in decoder if not any(name.startswith(part) for name in moved)]
    assert torch.equal(render(parts, maps), image)
    assert not torch.equal(decompose(parts, maps), found)  # the twin


def test_its_preset_begins_with_the_shipped_checkpoint(tmp_path: Path) -> None:
    config = PRESETS["small_inverse"]
    check_config(config)
    run, start = trainer(tmp_path / "run", dataclasses.replace(config, batch_size=2), steps=1), Path("small")
    read_start(config.model, start).apply(run)
    shipped = UniRenderPipeline.from_pretrained(start).dual_stream.state_dict()
    assert all(torch.equal(value, shipped[name]) for name, value in run.model.state_dict().items())


def test_its_preset_is_refused_without_a_checkpoint() -> None:
    with pytest.raises(UsageError, match="expected --init with a trained one"):
        Train(Path("data"), preset="small_inverse").check()
