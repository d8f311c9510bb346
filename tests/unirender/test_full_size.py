"""The network at Stable Diffusion's full size, with random weights: 7 GB of them. Run by `make test-large` only."""

import dataclasses
import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from torch import Tensor

from unirender.models.build import build_model
from unirender.models.dual_stream import DualStreamModel
from unirender.training.optim.memory import readable, training_bytes
from unirender.training.presets import PRESETS
from unirender.training.start.stable_diffusion import StableDiffusion

pytestmark = pytest.mark.large

RESOLUTION, LATENT = 64, 8
MOST_BYTES = 20 * 2**30


def peak_bytes() -> int:
    """The most memory that this process has had."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def stable_diffusion() -> StableDiffusion:
    """Stable Diffusion 1.5 but for what its weights are."""
    torch.manual_seed(0)
    unet = UNet2DConditionModel(cross_attention_dim=768).eval().requires_grad_(False)
    settings: dict[str, Any] = {  # diffusers annotates these as tuples of one
        "down_block_types": ("DownEncoderBlock2D",) * 4,
        "up_block_types": ("UpDecoderBlock2D",) * 4,
        "block_out_channels": (128, 256, 512, 512),
    }
    vae = AutoencoderKL(**settings, layers_per_block=2).eval().requires_grad_(False)
    return StableDiffusion(Path("full size"), unet, vae, torch.randn(1, 77, 768))


def inputs(model: DualStreamModel) -> tuple[Tensor, ...]:
    """Latents of one sample, the same in all six attributes, with the extra inputs of both streams."""
    generator = torch.Generator().manual_seed(1)
    image = torch.randn(1, 4, LATENT, LATENT, generator=generator)
    extras = [
        torch.randn(1, model.config[f"{name}_extra_channels"], LATENT, LATENT, generator=generator)
        for name in ("attribute", "image")
    ]
    return image.repeat(1, 6, 1, 1), image, torch.tensor([700]), torch.tensor([30]), *extras


@dataclass(frozen=True)
class Started:
    """A network that begins with Stable Diffusion's weights, and what Stable Diffusion makes of the `inputs`."""

    model: DualStreamModel
    attributes: Tensor
    image: Tensor


@pytest.fixture(scope="module")
@torch.no_grad()
def started() -> Started:
    """As in a training, Stable Diffusion's own U-Net is gone once its weights are copied."""
    diffusion = stable_diffusion()
    config = dataclasses.replace(PRESETS["sd15"].model, resolution=RESOLUTION)
    model, _ = build_model(config, diffusion.vae)
    diffusion.initialise(model)
    _, image, t_attributes, t_image, *_ = inputs(model)
    attributes, image = (diffusion.unet(image, t, diffusion.prompt_embedding).sample for t in (t_attributes, t_image))
    return Started(model, attributes.repeat(1, 6, 1, 1), image)


@torch.no_grad()
def test_first_pass_is_stable_diffusions(started: Started) -> None:
    """Also in float32 rounding, which 860 million weights could have let grow."""
    out = started.model(*inputs(started.model))
    assert started.image.std() > 0.01
    assert (started.image - started.attributes[:, :4]).abs().max() > 1e-3  # another timestep is told apart
    torch.testing.assert_close(out.attributes, started.attributes, rtol=0, atol=1e-4)
    torch.testing.assert_close(out.image, started.image, rtol=0, atol=1e-4)


def test_shapes_and_number_of_weights(started: Started) -> None:
    model = started.model
    streams = [model.image_unet, model.attribute_unet]
    held = training_bytes(model)
    connections = model.num_parameters() - sum(unet.num_parameters() for unet in streams)
    print(f"\n{model.num_parameters() / 1e6:.1f} M weights, {connections / 1e6:.1f} M between the streams; {held}")
    assert [unet.num_parameters() for unet in streams] == [859_520_964, 859_520_964 + 20 * (320 * 9 * 2 + 1)]
    assert 22e6 < connections < 25e6
    assert held.moments == 2 * sum(p.nbytes for p in model.parameters())
    assert model.config["sample_size"] == LATENT


def test_forward_and_backward_fit_into_memory(started: Started) -> None:
    """float32 weights and gradients, bfloat16 autocast, activations computed again."""
    model = started.model
    model.train().enable_gradient_checkpointing()
    with torch.autocast("cpu", torch.bfloat16):
        out = model(*inputs(model))
        loss = out.attributes.float().square().mean() + out.image.float().square().mean()
    assert out.attributes.dtype == torch.bfloat16
    assert out.attributes.shape == (1, 24, LATENT, LATENT)
    assert out.image.shape == (1, 4, LATENT, LATENT)
    loss.backward()
    peak = peak_bytes()
    print(f"\npeak memory of forward and backward: {readable(peak)}")
    gradients = {name: p.grad for name, p in model.named_parameters()}
    assert not [name for name, g in gradients.items() if g is None or g.dtype != torch.float32]
    assert not [name for name, g in gradients.items() if g is not None and not torch.isfinite(g).all()]
    for bridge in ("attributes_to_image", "image_to_attributes"):  # at zero, and yet they learn
        first = gradients[f"{bridge}.0.weight"]
        assert first is not None
        assert first.abs().max() > 0
    assert 2 * sum(p.nbytes for p in model.parameters()) < peak < MOST_BYTES
