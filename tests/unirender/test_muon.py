"""The optimiser of hidden matrices: its iteration against decompositions, its steps against the rule."""

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import pytest
import torch
from tiny_models import TRAIN
from torch import Tensor, nn

from unirender.models.build import build_model
from unirender.training.config import OptimizerConfig
from unirender.training.optim.memory import training_bytes
from unirender.training.optim.muon import (
    STEP_RMS,
    STEPS,
    A,
    B,
    C,
    Muon,
    Together,
    is_hidden_matrix,
    make_optimizer,
    matrix_shape,
    orthogonal_factor,
)
from unirender.training.presets import get_preset

MUON = OptimizerConfig(kind="muon", learning_rate=1e-2)


def matrices(rows: int, columns: int, count: int = 2) -> Tensor:
    """Of singular values that spread over two decades."""
    generator = torch.Generator().manual_seed(rows * columns)
    spread = torch.logspace(0, -2, columns)
    return torch.randn(count, rows, columns, generator=generator) * spread


def by_decomposition(x: Tensor) -> Tensor:
    """The iteration's polynomial, applied to the singular values themselves, in double precision."""
    u, s, v = torch.linalg.svd(x.double() / x.double().norm(dim=(1, 2), keepdim=True), full_matrices=False)
    for _ in range(STEPS):
        s = A * s + B * s**3 + C * s**5
    return (u * s[:, None]) @ v


@pytest.mark.parametrize(("rows", "columns"), [(32, 32), (48, 400), (400, 48), (128, 1152)])
def test_the_iteration_is_its_polynomial_of_the_singular_values(rows: int, columns: int) -> None:
    x = matrices(rows, columns)
    found, expected = orthogonal_factor(x), by_decomposition(x)
    assert (found - expected).abs().max() < 1e-3 * expected.abs().max()
    assert (found - x / x.norm(dim=(1, 2), keepdim=True)).abs().max() > 0.1 * expected.abs().max()  # it did something


def test_all_directions_of_a_wide_matrix_learn_alike() -> None:
    x = matrices(48, 400)
    before, after = (torch.linalg.svdvals(m[0]) for m in (x, orthogonal_factor(x)))
    assert before[0] / before[-1] > 2
    assert after.min() > 0.65
    assert after.max() < 1.25


def test_five_steps_reach_singular_values_of_a_few_thousandths() -> None:
    """In X / |X|; four steps would leave them at 0.4."""
    singular = torch.logspace(math.log10(0.003), 0, 64)
    after = orthogonal_factor(torch.diag(singular)[None])[0].diagonal()
    assert after[singular > 0.003 * singular.norm()].min() > 0.65
    assert after.max() < 1.25


def test_zeros_stay_zeros() -> None:
    assert not orthogonal_factor(torch.zeros(1, 32, 64)).any()


def stepped(
    weight: nn.Parameter, gradients: list[Tensor], lr: float = 1e-2, momentum: float = 0.95, decay: float = 0.0
) -> Tensor:
    optimizer = Muon([weight], lr, momentum, weight_decay=decay)
    for gradient in gradients:
        weight.grad = torch.empty_like(weight).copy_(gradient)
        optimizer.step()
    return weight.detach().clone()


def test_a_step_is_the_rule() -> None:
    torch.manual_seed(0)
    start, first, second = torch.randn(3, 40, 64)
    mu, lr, decay = 0.9, 0.02, 0.5
    found = stepped(nn.Parameter(start.clone()), [first, second], lr, mu, decay)
    expected, momentum = start.double(), torch.zeros(40, 64).double()
    for gradient in (first, second):
        momentum = mu * momentum + (1 - mu) * gradient
        direction = by_decomposition((mu * momentum + (1 - mu) * gradient)[None])[0]
        expected = (1 - lr * decay) * expected - lr * STEP_RMS * math.sqrt(64) * direction
    assert (found - expected).abs().max() < 1e-5


def test_the_size_of_a_step_does_not_follow_from_that_of_the_gradient() -> None:
    torch.manual_seed(0)
    gradient = torch.randn(64, 256)
    for size in (1e-6, 1.0, 1e3):
        moved = stepped(nn.Parameter(torch.zeros(64, 256)), [size * gradient])
        assert moved.square().mean().sqrt() == pytest.approx(1e-2 * STEP_RMS, rel=0.2)


def test_a_step_is_as_large_as_one_of_adamw() -> None:
    """On gradients that are noise, so that both can have one learning rate: Liu et al. find 0.2 to 0.4."""
    torch.manual_seed(0)
    gradients = list(torch.randn(60, 64, 64))
    muon = stepped(nn.Parameter(torch.zeros(64, 64)), gradients[-1:])
    weight, before = nn.Parameter(torch.zeros(64, 64)), torch.zeros(64, 64)
    adamw = torch.optim.AdamW([weight], 1e-2, weight_decay=0.0)
    for gradient in gradients:
        weight.grad, before = gradient, weight.detach().clone()
        adamw.step()
    sizes = [float(move.square().mean().sqrt()) for move in (muon, weight.detach() - before)]
    assert 0.5 < sizes[0] / sizes[1] < 2


def test_kernels_step_alike_however_they_lie_in_memory() -> None:
    torch.manual_seed(0)
    start, gradient = torch.randn(2, 64, 32, 3, 3)
    plain = stepped(nn.Parameter(start.clone()), [gradient])
    lying = nn.Parameter(start.clone().contiguous(memory_format=torch.channels_last))
    assert lying.stride() != start.stride()
    assert torch.allclose(stepped(lying, [gradient]), plain, atol=1e-6)
    assert not torch.allclose(plain, start, atol=1e-4)


def test_several_shapes_side_by_side_are_one_after_the_other() -> None:
    def run(pool: ThreadPoolExecutor | None) -> list[Tensor]:
        torch.manual_seed(0)
        weights = [nn.Parameter(torch.randn(shape)) for shape in ((32, 64), (64, 32), (32, 64), (40, 32, 3, 3))]
        optimizer = Muon(weights, 1e-2, pool=pool)
        for p in weights[:3]:  # the last one takes no part
            p.grad = torch.randn_like(p)
        optimizer.step()
        return [p.detach() for p in weights]

    with ThreadPoolExecutor(2) as pool:
        side_by_side = run(pool)
    alone = run(None)
    assert all(torch.equal(a, b) for a, b in zip(side_by_side, alone, strict=True))
    torch.manual_seed(0)
    assert not torch.equal(alone[0], torch.randn(32, 64))


def test_what_carries_numbers_from_outside_keeps_adamw() -> None:
    model, _ = build_model(get_preset("tiny").model)
    hidden = {name: p for name, p in model.named_parameters() if is_hidden_matrix(name, p)}
    outside = ("conv_in", "conv_out", "time_embedding", "extra", "_to_image", "_to_attributes")
    assert not [name for name in hidden if any(part in name for part in outside)]
    assert all(p.dim() >= 2 and min(matrix_shape(p)) >= 32 for p in hidden.values())
    everything = sum(p.numel() for p in model.parameters())
    assert 0.9 < sum(p.numel() for p in hidden.values()) / everything < 0.98
    optimizer = make_optimizer(model, MUON)
    assert isinstance(optimizer, Together)
    assert len(optimizer.param_groups[0]["params"]) == len(hidden)
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(list(model.parameters()))


def test_the_bytes_that_a_run_reports_are_those_of_its_moments() -> None:
    config = dataclasses.replace(get_preset("tiny").model, block_out_channels=(32, 32, 32, 32))
    model, _ = build_model(config)
    optimizer = make_optimizer(model, MUON)
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    optimizer.step()
    kept = sum(
        value.nbytes
        for moments in optimizer.state.values()
        for value in moments.values()
        if isinstance(value, Tensor) and value.dim()  # not the count of steps
    )
    assert training_bytes(model, "muon").moments == kept < training_bytes(model).moments


def test_a_state_is_restored() -> None:
    """The trainer's own test of it, `test_resume_is_exact`, has too small a network for all of its matrices."""

    def run(stop: bool) -> Tensor:
        torch.manual_seed(0)
        layer = nn.Linear(40, 40)
        optimizer = make_optimizer(layer, MUON)
        for step in range(4):
            for p in layer.parameters():
                p.grad = torch.randn_like(p)
            optimizer.step()
            if stop and step == 1:
                state = optimizer.state_dict()
                optimizer = make_optimizer(layer, MUON)
                optimizer.load_state_dict(state)
        return layer.weight.detach()

    assert torch.equal(run(stop=True), run(stop=False))


@pytest.mark.parametrize("kind", ["adamw", "muon"])
def test_moments_and_decay_are_those_of_the_config(kind: Literal["adamw", "muon"]) -> None:
    """After one step m = (1 - beta1) g and v = (1 - beta2) g^2; without a gradient a weight shrinks by rate x decay."""
    layer = nn.Linear(40, 40)
    config = OptimizerConfig(kind=kind, learning_rate=0.01, beta1=0.8, beta2=0.9, weight_decay=0.5)
    optimizer, before = make_optimizer(layer, config), layer.weight.detach().clone()
    layer.weight.grad, layer.bias.grad = torch.zeros(40, 40), torch.full((40,), 2.0)
    optimizer.step()
    torch.testing.assert_close(layer.weight.detach(), before * (1 - 0.01 * 0.5))
    moments = optimizer.state[layer.bias]
    torch.testing.assert_close(moments["exp_avg"], torch.full((40,), 0.2 * 2))
    torch.testing.assert_close(moments["exp_avg_sq"], torch.full((40,), 0.1 * 2**2))


def test_both_optimisers_follow_one_learning_rate() -> None:
    layer = nn.Linear(40, 40)
    optimizer = make_optimizer(layer, MUON)
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    before = [p.detach().clone() for p in layer.parameters()]
    for p in layer.parameters():
        p.grad = torch.randn_like(p)
    optimizer.step()
    assert all(torch.equal(a, b) for a, b in zip(before, layer.parameters(), strict=True))


def test_the_config_of_the_tests_has_hidden_matrices() -> None:
    model, _ = build_model(TRAIN.model)
    assert any(is_hidden_matrix(name, p) for name, p in model.named_parameters())
