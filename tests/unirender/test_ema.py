"""The average of a run's weights, which is what ships."""

import math

import pytest
import torch

from unirender.training.optim.ema import Ema


def left_of_the_start(decay: float, updates: int) -> float:
    """How much of a weight's first value, 1, is in the average after updates to 0."""
    model = torch.nn.Linear(1, 1, bias=False, dtype=torch.float64)
    torch.nn.init.ones_(model.weight)
    ema = Ema(model, decay)
    torch.nn.init.zeros_(model.weight)
    for _ in range(updates):
        ema.update(model)
    assert not model.weight.any()
    ema.copy_to(model)
    return model.weight.item()


def test_the_start_of_a_run_is_forgotten() -> None:
    """While the decay warms up, n updates leave the product of (1 + k) / (10 + k), k < n: 1 / binomial(n + 9, 9)."""
    for updates in (1, 5, 20):
        assert left_of_the_start(1.0, updates) == pytest.approx(1 / math.comb(updates + 9, 9), rel=1e-9)


def test_after_the_warm_up_each_update_leaves_the_decay() -> None:
    assert left_of_the_start(0.05, 4) == pytest.approx(0.05**4, rel=1e-9)
    assert left_of_the_start(0.9, 200) / left_of_the_start(0.9, 199) == pytest.approx(0.9, rel=1e-9)
