"""A given light as tokens of an encoder of its own, instead of as the sixth attribute picture."""

import dataclasses
import functools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from synthetic_shards import sphere, write_dataset
from tiny_models import SIZE, TRAIN, make_batch, make_model
from torch import Tensor

from unirender.camera import Camera
from unirender.diffusion.inference import extras_by_camera, infer_attributes, infer_image
from unirender.diffusion.schedule import make_scheduler
from unirender.diffusion.timesteps import Timesteps
from unirender.models.build import build_model
from unirender.models.conditioning import LIGHT, Conditioning
from unirender.models.dual_stream import DualStreamModel, DualStreamOutput
from unirender.models.light_encoder import LightEncoder, pad_sphere
from unirender.models.packing import TRIPLETS
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import checkpoint_folder
from unirender.training.config import LossConfig, RunConfig
from unirender.training.export import export_pipeline
from unirender.training.losses import LossFunction
from unirender.training.presets import PRESETS
from unirender.training.source import ShardSource
from unirender.training.trainer import Trainer

T = 999
ENCODED = dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, light="encoder"))
BOTH = pytest.mark.parametrize("unified", [True, False], ids=["unified", "split"])


@functools.cache
def network(unified: bool = True, prior: str = "none") -> tuple[DualStreamModel, Conditioning]:
    """With everything at random."""
    return make_model(unified=unified, physics_prior=prior, light="encoder")


def given(*withheld: str, rows: int = 1) -> Tensor:
    return torch.tensor([[name not in withheld for name in TRIPLETS]]).expand(rows, -1)


def render(parts: tuple[DualStreamModel, Conditioning], maps: dict[str, Tensor], *withheld: str) -> Tensor:
    seed = torch.Generator().manual_seed(0)
    return infer_image(*parts, make_scheduler(), maps, given(*withheld, rows=len(maps["mask"])), generator=seed)


def other_light(maps: dict[str, Tensor]) -> dict[str, Tensor]:
    return maps | {"environment": make_batch(len(maps["mask"]), seed=7)["environment"]}


# --- the encoder


def test_the_grid_goes_on_round_the_sphere() -> None:
    """A function of direction, padded, is that function of the directions one texel further; zeros are not."""
    rows, columns = 16, 32

    def value(row: Tensor, column: Tensor) -> Tensor:
        theta, phi = math.pi * row[:, None] / (rows - 1), 2 * math.pi * (column + 0.5) / columns
        x, y, z = theta.sin() * phi.cos(), theta.cos() + 0 * phi, theta.sin() * phi.sin()
        return (x + 2 * x * y - 3 * z * y + z**2)[None, None]

    inside = value(torch.arange(rows), torch.arange(columns))
    beyond = value(torch.arange(-1, rows + 1), torch.arange(-1, columns + 1))
    torch.testing.assert_close(pad_sphere(inside), beyond, rtol=0, atol=1e-5)
    assert not torch.allclose(torch.nn.functional.pad(inside, (1, 1, 1, 1)), beyond, rtol=0, atol=0.1)


@torch.no_grad()
def test_features_turn_with_the_light_and_tokens_know_their_direction() -> None:
    torch.manual_seed(0)
    encoder = LightEncoder((16, 32), 8)
    encoder.last.weight.normal_()
    light = torch.randn(2, 4, 16, 32)
    features, turned = encoder.features(light), encoder.features(light.roll(4, dims=-1))
    assert features.shape[-2:] == (4, 8)
    torch.testing.assert_close(turned, features.roll(1, dims=-1), rtol=0, atol=1e-5)
    off_grid = encoder.features(light.roll(3, dims=-1))
    assert not torch.allclose(off_grid, features.roll(1, dims=-1), rtol=0, atol=1e-2)  # the twin
    tokens = encoder(light)
    assert tokens.shape == (2, 32, 8)
    even = encoder(torch.ones(1, 4, 16, 32))[0]
    assert float((even[1:] - even[:1]).abs().amax(dim=1).min()) > 1e-2  # one light everywhere, other tokens


def test_a_light_of_odd_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"light of \(6, 12\), expected multiples of 4"):
        LightEncoder((6, 12), 8)


@torch.no_grad()
def test_the_first_output_is_the_same_for_every_light() -> None:
    """And not that of the network without its tokens, which the class says."""
    torch.manual_seed(0)
    model, conditioning = build_model(ENCODED.model)
    model.eval()
    assert model.light_encoder is not None
    assert not model.light_encoder(torch.randn(2, 4, 16, 32)).any()
    maps = make_batch(1)
    image = render((model, conditioning), maps)
    assert torch.equal(image, render((model, conditioning), other_light(maps)))
    extras = conditioning.extras(maps["mask"], given(), maps)
    a, i = torch.randn(1, 72, 16, 16), torch.randn(1, 12, 16, 16)
    t = torch.zeros(1, dtype=torch.long)
    tokens = model(a, i, t, t, extras.attributes, extras.image, light=extras.light).attributes
    model.light_encoder = None
    none = model(a, i, t, t, extras.attributes, extras.image).attributes
    assert not torch.allclose(tokens, none, rtol=0, atol=1e-5)


# --- instead of the sixth picture


def test_extras_hold_the_packed_light_and_whether_it_is_given() -> None:
    _, conditioning = network()
    batch = make_batch(2)
    flags = torch.cat([given(), given("environment")])
    extras = conditioning.extras(batch["mask"], flags, batch)
    assert extras.light is not None
    sixth = conditioning.packing.pack(batch)[:, 15:]
    torch.testing.assert_close(extras.light[:1, :3], conditioning.packing.gather(sixth)[:1])
    assert (extras.light[0, 3] == 1).all()
    assert not extras.light[1].any()
    assert not extras.attributes[:, LIGHT].any()  # noise stands in its place, and no flag says otherwise
    assert extras.attributes[:, :LIGHT].all()
    inverse = conditioning.extras(batch["mask"], ~given(rows=2)).light
    assert inverse is not None
    assert not inverse.any()
    with pytest.raises(ValueError, match="the light is given, but maps is None"):
        conditioning.extras(batch["mask"], flags)
    _, latent = make_model(physics_prior="none")
    plain = latent.extras(batch["mask"], flags, batch)
    assert plain.light is None
    assert plain.attributes[0, LIGHT].all()  # the twin


def test_lights_of_rows_with_their_own_cameras() -> None:
    _, conditioning = network()
    batch, cameras = make_batch(2), [Camera(), Camera(fov_deg=60.0)]
    both = extras_by_camera(conditioning, batch["mask"], given(rows=2), batch, cameras)
    at_once = conditioning.extras(batch["mask"], given(rows=2), batch)
    assert both.light is not None
    assert at_once.light is not None
    assert torch.equal(both.light, at_once.light)


@BOTH
@pytest.mark.parametrize("prior", ["none", "split_sum"])
def test_a_given_light_is_seen_and_a_withheld_one_is_not(unified: bool, prior: str) -> None:
    parts, maps = network(unified, prior), make_batch(1)
    image = render(parts, maps)
    assert not torch.equal(render(parts, other_light(maps)), image)
    without = render(parts, maps, "environment")
    assert torch.equal(render(parts, other_light(maps), "environment"), without)
    broken = maps | {"environment": torch.full_like(maps["environment"], torch.nan)}
    assert torch.equal(render(parts, broken, "environment"), without)
    assert not torch.equal(without, image)


@BOTH
def test_a_light_is_seen_by_its_encoder_alone(unified: bool) -> None:
    """With silent tokens the picture does not depend on it: its latents are not there."""
    model, conditioning = make_model(unified=unified, physics_prior="none", light="encoder")
    maps = make_batch(1)
    assert model.light_encoder is not None
    with torch.no_grad():
        model.light_encoder.last.weight.zero_()
    image = render((model, conditioning), maps)
    assert torch.equal(render((model, conditioning), other_light(maps)), image)
    latent = make_model(unified=unified, physics_prior="none")
    assert not torch.equal(render(latent, other_light(maps)), render(latent, maps))  # the twin


@BOTH
def test_the_light_is_predicted_at_its_place(unified: bool) -> None:
    """Inverse rendering denoises all six pictures; no light is given there."""
    model, conditioning = network(unified)
    batch = make_batch(2)
    maps = infer_attributes(model, conditioning, make_scheduler(), batch["image"], batch["mask"])
    assert maps["environment"].shape == (2, 3, 16, 32)
    loss = LossFunction(model, conditioning, make_scheduler(), LossConfig(cycle=0.0))
    t = Timesteps(torch.full((2,), 300), torch.zeros(2, dtype=torch.long))
    terms = [loss.terms(b, t, torch.Generator().manual_seed(0)) for b in (batch, other_light(batch))]
    assert terms[0]["albedo"] != terms[1]["albedo"]  # at t = 300 what is left of the light in its latents is seen


def test_inputs_that_do_not_fit_the_network_are_refused() -> None:
    t = torch.zeros(1, dtype=torch.long)
    for (model, conditioning), light in ((network(), None), (make_model(), torch.zeros(1, 4, 16, 32))):
        a, i = torch.zeros(1, 72, 16, 16), torch.zeros(1, 12, 16, 16)
        extra_a, extra_i = (torch.zeros(1, c, 16, 16) for c in conditioning.extra_channels)
        with pytest.raises(ValueError, match=r"light (missing|given), but the model was built otherwise"):
            model(a, i, t, t, extra_a, extra_i, light=light)


# --- training


def encoder_gradients(loss: LossFunction, term: str, inverse: bool) -> dict[str, float]:
    """Largest gradient of a loss term with respect to each weight of the renderer's encoder; {}: none is reached."""
    noisy, clean = torch.full((4,), T), torch.zeros(4, dtype=torch.long)
    t = Timesteps(noisy, clean) if inverse else Timesteps(clean, noisy)
    value = loss.terms(make_batch(), t, torch.Generator().manual_seed(0))[term]
    assert loss.model.light_encoder is not None
    names, weights = zip(*loss.model.light_encoder.named_parameters(), strict=True)
    found = torch.autograd.grad(value, weights, allow_unused=True)
    return {name: float(g.abs().max()) for name, g in zip(names, found, strict=True) if g is not None}


@BOTH
@pytest.mark.parametrize("prior", ["none", "split_sum"])
def test_gradients_reach_the_encoder(unified: bool, prior: str) -> None:
    """From rendering rows, and from the cycle where it may train the renderer."""
    parts = network(unified, prior)
    assert parts[0].light_encoder is not None
    names = {name for name, _ in parts[0].light_encoder.named_parameters()}
    through = LossFunction(*parts, make_scheduler(), LossConfig(cycle_share=1.0, cycle_into_renderer=True))
    for found in (encoder_gradients(through, "image", False), encoder_gradients(through, "cycle", True)):
        assert found.keys() == names
        assert all(value > 0 for value in found.values()), found
    detached = dataclasses.replace(through, config=LossConfig(cycle_share=1.0, cycle_into_renderer=False))
    reached = encoder_gradients(detached, "cycle", True)
    assert "first.weight" not in reached or (unified and reached["first.weight"] == 0)


@pytest.mark.parametrize("prior", ["none", "split_sum"])
def test_in_the_cycle_the_predicted_light_is_seen_by_its_encoder(prior: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its tokens are made of the predicted latents, with a gradient; the latents themselves are noise."""
    model, conditioning = network(True, prior)
    loss = LossFunction(model, conditioning, make_scheduler(), LossConfig(cycle_share=1.0))
    seen: list[dict[str, Any]] = []
    forward = model.forward

    def watched(attributes: Tensor, *args: Any, **kwargs: Any) -> DualStreamOutput:
        output = forward(attributes, *args, **kwargs)
        seen.append({"latents": attributes, "light": kwargs["light"], "predicted": output.attributes})
        return output

    monkeypatch.setattr(model, "forward", watched)
    t = Timesteps(torch.full((2,), T), torch.zeros(2, dtype=torch.long))
    loss.terms(make_batch(2), t, torch.Generator().manual_seed(0))
    first, again = seen
    assert not first["light"].any()
    predicted = first["predicted"]
    expected = conditioning.packing.pack_light(conditioning.decode_attributes(predicted)["environment"])
    torch.testing.assert_close(again["light"][:, :3], expected)
    assert (again["light"][:, 3] == 1).all()
    (gradient,) = torch.autograd.grad(again["light"].sum(), predicted, retain_graph=True)
    place = slice(12 * LIGHT, 12 * LIGHT + 12)
    assert gradient[:, place].any()
    assert not gradient[:, : 12 * LIGHT].any()
    assert torch.equal(again["latents"][:, : 12 * LIGHT], predicted[:, : 12 * LIGHT])
    assert not torch.isclose(again["latents"][:, place], predicted[:, place]).any(dim=1).all()
    (none,) = torch.autograd.grad(again["latents"][:, place].sum(), predicted)
    assert not none.any()


@BOTH
def test_after_a_few_steps_the_render_depends_on_the_light(unified: bool, tmp_path: Path) -> None:
    """From the start at zero, by training alone."""
    config = dataclasses.replace(ENCODED, model=dataclasses.replace(ENCODED.model, unified=unified))
    trainer = Trainer(config, RunConfig(tmp_path, steps=4), torch.device("cpu"), torch.float32)
    batch, parts = make_batch(4), (trainer.model, trainer.loss.conditioning)
    assert torch.equal(render(parts, batch), render(parts, other_light(batch)))
    for _ in range(4):
        assert np.isfinite(trainer.train_step(batch)["image"])
    assert not torch.equal(render(parts, batch), render(parts, other_light(batch)))
    withheld = render(parts, batch, "environment")
    assert torch.equal(withheld, render(parts, other_light(batch), "environment"))


def test_trained_saved_loaded_and_used(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", size=SIZE)
    trainer = Trainer(
        ENCODED, RunConfig(tmp_path / "run", steps=1, picture_minutes=0.0), torch.device("cpu"), torch.float32
    )
    source = ShardSource(data, ENCODED.batch_size, ENCODED.seed)
    trainer.fit(source)
    source.close()
    pipeline = UniRenderPipeline.from_pretrained(export_pipeline(trainer, tmp_path / "pipeline", torch.float32))
    assert type(pipeline.dual_stream) is DualStreamModel
    assert pipeline.dual_stream.config["light"] == "encoder"
    assert pipeline.conditioning.light_encoder
    for name, average in trainer.ema.average.items():
        assert torch.equal(pipeline.dual_stream.get_parameter(name), average), name
    with torch.no_grad():
        assert pipeline.dual_stream.light_encoder is not None
        pipeline.dual_stream.light_encoder.last.weight.normal_()
    rng = np.random.default_rng(0)
    shape = sphere(SIZE, rng)
    mask = shape.require("mask")["mask"]
    light = rng.uniform(0, 2, (16, 32, 3)).astype(np.float32)
    scene = shape.replace(roughness=0.4 * mask, metallic=0.3 * mask, environment=light)
    scene = scene.replace(specular=0.5 * mask.repeat(3, axis=-1), diffuse=mask.repeat(3, axis=-1))
    first, second = (pipeline.render(s) for s in (scene, scene.replace(environment=light[::-1].copy())))
    assert np.isfinite(first).all()
    assert not np.array_equal(first, second)
    assert pipeline.decompose(first).intrinsics.require("environment")["environment"].shape == (16, 32, 3)


def test_the_preset_changes_one_thing_and_hardly_the_size() -> None:
    tiny, encoder = PRESETS["tiny"], PRESETS["tiny_light_encoder"]
    assert encoder.model.light == "encoder"
    assert dataclasses.replace(encoder, model=tiny.model) == tiny
    assert dataclasses.replace(encoder.model, light="latent") == tiny.model
    with torch.device("meta"):
        sizes = [sum(p.numel() for p in build_model(c.model)[0].parameters()) for c in (tiny, encoder)]
    assert 1 < sizes[1] / sizes[0] < 1.01


def test_one_training_step_of_the_preset(tmp_path: Path) -> None:
    config = dataclasses.replace(PRESETS["tiny_light_encoder"], batch_size=3)
    trainer = Trainer(config, RunConfig(tmp_path, steps=1), torch.device("cpu"), torch.float32)
    terms = trainer.train_step(make_batch(3, size=64))
    assert np.isfinite(list(terms.values())).all()
    assert trainer.model.light_encoder is not None
    assert trainer.model.light_encoder.last.weight.any()


def test_a_checkpoint_without_the_entry_has_the_light_as_latents(tmp_path: Path) -> None:
    """Checkpoints may be older than the option."""
    shutil.copytree(checkpoint_folder(), tmp_path / "older")
    path = tmp_path / "older" / "dual_stream" / "config.json"
    config = json.loads(path.read_text())
    del config["light"]
    path.write_text(json.dumps(config))
    pipeline = UniRenderPipeline.from_pretrained(tmp_path / "older")
    assert pipeline.dual_stream.config["light"] == "latent"
    assert pipeline.dual_stream.light_encoder is None
    assert not pipeline.conditioning.light_encoder
