"""Stable Diffusion that sees further latents beside the one that it denoises; made of diffusers' parts.

diffusers has no pipeline for the networks of RGB-to-X, which are of this kind. No guidance: a prompt says which map is
meant, and the network follows it as it was trained.
"""

from dataclasses import dataclass
from typing import Any

import torch
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from jaxtyping import Float
from torch import Tensor

from unirender.diffusion.sampling import set_timesteps


@dataclass(frozen=True)
class ConditionedDiffusion:
    """The network and what belongs to it.

    Attributes:
        unet: its input is the noisy latent, then the condition.
        vae: of the latents.
        text_encoder: of the prompts.
        tokenizer: of the prompts.
        scheduler: of diffusers, deterministic.
    """

    unet: Any
    vae: Any
    text_encoder: Any
    tokenizer: Any
    scheduler: Any

    @property
    def factor(self) -> int:
        """Pixels of a latent's side."""
        return 2 ** (len(self.vae.config.block_out_channels) - 1)

    @torch.no_grad()
    def words(self, prompt: str) -> Float[Tensor, "1 tokens width"]:
        """A prompt, padded to its full length as Stable Diffusion pads it."""
        length = self.tokenizer.model_max_length
        tokens = self.tokenizer(prompt, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
        return self.text_encoder(tokens.input_ids.to(self.unet.device))[0]

    @torch.no_grad()
    def encode(self, picture: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "1 c lh lw"]:
        """The latent of a picture in [-1, 1] whose sides are multiples of `factor`."""
        latent = self.vae.encode(picture.to(self.unet.device, self.unet.dtype)).latent_dist.mode()
        return latent * self.vae.config.scaling_factor

    @torch.no_grad()
    def denoise(
        self,
        condition: Float[Tensor, "1 k lh lw"],
        words: Float[Tensor, "1 tokens width"],
        steps: int,
        generator: torch.Generator,
    ) -> Float[Tensor, "1 3 h w"]:
        """What the network makes of noise beside a condition, decoded: about [-1, 1], float32, on the CPU."""
        shape = (1, self.vae.config.latent_channels, *condition.shape[-2:])
        noise = torch.randn(shape, generator=generator)  # drawn in float32: the same noise at any precision
        latent = noise.to(self.unet.device, self.unet.dtype) * self.scheduler.init_noise_sigma
        set_timesteps(self.scheduler, steps, self.unet.device)
        for t in self.scheduler.timesteps:
            seen = torch.cat([self.scheduler.scale_model_input(latent, t), condition], dim=1)
            output = self.unet(seen, t, encoder_hidden_states=words, return_dict=False)[0]
            latent = self.scheduler.step(output, t, latent, return_dict=False)[0]
        decoded = self.vae.decode(latent / self.vae.config.scaling_factor, return_dict=False)[0]
        return decoded.float().cpu()


@dataclass(frozen=True)
class Fit:
    """How a picture was brought to a network's size, and the way back.

    Attributes:
        size: rows and columns of the picture.
        padding: rows and columns that were added below and to the right.
    """

    size: tuple[int, int]
    padding: tuple[int, int]

    def back(self, picture: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c rows columns"]:
        """At the size that the picture had."""
        cut = MarigoldImageProcessor.unpad_image(picture, self.padding)
        return MarigoldImageProcessor.resize_antialias(cut, self.size, "bilinear", is_aa=True)


def fit(
    picture: Float[Tensor, "1 c rows columns"], resolution: int, factor: int
) -> tuple[Float[Tensor, "1 c h w"], Fit]:
    """A picture whose sides are multiples of `factor`: its longer side is resized, then its border is repeated.

    Args:
        picture: of any size.
        resolution: pixels of the longer side; 0 = the picture's own.
        factor: pixels of a latent's side.
    """
    rows, columns = picture.shape[-2:]
    if resolution:
        picture = MarigoldImageProcessor.resize_to_max_edge(picture, resolution, "bilinear")
    padded, padding = MarigoldImageProcessor.pad_image(picture, factor)
    return padded, Fit((rows, columns), padding)
