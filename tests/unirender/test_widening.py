"""Wider networks that begin near a narrower one."""

import dataclasses
from pathlib import Path

import pytest
import torch
from both_directions import decompose, render
from tiny_models import MODEL, TRAIN, make_batch, make_model

from unirender.errors import UnirenderError
from unirender.training.config import RunConfig
from unirender.training.loop.trainer import Trainer
from unirender.training.presets import PRESETS
from unirender.training.start.weights import begin_with_network, read_start
from unirender.training.start.widening import Channels, can_widen, repeated, widen, widened

NARROW = {"block_out_channels": (16, 32, 32), "attention_levels": (2,), "norm_num_groups": 8}
WIDE = {"block_out_channels": (16, 48, 64), "attention_levels": (1, 2)}


def test_channels_stay_in_their_normalisation_group() -> None:
    grown = repeated(8, 12, 4)
    assert grown.source.tolist() == [0, 1, 0, 2, 3, 2, 4, 5, 4, 6, 7, 6]
    assert grown.old.tolist() == [True, True, False] * 4
    both = grown + Channels(torch.arange(2), torch.ones(2, dtype=torch.bool))
    assert both.source.tolist()[-2:] == [8, 9]
    assert repeated(8, 8, 4).source.tolist() == list(range(8))


def test_a_network_as_wide_becomes_the_other_but_for_attention_that_does_nothing() -> None:
    other, conditioning = make_model(**NARROW)
    network = widened(dataclasses.replace(MODEL, **NARROW | {"attention_levels": (1, 2)}), other).eval()
    maps = make_batch(2)
    for look in (decompose, render):
        torch.testing.assert_close(look((network, conditioning), maps), look((other, conditioning), maps))


def test_a_wider_network_answers_nearly_the_same() -> None:
    """Far nearer than one that begins by chance; every new channel has a gradient."""
    other, conditioning = make_model(**NARROW)
    config = dataclasses.replace(MODEL, **NARROW | WIDE)
    network, chance = widened(config, other).eval(), make_model(seed=5, **NARROW | WIDE)[0]
    maps = make_batch(2)
    for look in (decompose, render):
        before = look((other, conditioning), maps)
        near, far = ((look((each, conditioning), maps) - before).square().mean() for each in (network, chance))
        assert near < 0.1 * far
        assert near < 0.3 * before.var()
    latents = (
        torch.randn(1, network.config["attribute_channels"], 8, 8),
        torch.randn(1, network.config["image_channels"], 8, 8),
    )
    extras = [torch.randn(1, count, 8, 8) for count in conditioning.extra_channels]
    network(*latents, torch.tensor([999]), torch.tensor([0]), *extras, image_rows=None).attributes.sum().backward()
    weight = network.get_parameter("attribute_unet.down_blocks.1.resnets.0.conv1.weight")
    assert weight.grad is not None
    assert (weight.grad.abs().sum(dim=(1, 2, 3)) > 0).all()


@pytest.mark.parametrize("block", ["down_blocks.1.resnets.0", "down_blocks.2.resnets.0", "mid_block.resnets.0"])
def test_the_old_channels_of_a_block_go_on_alone(block: str) -> None:
    """Of an encoder's residual blocks, whose groups grow alike; by the wrong channels, the twin, all is lost."""
    other, groups = make_model(**NARROW)[0], 8
    network = widened(dataclasses.replace(MODEL, **NARROW | WIDE), other).eval()
    own, old = (model.get_submodule(f"image_unet.{block}") for model in (network, other))
    norms = [[len(resnet.get_parameter(f"norm{n}.weight")) for resnet in (old, own)] for n in (1, 2)]
    entering, leaving = (repeated(before, after, groups) for before, after in norms)
    x, time = torch.randn(2, entering.before, 8, 8), torch.randn(2, 64)
    with torch.no_grad():
        expected, made = old(x, time), own(x[:, entering.source], time)
    wrong = made[:, : expected.shape[1]] if len(leaving.source) > expected.shape[1] else expected.flip(1)
    assert (made[:, leaving.old] - expected).square().mean() < 0.1 * expected.var()
    assert (wrong - expected).square().mean() > 0.5 * expected.var()


def test_a_run_begins_with_a_narrower_network(tmp_path: Path) -> None:
    config = dataclasses.replace(TRAIN, model=dataclasses.replace(MODEL, **NARROW | WIDE))
    run = Trainer(config, RunConfig(tmp_path, steps=1), torch.device("cpu"), torch.float32)
    other, _ = make_model(**NARROW)
    begin_with_network(run, other)
    expected = widened(config.model, other).state_dict()  # attention that is new has weights of chance
    for held in (run.model.state_dict(), run.ema.average):
        for name in other.state_dict().keys() & held.keys():
            assert torch.equal(held[name], expected[name]), name


def test_the_preset_of_small_begins_with_the_checkpoint_tiny(tmp_path: Path) -> None:
    config = dataclasses.replace(PRESETS["small_wide"], batch_size=2)
    run = Trainer(config, RunConfig(tmp_path, steps=1), torch.device("cpu"), torch.float32)
    start = read_start(config.model, Path("tiny"))
    assert start.pipeline is not None
    start.apply(run)
    key = "attribute_unet.conv_in.weight"
    assert torch.equal(run.model.state_dict()[key], start.pipeline.dual_stream.state_dict()[key])


@pytest.mark.parametrize(
    "changes",
    [
        {"block_out_channels": (16, 24, 32)},
        {"block_out_channels": (32, 48, 64)},
        {"attention_levels": (1,)},
        {"cross_attention_dim": 16},
        {"layers_per_block": 2},
        {"block_out_channels": (16, 48, 48), "narrow": (16, 32, 48)},  # a trained shortcut would be left over
    ],
    ids=str,
)
def test_other_networks_are_refused(changes: dict) -> None:
    changes = dict(changes)
    narrow = NARROW | {"block_out_channels": changes.pop("narrow", NARROW["block_out_channels"])}
    other, network = make_model(**narrow)[0], make_model(**NARROW | changes)[0]
    assert not can_widen(network, other)
    with pytest.raises(UnirenderError, match="no wider form of theirs"):
        widen(network, other)
