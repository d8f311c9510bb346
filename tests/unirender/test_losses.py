"""The loss: what is compared with what, and where gradients go."""

import dataclasses

import pytest
import torch
from tiny_models import make_batch, make_model
from torch import Tensor

from unirender.diffusion.schedule import make_scheduler
from unirender.diffusion.timesteps import Timesteps
from unirender.training.losses import LossFunction
from unirender.training.presets import LossConfig

T = 999


def loss_function(map_dropout: float = 0.0, **changes: object) -> LossFunction:
    model, conditioning = make_model()
    config = dataclasses.replace(LossConfig(cycle_share=1.0), **changes)  # type: ignore[arg-type]  # any field
    return LossFunction(model, conditioning, make_scheduler(), config, map_dropout)


def inverse(batch: int = 4) -> Timesteps:
    return Timesteps(torch.full((batch,), T), torch.zeros(batch, dtype=torch.long))


def rendering(batch: int = 4) -> Timesteps:
    return Timesteps(torch.zeros(batch, dtype=torch.long), torch.full((batch,), T))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_terms_of_both_directions() -> None:
    loss, batch = loss_function(), make_batch()
    mixed = Timesteps(torch.tensor([0, 0, T, 300]), torch.tensor([T, 20, 0, 0]))
    maps = {"material", "albedo", "normal", "specular", "diffuse", "environment"}
    assert set(loss.terms(batch, mixed, generator())) == maps | {"image", "cycle"}
    assert set(loss.terms(batch, rendering(), generator())) == {"image"}
    assert set(loss.terms(batch, inverse(), generator())) == maps | {"cycle"}


def test_background_counts_little() -> None:
    """Changing the target outside the mask changes the error by the background weight, inside by 1."""
    loss = loss_function(background=0.1, cycle=0.0)
    clean = torch.zeros(1, 72, 16, 16)
    mask = make_batch(1)["mask"]
    predicted = loss.conditioning.codec.encode((1 - mask).expand(-1, 3, -1, -1)).repeat(1, 6, 1, 1)
    terms = loss._attribute_errors(predicted, clean, mask)
    outside, inside = float((1 - mask).sum()), float(mask.sum())
    assert float(terms["albedo"]) == pytest.approx(0.1 * outside / (0.1 * outside + inside), rel=1e-5)
    assert float(terms["environment"]) == pytest.approx(outside / (outside + inside), rel=1e-5)


def test_total_is_the_weighted_sum() -> None:
    loss = loss_function(albedo=3.0, cycle=2.0)
    loss.cycle_scale = 0.5
    terms = {"albedo": torch.tensor(0.2), "cycle": torch.tensor(0.4)}
    assert float(loss.total(terms)) == pytest.approx(3 * 0.2 + 2 * 0.5 * 0.4)


def gradients_of_cycle(into_renderer: bool) -> dict[str, Tensor]:
    loss = loss_function(cycle_into_renderer=into_renderer)
    terms = loss.terms(make_batch(), inverse(), generator())
    names, parameters = zip(*loss.model.named_parameters(), strict=True)
    found = torch.autograd.grad(terms["cycle"], parameters, allow_unused=True)
    return {name: g for name, g in zip(names, found, strict=True) if g is not None and g.any()}


def test_cycle_gradient_into_the_renderer_is_a_switch() -> None:
    detached, attached = gradients_of_cycle(False), gradients_of_cycle(True)
    decoder = "image_unet.up_blocks"
    assert any(name.startswith(decoder) for name in attached)
    assert not any(name.startswith(decoder) for name in detached)  # the inverse pass decodes attributes only
    assert any(name.startswith("attribute_unet.up_blocks") for name in detached)


def test_detached_cycle_gradient_is_the_true_gradient() -> None:
    """Both switches have the same gradient on weights that only the inverse pass uses: the attribute decoder's."""
    detached, attached = gradients_of_cycle(False), gradients_of_cycle(True)
    for name in ("attribute_unet.conv_out.weight", "attribute_unet.up_blocks.0.resnets.0.conv1.weight"):
        torch.testing.assert_close(detached[name], attached[name], rtol=1e-4, atol=1e-7)


def test_cycle_value_is_the_rerendering_error_of_the_prediction() -> None:
    values = []
    for into_renderer in (True, False):
        loss = loss_function(cycle_into_renderer=into_renderer)
        values.append(float(loss.terms(make_batch(), inverse(), generator())["cycle"].detach()))
    assert values[0] == pytest.approx(values[1], rel=1e-6)


def test_cycle_can_be_off() -> None:
    assert "cycle" not in loss_function(cycle=0.0).terms(make_batch(), inverse(), generator())
    waiting = loss_function()
    waiting.cycle_scale = 0.0
    assert "cycle" not in waiting.terms(make_batch(), inverse(), generator())


def test_dropped_maps_reach_the_network_as_noise_only() -> None:
    """With every droppable map withheld, the rendering does not depend on them."""
    batch = make_batch()
    other = {
        name: (make_batch(seed=9)[name] if name in ("albedo", "specular", "diffuse") else v)
        for name, v in batch.items()
    }
    errors = {}
    for dropout in (1.0, 0.0):
        loss = loss_function(dropout)
        errors[dropout] = [float(loss.terms(b, rendering(), generator())["image"].detach()) for b in (batch, other)]
    assert errors[1.0][0] == pytest.approx(errors[1.0][1], rel=1e-6)
    assert errors[0.0][0] != pytest.approx(errors[0.0][1], rel=1e-3)


def test_algorithm_1_compares_each_stream_where_it_is_noisy() -> None:
    loss = loss_function()
    both = Timesteps(torch.tensor([T, 0, T, 0]), torch.tensor([5, 10, 0, 0]))
    assert {"image", "albedo"} <= set(loss.joint_terms(make_batch(), both, generator()))
    clean_a = Timesteps(torch.zeros(4, dtype=torch.long), torch.full((4,), 7))
    assert set(loss.joint_terms(make_batch(), clean_a, generator())) == {"image"}
