"""The losses that compare what the predicted attributes C look like with the true image, on inverse rows.

    cycle       |i_0 - i_0'(C, i_T, 0, T)|^2                                           (Eq. 5)
    composite   |srgb(I) - srgb(I'(C))|^2

`cycle` (the paper's "cycle-consistent constraint"): the network renders them again, i_0', from pure noise i_T in one
step. `composite` (ours): I' is their closed-form image; no network takes part, so nothing can learn to accept wrong
maps, but shadowed highlights and interreflection are then explained by the maps.

Notation: i_0 latents of the true image I; T the last timestep.
"""

from dataclasses import dataclass

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Float
from torch import Tensor

from unirender.camera import Camera
from unirender.diffusion.schedule import last_timestep
from unirender.diffusion.timesteps import Timesteps
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS, srgb_encode
from unirender.models.priors import PRIORS
from unirender.training.config import LossConfig
from unirender.training.losses.terms import Errors, gradients, noise_like, predict, weighted_mean

ALL = slice(None)


@dataclass(frozen=True)
class Consistency:
    """Both losses of a model under a config; predicted latents come in float32.

    Attributes:
        scale: of the cycle's loss while its gradient is taken; see `unirender.training.losses.terms.gradients`.
    """

    model: DualStreamModel
    conditioning: Conditioning
    scheduler: DDIMScheduler
    config: LossConfig
    errors: Errors
    scale: float = 1.0

    def cycle(
        self,
        predicted: Float[Tensor, "b nc h w"],
        i_0: Float[Tensor, "b c h w"],
        mask: Float[Tensor, "b 1 H W"],
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Eq. 5: the error of the image rendered from predicted attributes.

        Without `cycle_into_renderer` the gradient reaches the attributes, and through them the pass that predicted
        them, but not the weights of the rendering pass.

        Args:
            predicted: C, of the training step.
            i_0: latents of the true image.
            mask: coverage.
            generator: CPU generator of the noise.
        """
        if self.config.cycle_into_renderer:
            return self._rendered(predicted, i_0, mask, generator)
        leaf = predicted.detach().requires_grad_()
        error = self._rendered(leaf, i_0, mask, generator)
        (gradient,) = gradients(error, [leaf], self.scale)
        assert gradient is not None, "what is rendered comes of it"
        return _with_gradient(error.detach(), predicted, gradient)

    def composite(
        self,
        predicted: Float[Tensor, "b nc h w"],
        image_linear: Float[Tensor, "b 3 H W"],
        mask: Float[Tensor, "b 1 H W"],
    ) -> Float[Tensor, ""]:
        """Error of the closed-form image of predicted attributes: the model's physics prior, else the split sum.

        Display values in [-1, 1], as the cycle's. Nothing is clipped but where the picture is: a surface that is
        predicted too bright has a gradient, and one that is brighter than white where the picture is white no error.

        Args:
            predicted: latents of the six pictures.
            image_linear: the true image, premultiplied.
            mask: coverage.
        """
        prior = self.conditioning.physics_prior or PRIORS["split_sum"]
        maps = self.conditioning.decode_attributes(predicted)
        shown = srgb_encode(prior.radiance(maps, Camera()) * mask)
        shown = torch.where(image_linear >= 1, shown.clamp(max=1), shown)
        error = (2 * shown - 2 * srgb_encode(image_linear.clamp(0, 1))).square()
        return weighted_mean(error, self.errors.pixel_weights(mask).expand_as(error))

    def _rendered(
        self, attributes: Float[Tensor, "b nc h w"], i_0: Tensor, mask: Tensor, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """|i_0 - i_0'(C, i_T, 0, T)|^2."""
        given = torch.ones(len(attributes), len(TRIPLETS), dtype=torch.bool, device=attributes.device)
        extras = self.conditioning.extras(mask, given, self.conditioning.decode_given(attributes))
        i_T = noise_like(i_0, generator)
        T = torch.full((len(attributes),), last_timestep(self.scheduler), device=attributes.device)
        rendering = Timesteps(attributes=torch.zeros_like(T), image=T)
        output = predict(self.model, attributes, i_T, rendering, extras, None, ALL)
        assert output.image is not None
        return self.errors.image(output.image, i_0, mask)


def _with_gradient(value: Tensor, x: Tensor, gradient: Tensor) -> Float[Tensor, ""]:
    """A scalar that has this value, and this gradient with respect to `x`: nothing upstream of x but x is reached."""
    linear = (gradient * x).sum()
    return value + linear - linear.detach()
