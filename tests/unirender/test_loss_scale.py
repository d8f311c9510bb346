"""The factor of a loss in float16: its rule is that of PyTorch, and a step that overflowed leaves no trace."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_models import TRAIN, make_batch
from torch import Tensor

from unirender.errors import UnirenderError
from unirender.training.config import RunConfig
from unirender.training.loop.checkpoint import load_state
from unirender.training.loop.trainer import Trainer
from unirender.training.optim import loss_scale
from unirender.training.optim.loss_scale import FIRST, LEAST, LossScale

CPU = torch.device("cpu")
CONFIG = dataclasses.replace(TRAIN, batch_size=2)  # a row for each direction: on a CPU float16 takes long


class Steady:
    """A source of one batch."""

    def next(self) -> dict[str, Tensor]:
        return make_batch(CONFIG.batch_size)

    def read_ahead(self) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass

    def refresh(self) -> str | None:
        return None


def test_the_rule_is_that_of_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_scale, "PATIENCE", 3)
    weight = torch.nn.Parameter(torch.zeros(1))
    theirs = torch.amp.GradScaler("cpu", init_scale=FIRST, growth_interval=3)
    optimizer, ours = torch.optim.SGD([weight], lr=0.0), LossScale(torch.float16)
    theirs.scale(torch.zeros(1))  # or it is not there yet
    for finite in (True, True, True, True, False, True, True, False, False, True, True, True, True, True, True):
        weight.grad = torch.tensor([1.0 if finite else float("inf")])
        theirs.step(optimizer)
        theirs.update()
        ours.after_finite() if finite else ours.after_overflow()
        assert ours.value == theirs.get_scale()


def test_without_float16_it_is_one_for_ever() -> None:
    scale = LossScale(torch.bfloat16)
    for _ in range(loss_scale.PATIENCE + 1):
        scale.after_finite()
    assert not scale.after_overflow()
    assert (scale.value, scale.state_dict()) == (1.0, {})
    scale.load_state_dict({"value": 8.0, "finite": 3})  # of a run that was in float16 until now
    assert scale.value == 1.0


def test_a_step_that_overflowed_is_left_out_and_the_run_goes_on(tmp_path: Path) -> None:
    trainer = Trainer(CONFIG, RunConfig(tmp_path, steps=2, log_every=1), CPU, torch.float16)
    trainer.loss_scale.value = 2.0**60
    before = [p.detach().clone() for p in trainer.model.parameters()]
    trainer.fit(Steady(), lambda line: None)
    assert all(torch.equal(p, old) for p, old in zip(trainer.model.parameters(), before, strict=True))
    assert trainer.ema.updates == 0
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["loss_scale"] for line in lines] == [2.0**60, 2.0**59]
    assert not any("image" in line or "grad_norm" in line for line in lines)
    state = load_state(tmp_path)
    assert state is not None
    assert state["loss_scale"] == {"value": 2.0**58, "finite": 0}
    more = Trainer(CONFIG, RunConfig(tmp_path, steps=3), CPU, torch.float16)
    more.resume(Steady())
    assert more.loss_scale.value == 2.0**58
    more.loss_scale.value = FIRST
    assert {"image", "grad_norm", "loss_scale"} <= set(more.train_step(Steady().next()))
    assert more.ema.updates == 1


def test_an_overflow_that_no_factor_made_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(CONFIG, RunConfig(tmp_path, steps=2), CPU, torch.float16)
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda weights, norm: torch.tensor(float("nan")))
    trainer.loss_scale.value = 2 * LEAST
    trainer.train_step(Steady().next())
    with pytest.raises(UnirenderError, match="the gradient at step 1 is nan; lower the learning rate"):
        trainer.train_step(Steady().next())
