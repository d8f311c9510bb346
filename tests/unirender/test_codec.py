"""Latent codecs behind one interface."""

from typing import Any

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL

from unirender.errors import UnirenderError
from unirender.models.codec import KLCodec, PixelCodec, make_codec


def tiny_vae() -> AutoencoderKL:
    torch.manual_seed(0)
    settings: dict[str, Any] = {  # diffusers annotates these as tuples of one
        "down_block_types": ("DownEncoderBlock2D",) * 2,
        "up_block_types": ("UpDecoderBlock2D",) * 2,
        "block_out_channels": (8, 8),
    }
    return AutoencoderKL(**settings, norm_num_groups=4, latent_channels=4, scaling_factor=0.18215)


@pytest.mark.parametrize("patch", [1, 2, 4])
def test_pixel_codec_is_lossless(patch: int) -> None:
    codec = PixelCodec(patch)
    picture = torch.randn(2, 3, 16, 24)
    latents = codec.encode(picture)
    assert latents.shape == (2, codec.channels, 16 // patch, 24 // patch)
    assert torch.equal(codec.decode(latents), picture)
    assert latents.square().sum() == pytest.approx(float(picture.square().sum()), rel=1e-6)


def test_pixel_weights_follow_their_pixels() -> None:
    codec = PixelCodec(2)
    error, mask = torch.rand(2, 3, 8, 8), torch.rand(2, 1, 8, 8)
    in_latents = (codec.encode(error) * codec.weights(mask)).sum()
    assert float(in_latents) == pytest.approx(float((error * mask).sum()), rel=1e-5)


@torch.no_grad()
def test_kl_codec_scales_the_posterior_mode() -> None:
    vae = tiny_vae()
    codec = KLCodec(vae)
    picture = torch.rand(2, 3, 16, 16) * 2 - 1
    latents = codec.encode(picture)
    assert (codec.factor, codec.channels) == (2, 4)
    torch.testing.assert_close(latents, vae.encode(picture, return_dict=False)[0].mode() * 0.18215)
    scaled: Any = latents / 0.18215
    torch.testing.assert_close(codec.decode(latents), vae.decode(scaled, return_dict=False)[0])
    mask = torch.rand(2, 1, 16, 16)
    of_patches = mask.reshape(2, 1, 8, 2, 8, 2).mean(dim=(3, 5))  # each latent counts as its pixels do on average
    torch.testing.assert_close(codec.weights(mask), of_patches.expand_as(latents))


def test_unknown_codec_and_missing_autoencoder() -> None:
    with pytest.raises(UnirenderError, match="expected 'pixel' or 'kl'"):
        make_codec("vq", 2)
    with pytest.raises(UnirenderError, match="AutoencoderKL"):
        make_codec("kl", 8, None)
    assert make_codec("kl", 8, tiny_vae()).factor == 2
