"""The loss: what is compared with what, how it is weighted, and where gradients go."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from tiny_models import MODEL, make_batch, make_model
from torch import Tensor

from unirender.camera import Camera
from unirender.diffusion import inference
from unirender.diffusion.schedule import make_scheduler
from unirender.diffusion.timesteps import Timesteps
from unirender.models.build import build_model
from unirender.models.codec import KLCodec
from unirender.models.dual_stream import DualStreamOutput
from unirender.models.packing import TRIPLETS
from unirender.models.priors import PRIORS
from unirender.training.config import LossConfig
from unirender.training.losses import consistency as consistency_module
from unirender.training.losses import terms as loss_terms
from unirender.training.losses.consistency import Consistency
from unirender.training.losses.loss_function import DROPPABLE, LossFunction
from unirender.training.losses.terms import Errors, compressed

T = 999
MAPS = {"material", "albedo", "normal", "specular", "diffuse", "environment"}


def loss_function(map_dropout: float = 0.0, prior: str = "split_sum", **changes: Any) -> LossFunction:
    model, conditioning = make_model(physics_prior=prior)
    config = dataclasses.replace(LossConfig(cycle_share=1.0), **changes)
    return LossFunction(model, conditioning, make_scheduler(), config, map_dropout)


def inverse(batch: int = 4, t: int = T) -> Timesteps:
    return Timesteps(torch.full((batch,), t), torch.zeros(batch, dtype=torch.long))


def rendering(batch: int = 4, t: int = T) -> Timesteps:
    return Timesteps(torch.zeros(batch, dtype=torch.long), torch.full((batch,), t))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def values(loss: LossFunction, timesteps: Timesteps, batch: dict[str, Tensor] | None = None) -> dict[str, float]:
    found = loss.terms(make_batch() if batch is None else batch, timesteps, generator())
    return {name: float(term.detach()) for name, term in found.items()}


# --- what is compared


def test_terms_of_both_directions() -> None:
    loss = loss_function()
    mixed = Timesteps(torch.tensor([0, 0, T, 300]), torch.tensor([T, 20, 0, 0]))
    assert set(values(loss, mixed)) == MAPS | {"image", "cycle"}
    assert set(values(loss, rendering())) == {"image"}
    assert set(values(loss, inverse())) == MAPS | {"cycle"}


def test_the_default_loss_is_the_plain_mean_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """No option on: each term is the weighted mean of squares, written out, of one pass over all rows."""
    loss, batch = loss_function(cycle=0.0), make_batch()
    t = Timesteps(torch.tensor([0, 0, T, 300]), torch.tensor([T, 20, 0, 0]))
    seen: list[tuple] = []
    forward = loss.model.forward
    monkeypatch.setattr(
        loss.model, "forward", lambda *args, **kwargs: seen.append((args, kwargs)) or forward(*args, **kwargs)
    )
    found = loss.terms(batch, t, generator())
    (((*args,), kwargs),) = seen
    output = forward(*args, **kwargs | {"attribute_rows": slice(None), "image_rows": slice(None)})
    assert output.image is not None
    assert output.attributes is not None
    clean_i, clean_a = loss.conditioning.encode_image(batch["image"]), loss.conditioning.encode_attributes(batch)
    weights = loss.conditioning.codec.weights(0.02 + 0.98 * batch["mask"])

    def mean(error: Tensor, weights: Tensor) -> Tensor:
        return (error * weights).sum() / weights.sum()

    image = mean((output.image - clean_i)[:2].square(), weights[:2])
    torch.testing.assert_close(found["image"], image, rtol=1e-5, atol=0)
    errors = (output.attributes - clean_a)[2:].square()
    torch.testing.assert_close(found["albedo"], mean(errors[:, 12:24], weights[2:]), rtol=1e-5, atol=0)
    torch.testing.assert_close(found["environment"], errors[:, 60:].mean(), rtol=1e-5, atol=0)
    assert not torch.isclose(found["albedo"], errors[:, 12:24].mean(), rtol=1e-3)  # the twin: not the unweighted mean


def test_background_counts_little() -> None:
    """Changing the target outside the mask changes the error by the background weight, inside by 1."""
    errors = Errors(loss_function().conditioning, background=0.1)
    clean = torch.zeros(1, 72, 16, 16)
    mask = make_batch(1)["mask"]
    predicted = errors.conditioning.codec.encode((1 - mask).expand(-1, 3, -1, -1)).repeat(1, 6, 1, 1)
    terms = errors.attributes(predicted, clean, mask)
    outside, inside = float((1 - mask).sum()), float(mask.sum())
    assert float(terms["albedo"]) == pytest.approx(0.1 * outside / (0.1 * outside + inside), rel=1e-5)
    assert float(terms["environment"]) == pytest.approx(outside / (outside + inside), rel=1e-5)


def test_a_pixel_counts_by_its_coverage() -> None:
    weights = Errors(loss_function().conditioning, background=0.2).pixel_weights(torch.tensor([[[[0.0, 0.5, 1.0]]]]))
    torch.testing.assert_close(weights.flatten(), torch.tensor([0.2, 0.6, 1.0]))


def test_an_image_error_is_compressed_row_by_row() -> None:
    """E log(1 + e / E): a far larger error of one picture does not decide the gradient of all."""
    error = torch.tensor([1e-8, 1e-3, 10.0], dtype=torch.float64, requires_grad=True)
    floor = 1e-3
    value = compressed(error, floor)
    torch.testing.assert_close(value[0], error[0], rtol=1e-4, atol=0)
    torch.testing.assert_close(value[1], torch.tensor(floor * math.log(2), dtype=torch.float64))
    (gradient,) = torch.autograd.grad(value.sum(), error)
    torch.testing.assert_close(
        gradient * error, floor * error / (floor + error)
    )  # at most the floor, whatever the error
    loss, plain = loss_function(image_floor=0.02), loss_function()
    batch, t = make_batch(), rendering()
    weights = plain.conditioning.codec.weights(Errors(plain.conditioning, 0.02).pixel_weights(batch["mask"]))
    with torch.no_grad():
        clean = plain.conditioning.encode_image(batch["image"])
        predicted = clean + torch.linspace(0.01, 0.5, 4)[:, None, None, None]
    errors = Errors(plain.conditioning, 0.02)
    rows = (((predicted - clean).square() * weights).sum((1, 2, 3)) / weights.sum((1, 2, 3))).tolist()
    expected = sum(0.02 * math.log1p(row / 0.02) for row in rows) / 4
    assert float(errors.image(predicted, clean, batch["mask"], floor=0.02)) == pytest.approx(expected, rel=1e-4)
    assert values(loss, t)["image"] < values(plain, t)["image"]


def test_albedo_and_light_are_compressed_picture_by_picture_and_nothing_else_is() -> None:
    errors = Errors(loss_function().conditioning, background=0.02)
    mask, clean = make_batch()["mask"], torch.zeros(4, 72, 16, 16)
    predicted = clean + torch.linspace(0.01, 0.5, 4)[:, None, None, None]
    terms = errors.attributes(predicted, clean, mask, floor=0.02)
    squares = [float(value) ** 2 for value in predicted[:, 0, 0, 0]]
    for name in ("albedo", "specular", "diffuse"):
        assert float(terms[name]) == pytest.approx(sum(0.02 * math.log1p(e / 0.02) for e in squares) / 4, rel=1e-4)
    plain = errors.attributes(predicted, clean, mask)
    for name in ("normal", "material", "environment"):
        assert float(terms[name]) == float(plain[name]) > 0.05
    floored, squared = (values(loss_function(colour_floor=floor), inverse()) for floor in (0.02, 0.0))
    assert floored["albedo"] < squared["albedo"]


def test_total_is_the_weighted_sum() -> None:
    loss = loss_function(albedo=3.0, cycle=2.0)
    loss.cycle_scale = 0.5
    terms = {"albedo": torch.tensor(0.2), "cycle": torch.tensor(0.4)}
    assert float(loss.total(terms)) == pytest.approx(3 * 0.2 + 2 * 0.5 * 0.4)


def test_any_timesteps_are_compared_where_they_are_noisy() -> None:
    """Rows of all four kinds, in no order (Algorithm 1): the terms are those of the rows that each concerns."""
    loss = loss_function(cycle=0.0, composite=1.0)
    batch = make_batch()
    t = Timesteps(torch.tensor([T, 0, 400, 0]), torch.tensor([5, 10, 0, 0]))
    found = values(loss, t, batch)
    assert set(found) == MAPS | {"image", "composite"}
    assert set(values(loss, Timesteps(t.image * 0, t.image * 0), batch)) == set()
    for kept, changed in ((MAPS | {"composite"}, 1), ({"image"}, 2), (MAPS | {"image", "composite"}, 3)):
        other = {name: value.clone() for name, value in batch.items()}
        for name in ("albedo", "image"):
            other[name][changed] = 1 - other[name][changed]
        again = values(loss, t, other)
        same = {name for name in found if again[name] == pytest.approx(found[name], rel=1e-6)}
        assert same & {"albedo", "image", "composite"} == kept & {"albedo", "image", "composite"}, changed


# --- cycle


def gradients(loss: LossFunction, term: str, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """By parameter; those that are not zero."""
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        terms = loss.terms(make_batch(), inverse(), generator())
    names, parameters = zip(*loss.model.named_parameters(), strict=True)
    found = torch.autograd.grad(terms[term], parameters, allow_unused=True)
    return {name: g for name, g in zip(names, found, strict=True) if g is not None and g.any()}


def test_cycle_gradient_into_the_renderer_is_a_switch() -> None:
    detached, attached = (gradients(loss_function(cycle_into_renderer=into), "cycle") for into in (False, True))
    decoder = "image_unet.up_blocks"
    assert any(name.startswith(decoder) for name in attached)
    assert not any(name.startswith(decoder) for name in detached)  # the inverse pass decodes attributes only
    # Both have the same gradient on weights that only the inverse pass uses: the attribute decoder's.
    for name in ("attribute_unet.conv_out.weight", "attribute_unet.up_blocks.0.resnets.0.conv1.weight"):
        torch.testing.assert_close(detached[name], attached[name], rtol=1e-4, atol=1e-7)


def test_cycle_value_is_the_rerendering_error_of_the_prediction() -> None:
    found = [values(loss_function(cycle_into_renderer=into), inverse())["cycle"] for into in (True, False)]
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_the_cycle_takes_its_gradient_at_the_scale_of_the_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """In float16 small ones would be 0 there, before the loss's own scale reaches them."""
    scales: list[float] = []

    def watched(loss: Tensor, inputs: list[Tensor], scale: float = 1.0) -> list[Tensor | None]:
        scales.append(scale)
        return loss_terms.gradients(loss, inputs, scale)

    monkeypatch.setattr(consistency_module, "gradients", watched)
    loss = loss_function(cycle_into_renderer=False)
    loss.scale = 64.0
    values(loss, inverse())
    assert scales == [64.0]


def test_a_gradient_taken_at_a_scale_is_that_of_the_loss() -> None:
    x, other = torch.tensor([1.0, -2.0], requires_grad=True), torch.zeros(2, requires_grad=True)
    found, none = loss_terms.gradients(x.square().sum(), [x, other], 64.0)
    assert found is not None
    assert found.tolist() == [2, -4]
    assert none is None


def test_cycle_can_be_off() -> None:
    assert "cycle" not in values(loss_function(cycle=0.0), inverse())
    assert "cycle" not in values(loss_function(cycle_share=0.0), inverse())
    assert "cycle" in values(loss_function(cycle_share=0.1), inverse())  # of few rows, too: it would never be seen
    waiting = loss_function()
    waiting.cycle_scale = 0.0
    assert "cycle" not in values(waiting, inverse())


def consistency(loss: LossFunction) -> Consistency:
    errors = Errors(loss.conditioning, loss.config.background)
    return Consistency(loss.model, loss.conditioning, loss.scheduler, loss.config, errors)


def test_the_cycle_asks_the_network_what_a_rendering_asks_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """From pure noise at T, of clean attributes that are all known (paper Eq. 5); the noise itself is made zero."""
    for module, name in ((consistency_module, "noise_like"), (inference, "draw_noise")):
        monkeypatch.setattr(module, name, lambda x, *others: torch.zeros(x if isinstance(x, tuple) else x.shape))
    loss, batch = loss_function(), make_batch()
    attributes = loss.conditioning.encode_attributes(batch)
    i_0, given = loss.conditioning.encode_image(batch["image"]), torch.ones(4, len(TRIPLETS), dtype=torch.bool)
    asked: list[dict[str, Tensor]] = []
    forward = loss.model.forward

    def record(**inputs: Any) -> DualStreamOutput:
        asked.append({name: x for name, x in inputs.items() if isinstance(x, Tensor)})
        return forward(**inputs)

    monkeypatch.setattr(loss.model, "forward", record)
    consistency(loss).cycle(attributes, i_0, batch["mask"], generator())
    maps = loss.conditioning.decode_attributes(attributes)
    inference.infer_image(loss.model, loss.conditioning, loss.scheduler, maps, given)
    in_training, in_use = asked
    assert len(in_training) == len(in_use) == 7  # both streams and their timesteps, the extras of both, the prior
    for name, x in in_training.items():
        torch.testing.assert_close(x.detach(), in_use[name], rtol=0, atol=1e-4)


def test_under_autocast_the_cycle_has_the_same_gradients() -> None:
    """Autocast keeps the casts of weights: one made without a gradient must not serve a pass that needs it."""
    plain, cast = (gradients(loss_function(), "cycle", dtype) for dtype in (torch.float32, torch.bfloat16))
    # The attention to one token of a prompt has none but of rounding, which bfloat16 may have at zero.
    size = {name: float(g.abs().max()) for name, g in plain.items()}
    plainly = {name for name, largest in size.items() if largest > 1e-6 * max(size.values())}
    assert len(plainly) > 0.9 * len(plain)
    assert plainly <= cast.keys() <= plain.keys()


class CountingCodec(KLCodec):
    """A small autoencoder that counts the pictures it decodes."""

    decoded = 0

    def decode(self, latents: Tensor) -> Tensor:
        self.decoded += len(latents)
        return super().decode(latents)


@pytest.mark.parametrize(("prior", "decoded"), [("none", 0), ("split_sum", 4 * 6)])
def test_the_cycle_decodes_maps_for_a_prior_only(prior: str, decoded: int) -> None:
    torch.manual_seed(0)
    sizes: Any = {
        "down_block_types": ("DownEncoderBlock2D",) * 2,
        "up_block_types": ("UpDecoderBlock2D",) * 2,
        "block_out_channels": (8, 8),
        "norm_num_groups": 4,
    }
    vae = AutoencoderKL(**sizes)
    codec = CountingCodec(vae)
    model, conditioning = build_model(dataclasses.replace(MODEL, codec="kl", physics_prior=prior), vae)
    conditioning = dataclasses.replace(conditioning, codec=codec)
    loss = LossFunction(model, conditioning, make_scheduler(), LossConfig(cycle_share=1.0))
    terms = loss.terms(make_batch(), inverse(), generator())
    assert codec.decoded == decoded
    torch.autograd.grad(terms["cycle"], model.attribute_unet.conv_out.weight)
    assert all(p.grad is None for p in vae.parameters())


# --- composite


def scene(prior: str) -> tuple[Consistency, dict[str, Tensor]]:
    """A scene whose image is the closed form of its maps."""
    each, batch = consistency(loss_function(prior=prior)), make_batch()
    closed_form = each.conditioning.physics_prior or PRIORS["split_sum"]
    maps = each.conditioning.decode_attributes(each.conditioning.encode_attributes(batch))
    return each, batch | {"image": closed_form.radiance(maps, Camera()) * batch["mask"]}


@pytest.mark.parametrize("prior", ["none", "composite", "split_sum"])
def test_true_maps_of_a_closed_form_scene_have_no_composite_error(prior: str) -> None:
    each, batch = scene(prior)
    true = each.conditioning.encode_attributes(batch)
    assert float(each.composite(true, batch["image"], batch["mask"])) < 1e-10
    for name in ("albedo", "metallic", "roughness", "specular", "diffuse", "normal"):
        other = each.conditioning.encode_attributes(batch | {name: make_batch(seed=5)[name]})
        error = float(each.composite(other, batch["image"], batch["mask"]))
        blind = prior == "composite" and name in ("roughness", "normal")
        assert (error > 1e-8) != blind, (name, error)


def test_the_composite_is_compared_as_the_cycle_would_be() -> None:
    """Its error is that of a network that renders the closed form, also where the object covers half of a pixel."""
    each, batch = scene("composite")
    mask = 0.5 * batch["mask"]
    true, other = (
        each.conditioning.encode_attributes(batch | {"mask": mask, "diffuse": k * batch["diffuse"]}) for k in (1, 0.5)
    )
    assert float(each.composite(true, 0.5 * batch["image"], mask)) < 1e-10
    prior = each.conditioning.physics_prior
    assert prior is not None
    shown = prior.radiance(each.conditioning.decode_attributes(other), Camera()) * mask
    rendered, seen = (each.conditioning.encode_image(image) for image in (shown, 0.5 * batch["image"]))
    expected = float(each.errors.image(rendered, seen, mask))
    assert float(each.composite(other, 0.5 * batch["image"], mask)) == pytest.approx(expected, rel=1e-4)
    assert expected > 1e-3


def test_composite_gradient_is_that_of_finite_differences() -> None:
    each, batch = scene("split_sum")
    true = each.conditioning.encode_attributes(batch).double()
    double = {name: value.double() for name, value in batch.items()}
    start = (0.6 * true).requires_grad_()  # inside every range: unpacking clips
    value = each.composite(start, double["image"], double["mask"])
    (gradient,) = torch.autograd.grad(value, start)
    for triplet in range(5):
        part = gradient[:, 12 * triplet : 12 * triplet + 12]
        assert part.abs().max() > 0, triplet
    assert not gradient[:, 60:].any()  # the light is not in the closed form
    direction = torch.randn(start.shape, generator=generator(), dtype=torch.float64)
    h = 1e-6
    moved = (start.detach() + sign * h * direction for sign in (1, -1))
    ahead, behind = (float(each.composite(x, double["image"], double["mask"])) for x in moved)
    expected = (ahead - behind) / (2 * h)
    found = float((gradient * direction).sum())
    assert found == pytest.approx(expected, rel=1e-4)
    assert 1.01 * found != pytest.approx(expected, rel=1e-4)


def test_composite_is_clipped_where_the_picture_is() -> None:
    """A picture at white says that the surface is at least that bright; a surface too bright is pulled back."""
    each, batch = scene("composite")
    bright = batch | {
        "diffuse": 3 * batch["diffuse"] + 2,
        "albedo": 0 * batch["albedo"] + 0.9,
        "metallic": 0 * batch["metallic"],
    }
    predicted = each.conditioning.encode_attributes(bright).requires_grad_()
    mask = batch["mask"]
    assert float(each.composite(predicted.detach(), 1.0 * mask.expand(-1, 3, -1, -1), mask)) == pytest.approx(
        0, abs=1e-9
    )
    error = each.composite(predicted, 0.5 * mask.expand(-1, 3, -1, -1), mask)
    (gradient,) = torch.autograd.grad(error, predicted)
    diffuse = gradient[:, 48:60]
    assert error > 0.1
    assert diffuse.min() == 0
    assert diffuse.max() > 0  # less light, less error


def test_composite_counts_inverse_rows_only_and_is_off_by_default() -> None:
    assert set(values(loss_function(composite=1.0, cycle=0.0), rendering())) == {"image"}
    assert "composite" in values(loss_function(composite=1.0, cycle=0.0), inverse())
    assert "composite" not in values(loss_function(cycle=0.0), inverse())
    reached = gradients(loss_function(composite=1.0), "composite")
    assert any(name.startswith("attribute_unet.up_blocks") for name in reached)
    assert not any(name.startswith("image_unet.up_blocks") for name in reached)


# --- any subset of maps


def test_dropped_maps_reach_the_network_as_noise_only() -> None:
    """With every droppable map withheld, the rendering does not depend on them: of a shape and its material alone."""
    assert set(TRIPLETS) - set(DROPPABLE) == {"normal", "material"}
    batch = make_batch()
    for changed in (DROPPABLE, ("normal",), ("roughness",)):
        other = batch | {name: make_batch(seed=9)[name] for name in changed}
        for dropout in (1.0, 0.0):
            loss = loss_function(dropout)
            errors = [values(loss, rendering(), b)["image"] for b in (batch, other)]
            blind = dropout == 1.0 and changed == DROPPABLE
            assert (errors[0] == pytest.approx(errors[1], rel=1e-6)) == blind, (dropout, changed)


def test_each_droppable_map_is_withheld_by_itself_at_the_rate_asked_for() -> None:
    n, rate = 4000, 0.3
    given = loss_function(rate)._draw_given(n, generator())
    share = (~given).double().mean(dim=0)
    for name, withheld in zip(TRIPLETS, share.tolist(), strict=True):
        expected = rate if name in DROPPABLE else 0.0
        assert abs(withheld - expected) <= 5 * (rate * (1 - rate) / n) ** 0.5 * (name in DROPPABLE), name
    columns = (~given)[:, [TRIPLETS.index(name) for name in DROPPABLE]].double().T
    off_diagonal = torch.corrcoef(columns) - torch.eye(len(DROPPABLE))
    assert off_diagonal.abs().max() < 5 / n**0.5


def test_inverse_rows_withhold_nothing() -> None:
    """What is asked for is noise there already, and no flag says that it is known."""
    assert values(loss_function(1.0), inverse())["albedo"] == values(loss_function(0.0), inverse())["albedo"]
