"""What the losses are made of: one pass through both streams, and squared errors weighted by pixel.

    x_0' = f(x_t, ...),    |x_0 - x_0'|^2 = sum of m (x_0 - x_0')^2 / sum of m         (Eq. 2)

of one stream, of x0 in place of the noise.

Notation: x_0 `clean` latents, x_0' `predicted` ones, m `weights`; b batch, H W image size, h w latent size, c latent
channels of one picture, n = 6 pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unirender.diffusion.timesteps import Timesteps
from unirender.models.conditioning import Conditioning, Extras
from unirender.models.dual_stream import DualStreamModel, DualStreamOutput
from unirender.models.packing import TRIPLETS

COLOURS = ("albedo", "specular", "diffuse")  # the attribute pictures that are scored by PSNR
LossTerms = dict[str, Float[Tensor, ""]]


def predict(
    model: DualStreamModel,
    attributes: Float[Tensor, "b nc h w"],
    image: Float[Tensor, "b c h w"],
    t: Timesteps,
    extras: Extras,
    rows_a: slice | None,
    rows_i: slice | None,
) -> DualStreamOutput:
    """Clean latents of the rows that are asked for in each stream; None: of none."""
    return model(
        attributes=attributes,
        image=image,
        attributes_timestep=t.attributes,
        image_timestep=t.image,
        attribute_extra=extras.attributes,
        image_extra=extras.image,
        image_prior=extras.prior,
        attribute_rows=rows_a,
        image_rows=rows_i,
    )


@dataclass(frozen=True)
class Errors:
    """Mean squared errors of latents, |x_0 - x_0'|^2 of Eq. 2.

    Attributes:
        conditioning: whose codec spreads the weights of pixels over latents.
        background: weight of a pixel outside the mask, beside 1 inside.
    """

    conditioning: Conditioning
    background: float

    def pixel_weights(self, mask: Float[Tensor, "b 1 H W"]) -> Float[Tensor, "b 1 H W"]:
        return self.background + (1 - self.background) * mask

    def image(
        self,
        predicted: Float[Tensor, "b c h w"],
        clean: Float[Tensor, "b c h w"],
        mask: Float[Tensor, "b 1 H W"],
        floor: float = 0.0,
    ) -> Float[Tensor, ""]:
        """Of the image.

        Args:
            predicted: by the network.
            clean: the truth.
            mask: coverage.
            floor: E of `compressed`; 0: the squared error itself.
        """
        weights = self.conditioning.codec.weights(self.pixel_weights(mask))
        error = (predicted.float() - clean).square()
        return _decibels(error, weights, floor) if floor else weighted_mean(error, weights)

    def attributes(
        self,
        predicted: Float[Tensor, "b nc h w"],
        clean: Float[Tensor, "b nc h w"],
        mask: Float[Tensor, "b 1 H W"],
        floor: float = 0.0,
    ) -> LossTerms:
        """Of each of the six pictures; the light's pixels all count alike.

        `floor` is as in `image`, for the pictures in `COLOURS` only.
        """
        weights = self.conditioning.codec.weights(self.pixel_weights(mask))
        squares = _by_picture((predicted.float() - clean).square())
        lit = squares.pop("environment").mean()
        terms = {name: weighted_mean(e, weights) for name, e in squares.items()}
        if floor:
            terms |= {name: _decibels(squares[name], weights, floor) for name in COLOURS}
        return terms | {"environment": lit}


def compressed(error: Float[Tensor, " b"], floor: float) -> Float[Tensor, " b"]:
    """E log(1 + e / E) of each sample's squared error e: e where it is far below E, and where it is far above, the
    decibels of a PSNR.

    A mean of squared errors is decided by the worst pictures, a mean PSNR is not: a correction that saves a bad picture
    may spoil, for it, what was nearly right in all others.
    """
    return floor * torch.log1p(error / floor)


def weighted_mean(error: Float[Tensor, "b c h w"], weights: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    return (error * weights).sum() / weights.sum()


def _decibels(error: Float[Tensor, "b c h w"], weights: Float[Tensor, "b c h w"], floor: float) -> Float[Tensor, ""]:
    """The mean of the samples' errors, each of them `compressed`."""
    return compressed((error * weights).sum(dim=(1, 2, 3)) / weights.sum(dim=(1, 2, 3)), floor).mean()


def gradients(loss: Float[Tensor, ""], inputs: Sequence[Tensor], scale: float = 1.0) -> list[Tensor | None]:
    """The gradient of a loss with respect to each input; None: it takes no part.

    Args:
        loss: a scalar.
        inputs: float32.
        scale: the gradient is that of a loss so many times larger, divided again: in float16 a third of the gradients
            of a trained network would be 0 without.
    """
    if scale == 1:
        return list(torch.autograd.grad(loss, inputs, allow_unused=True))
    scaled = torch.autograd.grad(scale * loss, inputs, allow_unused=True)
    return [None if gradient is None else gradient / scale for gradient in scaled]


def noise_like(x: Tensor, generator: torch.Generator) -> Tensor:
    """Gaussian noise from a CPU generator.

    On CUDA, where a batch's would keep the CPU busy for longer than its step takes, a generator of the device draws it,
    whose seed comes from this one: a seed then means the same on GPUs of one model, and other noise than on a CPU.
    """
    if x.device.type != "cuda":
        return torch.randn(x.shape, generator=generator).to(x)
    own = torch.Generator(x.device).manual_seed(int(torch.randint(2**62, (), generator=generator)))
    return torch.randn(x.shape, generator=own, device=x.device, dtype=torch.float32).to(x)


def _by_picture(x: Float[Tensor, "b nc h w"]) -> dict[str, Float[Tensor, "b c h w"]]:
    return dict(zip(TRIPLETS, x.chunk(len(TRIPLETS), dim=1), strict=True))
