"""A run that trains the renderer alone: what it moves, what it leaves, and what is refused."""

import dataclasses
from pathlib import Path

import pytest
import torch
from both_directions import OneBatch, decompose, render
from tiny_models import TRAIN, make_batch

from unirender.errors import UnirenderError, UsageError
from unirender.training.command import Train
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.config_check import check_config
from unirender.training.presets import PRESETS
from unirender.training.start import begin_with_network, read_start
from unirender.training.trainer import Trainer

RENDERER = dataclasses.replace(TRAIN, trains="renderer", p_render=1.0)
SPLIT = dataclasses.replace(RENDERER, model=dataclasses.replace(TRAIN.model, unified=False))


def trainer(folder: Path, config: TrainConfig = RENDERER, steps: int = 3) -> Trainer:
    return Trainer(config, RunConfig(folder, steps=steps), torch.device("cpu"), torch.float32)


@pytest.mark.parametrize("config", [RENDERER, SPLIT], ids=["unified", "split"])
def test_it_moves_the_image_decoder_and_nothing_of_what_is_found_in_pictures(
    config: TrainConfig, tmp_path: Path
) -> None:
    run = trainer(tmp_path / "run", config)
    before = {name: value.clone() for name, value in run.model.state_dict().items()}
    parts, maps = (run.model, run.loss.conditioning), make_batch(2)
    found, image = decompose(parts, maps), render(parts, maps)
    run.fit(OneBatch())
    moved = [name for name, value in run.model.state_dict().items() if not torch.equal(value, before[name])]
    assert {name.split(".")[0] for name in moved} == {"image_unet", "attributes_to_image"}
    assert not [name for name in moved if "down_blocks" in name or "mid_block" in name]
    assert torch.equal(decompose(parts, maps), found)
    assert not torch.equal(render(parts, maps), image)  # the twin


def test_it_learns_a_batch(tmp_path: Path) -> None:
    run, batch = trainer(tmp_path / "run", dataclasses.replace(RENDERER, map_dropout=0.0), steps=40), make_batch(4)
    batch["image"] = 0.5 * batch["image"]  # not its closed form, with which the network begins
    errors = [run.train_step(dict(batch)) for _ in range(40)]
    assert set(errors[0]) == {"image", "grad_norm", "lr"}
    assert errors[-1]["image"] < 0.5 * errors[0]["image"]


@pytest.mark.parametrize("changes", [{"p_render": 0.4}, {"timestep_rule": "algorithm1"}])
def test_a_config_that_asks_for_more_is_refused(changes: dict) -> None:
    check_config(RENDERER)
    with pytest.raises(UnirenderError, match="which renders alone; expected p_render 1"):
        check_config(dataclasses.replace(RENDERER, **changes))


def test_another_prior_is_learnt(tmp_path: Path) -> None:
    other = trainer(
        tmp_path / "a", dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, physics_prior="composite"))
    )
    begin_with_network(trainer(tmp_path / "b"), other.model)


def test_it_begins_with_the_shipped_checkpoint_and_not_without_any(tmp_path: Path) -> None:
    config = PRESETS["small_renderer"]
    check_config(config)
    run = trainer(tmp_path / "run", dataclasses.replace(config, batch_size=2), steps=1)
    read_start(config.model, Path("small")).apply(run)
    with pytest.raises(UsageError, match="expected --init with a trained one"):
        Train(Path("data"), preset="small_renderer").check()
