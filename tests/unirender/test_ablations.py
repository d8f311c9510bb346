"""The ablation rows of the presets: two networks instead of one, and a loss without its cycle."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_shards import write_dataset
from tiny_models import TRAIN, make_batch, make_model
from torch import Tensor, nn

from unirender.diffusion.schedule import make_scheduler
from unirender.diffusion.timesteps import Timesteps
from unirender.models.build import build_model
from unirender.models.config import ModelConfig
from unirender.models.dual_stream import DualStreamModel
from unirender.models.split_streams import SplitDualStreamModel
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.config import LossConfig, RunConfig
from unirender.training.data.source import ShardSource
from unirender.training.loop.export import export_pipeline
from unirender.training.loop.trainer import Trainer
from unirender.training.losses.loss_function import LossFunction
from unirender.training.presets import PRESETS

T = 999
CPU = torch.device("cpu")
SPLIT = dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, unified=False))


def split_model() -> SplitDualStreamModel:
    """A plain one with everything at random."""
    model, _ = make_model(unified=False, physics_prior="none")
    assert isinstance(model, SplitDualStreamModel)
    return model


def inputs(batch: int = 4) -> tuple[Tensor, ...]:
    """Of a plain model: latents of both streams and their timesteps, rendering rows first."""
    generator = torch.Generator().manual_seed(0)
    attributes, image = (torch.randn(batch, c, 16, 16, generator=generator) for c in (72, 12))
    extra = torch.randn(batch, 12, 16, 16, generator=generator)
    return attributes, image, torch.tensor([0, 0, T, 500]), torch.tensor([T, 300, 0, 0]), extra, extra


def size(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


def on_meta(config: ModelConfig) -> DualStreamModel:
    """A network without memory, to be counted."""
    with torch.device("meta"):
        return build_model(config)[0]


def test_both_networks_together_have_the_parameters_of_tiny() -> None:
    """Each half, within 3 %; and nothing that is counted is idle (see the gradients below)."""
    whole = size(on_meta(PRESETS["tiny"].model))
    split = on_meta(PRESETS["tiny_without_unified"].model)
    assert isinstance(split, SplitDualStreamModel)
    inverse = size(split.inverse)
    for each in (inverse, size(split) - inverse):
        assert abs(each / whole - 0.5) < 0.03 * 0.5, each / whole
    widths = dataclasses.replace(PRESETS["tiny"].model, unified=False)
    assert size(on_meta(widths)) > 1.3 * whole  # the twin: tiny's own widths


def test_the_ablations_change_one_thing_each() -> None:
    tiny = PRESETS["tiny"]
    assert dataclasses.replace(PRESETS["tiny_without_unified"], model=tiny.model) == tiny
    assert dataclasses.replace(PRESETS["tiny_without_cycle"], loss=tiny.loss) == tiny
    assert dataclasses.replace(PRESETS["tiny_without_cycle"].loss, cycle=tiny.loss.cycle) == tiny.loss
    assert PRESETS["tiny_without_cycle"].loss.cycle == 0


def test_no_weight_is_shared_and_none_is_idle() -> None:
    """Rendering rows move the one network, inverse rows the other; between them every weight."""
    model = split_model()
    loss = LossFunction(model, make_model(physics_prior="none")[1], make_scheduler(), LossConfig(cycle=0.0))
    t, zero = torch.full((4,), T), torch.zeros(4, dtype=torch.long)
    moved: list[set[str]] = []
    for timesteps in (Timesteps(zero, t), Timesteps(t, zero)):
        terms = loss.terms(make_batch(), timesteps, torch.Generator().manual_seed(0))
        names, weights = zip(*model.named_parameters(), strict=True)
        found = torch.autograd.grad(loss.total(terms), weights, allow_unused=True)
        moved.append({name for name, g in zip(names, found, strict=True) if g is not None})
    rendering, inverse = moved
    assert not rendering & inverse
    assert rendering | inverse == {name for name, _ in model.named_parameters()}
    assert all(name.startswith("inverse.") for name in inverse)
    assert not any(name.startswith("inverse.") for name in rendering)


def test_each_row_goes_to_the_network_of_its_direction() -> None:
    """What a mixed batch gives is what each network gives for its rows alone."""
    model, given = split_model(), inputs()
    with torch.no_grad():
        mixed = model(*given, attribute_rows=slice(2, None), image_rows=slice(0, 2))
        attributes = model.inverse(*(x[2:] for x in given), image_rows=None).attributes
        image = model(*(x[:2] for x in given), attribute_rows=None).image
        both = model(*given)
    assert torch.equal(mixed.attributes, attributes)
    assert torch.equal(mixed.image, image)
    torch.testing.assert_close(both.attributes[2:], attributes)  # a row that is asked for in both goes to both
    torch.testing.assert_close(both.image[:2], image)
    with torch.no_grad():
        for p in model.inverse.parameters():
            p.zero_()
        other = model(*given, attribute_rows=slice(2, None), image_rows=slice(0, 2))
    assert torch.equal(other.image, image)
    assert not torch.equal(other.attributes, attributes)


def test_each_network_is_a_dual_stream_network() -> None:
    """With the weights of a whole one each predicts what the whole one predicts in its direction."""
    whole, _ = make_model(physics_prior="none")
    split = split_model()
    weights = whole.state_dict()
    split.load_state_dict({name: weights[name.removeprefix("inverse.")] for name in split.state_dict()})
    with torch.no_grad():
        expected, found = whole(*inputs()), split(*inputs())
    assert torch.equal(found.attributes, expected.attributes)
    assert torch.equal(found.image, expected.image)


def test_the_first_render_of_a_split_model_is_the_prior() -> None:
    model, conditioning = build_model(SPLIT.model)
    batch = make_batch()
    given = torch.ones(4, 6, dtype=torch.bool)
    extras = conditioning.extras(batch["mask"], given, batch)
    attributes, image = conditioning.encode_attributes(batch), conditioning.encode_image(batch["image"])
    t = torch.full((4,), T)
    with torch.no_grad():
        output = model(attributes, image, 0 * t, t, extras.attributes, extras.image, extras.prior, attribute_rows=None)
    assert output.image is not None
    assert extras.prior is not None
    assert torch.equal(output.image, extras.prior)


def test_a_split_model_is_trained_saved_loaded_and_used(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", size=32)
    for steps in (1, 2):  # the second resumes
        trainer = Trainer(SPLIT, RunConfig(tmp_path / "run", steps=steps, picture_minutes=0.0), CPU, torch.float32)
        source = ShardSource(data, SPLIT.batch_size, SPLIT.seed)
        trainer.fit(source)
        source.close()
    assert trainer.step == 2
    folder = export_pipeline(trainer, tmp_path / "pipeline")
    index = json.loads((folder / "model_index.json").read_text())
    assert index["dual_stream"] == ["unirender.models.split_streams", "SplitDualStreamModel"]
    pipeline = UniRenderPipeline.from_pretrained(folder)
    assert type(pipeline.dual_stream) is SplitDualStreamModel
    assert set(pipeline.dual_stream.state_dict()) == set(trainer.model.state_dict())
    for name, average in trainer.ema.average.items():
        assert torch.equal(pipeline.dual_stream.get_parameter(name), average.half().float())
    image = np.random.default_rng(0).uniform(0, 1, (32, 32, 3)).astype(np.float32)
    found = pipeline.decompose(image).intrinsics
    rendered = pipeline.render(found)
    assert rendered.shape == (32, 32, 3)
    assert np.isfinite(rendered).all()


@pytest.mark.long
@pytest.mark.parametrize("rule", ["conditional", "algorithm1"])
def test_a_split_model_learns_under_either_rule(tmp_path: Path, rule: str) -> None:
    config = dataclasses.replace(SPLIT, timestep_rule=rule)
    trainer = Trainer(config, RunConfig(tmp_path, steps=30), CPU, torch.float32)
    batch = make_batch(4)
    steps = [trainer.train_step(batch) for _ in range(30)]
    sums = [losses["albedo"] for losses in steps if "albedo" in losses]  # of four rows perhaps none is inverse
    assert np.mean(sums[-10:]) < 0.8 * np.mean(sums[:10])
