"""The dual-stream network: two independent U-Nets at step 0, cross connections afterwards."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers.models.attention import BasicTransformerBlock
from diffusers.models.resnet import ResnetBlock2D
from diffusers.models.unets.unet_2d_blocks import CrossAttnDownBlock2D, UNetMidBlock2DCrossAttn
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from tiny_models import make_model
from torch import Tensor

from unirender.models.build import build_model
from unirender.models.dual_stream import DualStreamModel, Encoded
from unirender.models.unet import pyramid_channels
from unirender.training.presets import PRESETS


def small(**changes: Any) -> DualStreamModel:
    torch.manual_seed(0)
    settings = {
        "attribute_channels": 24,
        "image_channels": 4,
        "block_out_channels": (16, 32, 32),
        "attention_levels": (1, 2),
        "attention_head_dim": 16,
        "cross_attention_dim": 8,
        "prompt_tokens": 3,
        "norm_num_groups": 8,
    }
    return DualStreamModel(**(settings | changes)).eval()


def inputs(model: DualStreamModel, batch: int = 3, size: int = 16) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    a = torch.randn(batch, model.config["attribute_channels"], size, size, generator=generator)
    i = torch.randn(batch, model.config["image_channels"], size, size, generator=generator)
    return a, i, torch.tensor([0, 5, 999])[:batch], torch.tensor([700, 0, 0])[:batch]


def independent(model: DualStreamModel, unet: UNet2DConditionModel, x: Tensor, t: Tensor) -> Tensor:
    return unet(x, t, model.prompt_embedding.expand(len(x), -1, -1)).sample


@torch.no_grad()
def test_step_zero_equals_two_independent_unets() -> None:
    model = small(attribute_extra_channels=5, image_extra_channels=7)
    a, i, t_a, t_i = inputs(model)
    out = model(a, i, t_a, t_i, torch.randn(3, 5, 16, 16), torch.randn(3, 7, 16, 16))
    torch.testing.assert_close(out.attributes, independent(model, model.attribute_unet, a, t_a), rtol=0, atol=1e-5)
    torch.testing.assert_close(out.image, independent(model, model.image_unet, i, t_i), rtol=0, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("bridge", ["attributes_to_image", "image_to_attributes"])
@pytest.mark.parametrize("level", [0, -1])
def test_each_bridge_reaches_the_other_stream_only(bridge: str, level: int) -> None:
    """The failing twin of the test above: one zero convolution made non-zero changes exactly one output."""
    model = small()
    getattr(model, bridge)[level].weight.fill_(0.1)
    a, i, t_a, t_i = inputs(model)
    out = model(a, i, t_a, t_i)
    same_a = torch.allclose(out.attributes, independent(model, model.attribute_unet, a, t_a), rtol=0, atol=1e-5)
    same_i = torch.allclose(out.image, independent(model, model.image_unet, i, t_i), rtol=0, atol=1e-5)
    assert (same_a, same_i) == ((True, False) if bridge == "attributes_to_image" else (False, True))


@torch.no_grad()
def test_exchange_happens_before_fusion() -> None:
    """What crosses over is the other encoder's own feature, not one that already carries this stream back."""
    model = small()
    for bridge in (model.attributes_to_image, model.image_to_attributes):
        for p in bridge.parameters():
            p.normal_(0, 0.1, generator=torch.Generator().manual_seed(3))
    a, i, t_a, t_i = inputs(model)
    e_a = model.encode(model.attribute_unet, a, t_a, None, None)
    e_i = model.encode(model.image_unet, i, t_i, None, None)
    assert [f.shape[1] for f in e_a.features] == pyramid_channels(model.attribute_unet)
    fused = [
        mine + conv(theirs)
        for mine, theirs, conv in zip(e_a.features, e_i.features, model.image_to_attributes, strict=True)
    ]
    # diffusers' own decoder on hand-fused features
    skips = [f - g for f, g in zip(fused, e_a.features, strict=True)]
    expected = model.attribute_unet(
        a,
        t_a,
        model.prompt_embedding.expand(3, -1, -1),
        down_block_additional_residuals=tuple(skips[:-1]),
        mid_block_additional_residual=skips[-1],
    ).sample
    torch.testing.assert_close(model(a, i, t_a, t_i).attributes, expected, rtol=0, atol=1e-4)


@torch.no_grad()
def test_rows_are_decoded_where_asked_for() -> None:
    model, conditioning = make_model()
    extra_a, extra_i = (torch.randn(4, c, 16, 16) for c in conditioning.extra_channels)
    a, i = torch.randn(4, 72, 16, 16), torch.randn(4, 12, 16, 16)
    t = torch.tensor([0, 0, 999, 999])
    prior = torch.randn_like(i)
    whole = model(a, i, t, t.flip(0), extra_a, extra_i, image_prior=prior)
    part = model(a, i, t, t.flip(0), extra_a, extra_i, prior, attribute_rows=slice(1, 4), image_rows=slice(0, 2))
    torch.testing.assert_close(part.attributes, whole.attributes[1:], rtol=0, atol=1e-5)
    torch.testing.assert_close(part.image, whole.image[:2], rtol=0, atol=1e-5)
    assert model(a, i, t, t, extra_a, extra_i, image_rows=None).image is None


@torch.no_grad()
@pytest.mark.parametrize("unified", [True, False])
def test_an_output_is_a_mapping_of_what_was_predicted(unified: bool) -> None:
    """As diffusers has it, for whom an output without entries is empty."""
    model, _ = make_model(unified=unified, physics_prior="none")
    extra, t = torch.zeros(2, 12, 16, 16), torch.tensor([500, 0])
    out = model(torch.zeros(2, 72, 16, 16), torch.zeros(2, 12, 16, 16), t, t.flip(0), extra, extra, image_rows=None)
    assert list(out.keys()) == ["attributes", "encoded_image"]
    assert out[0] is out.attributes


@torch.no_grad()
@pytest.mark.parametrize("unified", [True, False])
def test_what_was_encoded_stands_for_its_rows_in_another_call(unified: bool) -> None:
    model, _ = make_model(unified=unified, physics_prior="none")
    generator = torch.Generator().manual_seed(0)
    a, i = (torch.randn(3, c, 16, 16, generator=generator) for c in (72, 12))
    extra, t, clean = torch.zeros(3, 12, 16, 16), torch.full((3,), 500), torch.zeros(3, dtype=torch.long)
    first = model(a, i, t, clean, extra, extra, attribute_rows=slice(1, None), image_rows=None)
    assert first.encoded_attributes is None
    assert first.encoded_image.features[-1].shape[0] == 2
    given = a[1:], t[1:], clean[1:], extra[1:]

    def again(condition: Tensor | Encoded) -> Tensor:
        return model(given[0], condition, *given[1:], extra[1:], image_rows=None).attributes

    # not to the bit: some processors have another kernel for two rows than for two of three
    torch.testing.assert_close(again(first.encoded_image), again(i[1:]), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(again(first.encoded_image), first.attributes)
    assert not torch.allclose(again(i[:2]), again(i[1:]), rtol=1e-2)  # the twin


@torch.no_grad()
def test_other_resolutions_and_odd_sizes() -> None:
    model = small()
    _, _, t_a, t_i = inputs(model)
    out = model(torch.randn(3, 24, 18, 22), torch.randn(3, 4, 18, 22), t_a, t_i)
    assert out.attributes.shape == (3, 24, 18, 22)
    assert out.image.shape == (3, 4, 18, 22)


@pytest.mark.parametrize("levels", [(), (0, 1, 2), (2,)])
def test_the_mid_block_attends_over_all_pixels_at_any_rate(levels: tuple[int, ...]) -> None:
    """The light is not aligned with the picture's pixels and reaches them all there."""
    model = small(attention_levels=levels)
    for unet in (model.attribute_unet, model.image_unet):
        assert isinstance(unet.mid_block, UNetMidBlock2DCrossAttn)
        (block,) = [m for m in unet.mid_block.modules() if isinstance(m, BasicTransformerBlock)]
        assert not block.attn1.is_cross_attention  # among pixels
        assert block.attn2 is not None  # the prompt's
        found = [n for n, b in enumerate(unet.down_blocks) if isinstance(b, CrossAttnDownBlock2D)]
        assert found == list(levels)


def test_levels_that_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match=r"attention_levels \(1, 3\): expected levels from 0, the finest, to 2"):
        small(attention_levels=(1, 3))
    with pytest.raises(ValueError, match="must be multiples of head size 12"):
        small(attention_levels=(), attention_head_dim=12)


def test_linear_projection_changes_layers_and_not_their_number_of_weights() -> None:
    convolution, linear = small(), small(linear_projection=True)
    name = "image_unet.mid_block.attentions.0.proj_in.weight"
    assert [m.state_dict()[name].dim() for m in (convolution, linear)] == [4, 2]
    assert convolution.num_parameters() == linear.num_parameters()


def test_missing_extra_inputs_are_refused() -> None:
    model, _ = make_model()
    t = torch.zeros(1, dtype=torch.long)
    with pytest.raises(ValueError, match="extra inputs missing"):
        model(torch.zeros(1, 72, 16, 16), torch.zeros(1, 12, 16, 16), t, t)


def test_save_and_load(tmp_path: Path) -> None:
    model, _ = make_model()
    model.save_pretrained(tmp_path)
    assert [p.name for p in tmp_path.glob("*.safetensors")]
    assert not list(tmp_path.glob("*.bin"))
    loaded = DualStreamModel.from_pretrained(tmp_path)
    assert dict(loaded.config)["hdr_curves"] == {name: list(v) for name, v in model.config["hdr_curves"].items()}
    for (name, p), (_, q) in zip(model.state_dict().items(), loaded.state_dict().items(), strict=True):
        assert torch.equal(p, q), name


def test_shipped_preset_fits_the_wheel() -> None:
    model, _ = build_model(PRESETS["tiny"].model)
    assert 2 * sum(p.numel() for p in model.parameters()) < 24e6  # bytes in fp16


def test_gradient_checkpointing_changes_nothing() -> None:
    model = small().train()
    a, i, t_a, t_i = inputs(model)

    def gradients() -> list[Tensor]:
        model.zero_grad()
        out = model(a, i, t_a, t_i)
        (out.attributes.square().mean() + out.image.square().mean()).backward()
        return [p.grad.clone() for p in model.parameters() if p.grad is not None]

    calls: Counter[str] = Counter()
    for name, module in model.named_modules():
        if isinstance(module, ResnetBlock2D | BasicTransformerBlock) and not name.endswith("mid_block.resnets.0"):
            module.register_forward_pre_hook(lambda *_, name=name: calls.update([name]))

    plain = gradients()
    assert set(calls.values()) == {1}
    calls.clear()
    model.enable_gradient_checkpointing()
    for g, h in zip(plain, gradients(), strict=True):
        torch.testing.assert_close(g, h, rtol=1e-4, atol=1e-6)
    # every block of both streams is computed again on the way back, but for the one that diffusers leaves out
    assert set(calls.values()) == {2}
    assert {name.split(".")[0] for name in calls} == {"attribute_unet", "image_unet"}
