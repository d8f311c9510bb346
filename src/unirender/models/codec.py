"""Latent codecs: pictures in [-1, 1] to the latents that the streams denoise, and back.

Both codecs take three-channel pictures. `PixelCodec` moves each patch of pixels into channels: lossless, so that small
models have no reconstruction ceiling. `KLCodec` is Stable Diffusion's `AutoencoderKL`, scaled by its own factor.
"""

from typing import Any, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from jaxtyping import Float
from torch import Tensor

from unirender.errors import UnirenderError


@runtime_checkable
class Codec(Protocol):
    """What the rest of the package knows of a codec."""

    @property
    def factor(self) -> int:
        """Image pixels per latent pixel, one way."""
        ...

    @property
    def channels(self) -> int:
        """Latent channels of one three-channel picture."""
        ...

    def encode(self, picture: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b c h w"]:
        """Pictures in [-1, 1] -> latents."""
        ...

    def decode(self, latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 3 H W"]:
        """Latents -> pictures, not clipped."""
        ...

    def weights(self, weight: Float[Tensor, "b 1 H W"]) -> Float[Tensor, "b c h w"]:
        """Weights of pixels -> weights of the latent values that carry them."""
        ...


class PixelCodec:
    """Space to depth: `patch` x `patch` pixels become channels. Its decoder is its exact inverse."""

    def __init__(self, patch: int = 2) -> None:
        if patch < 1:
            raise UnirenderError(f"pixel codec: got patch {patch}, expected a positive number of pixels")
        self.patch = patch

    @property
    def factor(self) -> int:
        return self.patch

    @property
    def channels(self) -> int:
        return 3 * self.patch**2

    def encode(self, picture: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b c h w"]:
        return F.pixel_unshuffle(picture, self.patch)

    def decode(self, latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 3 H W"]:
        return F.pixel_shuffle(latents, self.patch)

    def weights(self, weight: Float[Tensor, "b 1 H W"]) -> Float[Tensor, "b c h w"]:
        return F.pixel_unshuffle(weight.expand(-1, 3, -1, -1), self.patch)


class KLCodec:
    """Stable Diffusion's autoencoder: the mode of its posterior, times its scaling factor (0.18215)."""

    def __init__(self, vae: AutoencoderKL) -> None:
        self.vae = vae
        self.scale = float(vae.config["scaling_factor"])

    @property
    def factor(self) -> int:
        return 2 ** (len(self.vae.config["block_out_channels"]) - 1)

    @property
    def channels(self) -> int:
        return int(self.vae.config["latent_channels"])

    def encode(self, picture: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b c h w"]:
        (posterior,) = self.vae.encode(picture.to(self.vae.dtype), return_dict=False)
        return posterior.mode() * self.scale

    def decode(self, latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 3 H W"]:
        scaled: Any = latents.to(self.vae.dtype) / self.scale  # diffusers annotates the legacy FloatTensor
        (picture,) = self.vae.decode(scaled, return_dict=False)
        return picture

    def weights(self, weight: Float[Tensor, "b 1 H W"]) -> Float[Tensor, "b c h w"]:
        return F.avg_pool2d(weight, self.factor).expand(-1, self.channels, -1, -1)


def make_codec(kind: str, patch: int, vae: torch.nn.Module | None = None) -> Codec:
    """The codec that a model's config names.

    Raises:
        UnirenderError: unknown kind, or "kl" without an `AutoencoderKL`.
    """
    if kind == "pixel":
        return PixelCodec(patch)
    if kind == "kl":
        if not isinstance(vae, AutoencoderKL):
            raise UnirenderError(f"codec kl: got {type(vae).__name__} as its autoencoder, expected an AutoencoderKL")
        return KLCodec(vae)
    raise UnirenderError(f"codec: got {kind!r}, expected 'pixel' or 'kl'")
