"""The loss of one batch (paper Sec. 3.2): x0 regression in both directions, and cycle consistency.

Rendering samples compare the image stream's x0 with the true image; inverse samples compare each of the six attribute
pictures, every picture with a weight of its own, pixels weighted by coverage (the light: all alike). A share of the
inverse samples is rendered again from the *predicted* attributes, at pure noise, and compared with the true image.

Notation: a attributes, i image, t timestep, n = 6 pictures of c latent channels each.
"""

from dataclasses import dataclass

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Bool, Float
from torch import Tensor

from unirender.diffusion.schedule import add_noise, last_timestep
from unirender.diffusion.timesteps import Timesteps
from unirender.models.conditioning import TRIPLETS, Conditioning, Extras
from unirender.models.dual_stream import DualStreamModel, DualStreamOutput
from unirender.models.priors import Maps
from unirender.training.presets import LossConfig

DROPPABLE = ("albedo", "specular", "diffuse", "environment")  # maps that a renderer must be able to do without

LossTerms = dict[str, Float[Tensor, ""]]


@dataclass
class LossFunction:
    """The loss of a model under a config.

    Attributes:
        cycle_scale: multiplies the cycle's weight; the trainer raises it from 0 after the warm-up.
    """

    model: DualStreamModel
    conditioning: Conditioning
    scheduler: DDIMScheduler
    config: LossConfig
    map_dropout: float = 0.0
    cycle_scale: float = 1.0

    def terms(self, batch: Maps, timesteps: Timesteps, generator: torch.Generator) -> LossTerms:
        """The loss terms of a batch under Section 3.2's rule, rendering samples first; each stream is compared where it
        is noisy. Under Algorithm 1's rule use `joint_terms`.

        Args:
            batch: as the reader gives it.
            timesteps: the first rows render (attributes at 0), the rest is inverse (image at 0).
            generator: CPU generator of noise and dropped maps.
        """
        size, count = len(batch["image"]), int((timesteps.attributes == 0).sum())
        clean_a, clean_i = self._encode(batch)
        inverse = torch.arange(size, device=clean_a.device)[:, None] >= count
        given = self._draw_given(size, generator).to(clean_a.device) & ~inverse
        noise_a = _noise_like(clean_a, generator)
        known = self.conditioning.by_triplet(given | inverse)
        attributes = torch.where(known, add_noise(self.scheduler, clean_a, noise_a, timesteps.attributes), noise_a)
        image = add_noise(self.scheduler, clean_i, _noise_like(clean_i, generator), timesteps.image)
        extras = self.conditioning.extras(batch["mask"], given, batch)
        rows_i, rows_a = slice(0, count) if count else None, slice(count, None) if count < size else None
        output = self._forward(attributes, image, timesteps, extras, rows_a, rows_i)
        terms: LossTerms = {}
        if rows_i is not None:
            terms["image"] = self._image_error(output.image, clean_i[rows_i], batch["mask"][rows_i])
        if rows_a is not None:
            part = {name: value[rows_a] for name, value in batch.items()}
            terms |= self._attribute_errors(output.attributes, clean_a[rows_a], part["mask"])
            terms |= self._consistency(output.attributes, clean_i[rows_a], part, generator)
        return terms

    def joint_terms(self, batch: Maps, timesteps: Timesteps, generator: torch.Generator) -> LossTerms:
        """Any timesteps for both streams (Algorithm 1): each is compared where it is noisy. No cycle here."""
        clean_a, clean_i = self._encode(batch)
        attributes = add_noise(self.scheduler, clean_a, _noise_like(clean_a, generator), timesteps.attributes)
        image = add_noise(self.scheduler, clean_i, _noise_like(clean_i, generator), timesteps.image)
        given = (timesteps.attributes == 0)[:, None].expand(-1, len(TRIPLETS))
        extras = self.conditioning.extras(batch["mask"], given, batch)
        output = self._forward(attributes, image, timesteps, extras, slice(None), slice(None))
        noisy_a, noisy_i = (t > 0 for t in (timesteps.attributes, timesteps.image))
        assert output.attributes is not None
        assert output.image is not None
        terms: LossTerms = {}
        if noisy_a.any():
            terms |= self._attribute_errors(output.attributes[noisy_a], clean_a[noisy_a], batch["mask"][noisy_a])
        if noisy_i.any():
            terms["image"] = self._image_error(output.image[noisy_i], clean_i[noisy_i], batch["mask"][noisy_i])
        return terms

    def total(self, terms: LossTerms) -> Float[Tensor, ""]:
        """The weighted sum; the cycle's weight is scaled by its warm-up."""
        scale = {"cycle": self.cycle_scale}
        weights = [getattr(self.config, name) * scale.get(name, 1.0) for name in terms]
        return torch.stack([weight * term for weight, term in zip(weights, terms.values(), strict=True)]).sum()

    def _encode(self, batch: Maps) -> tuple[Tensor, Tensor]:
        return self.conditioning.encode_attributes(batch), self.conditioning.encode_image(batch["image"])

    def _forward(
        self,
        attributes: Tensor,
        image: Tensor,
        t: Timesteps,
        extras: Extras,
        rows_a: slice | None,
        rows_i: slice | None,
    ) -> DualStreamOutput:
        return self.model(
            attributes,
            image,
            t.attributes,
            t.image,
            extras.attributes,
            extras.image,
            image_prior=extras.prior,
            attribute_rows=rows_a,
            image_rows=rows_i,
        )

    def _consistency(
        self, predicted: Tensor | None, clean_i: Tensor, batch: Maps, generator: torch.Generator
    ) -> LossTerms:
        """The losses that compare what the predicted attributes look like with the true image."""
        assert predicted is not None
        terms: LossTerms = {}
        count = round(self.config.cycle_share * len(predicted))
        if not self.config.cycle or self.cycle_scale == 0 or not count:
            return terms
        rows, mask = predicted[:count].float(), batch["mask"][:count]
        if self.config.cycle_into_renderer:
            return terms | {"cycle": self._cycle(rows, clean_i[:count], mask, generator)}
        leaf = rows.detach().requires_grad_()
        error = self._cycle(leaf, clean_i[:count], mask, generator)
        return terms | {"cycle": _with_gradient(error.detach(), rows, torch.autograd.grad(error, leaf)[0])}

    def _cycle(
        self, predicted: Float[Tensor, "k nc h w"], clean_i: Tensor, mask: Tensor, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Renders the predicted attributes from pure noise in one step; error against the true image."""
        maps = self.conditioning.decode_attributes(predicted)
        given = torch.ones(len(predicted), len(TRIPLETS), dtype=torch.bool, device=predicted.device)
        extras = self.conditioning.extras(mask, given, maps)
        t = torch.full((len(predicted),), last_timestep(self.scheduler), device=predicted.device)
        noise = _noise_like(clean_i, generator)
        output = self._forward(predicted, noise, Timesteps(torch.zeros_like(t), t), extras, None, slice(None))
        return self._image_error(output.image, clean_i, mask)

    def _pixel_weights(self, mask: Float[Tensor, "b 1 H W"]) -> Float[Tensor, "b 1 H W"]:
        return self.config.background + (1 - self.config.background) * mask

    def _image_error(self, predicted: Tensor | None, clean: Tensor, mask: Tensor) -> Float[Tensor, ""]:
        assert predicted is not None
        weights = self.conditioning.codec.weights(self._pixel_weights(mask))
        return _weighted_mean((predicted.float() - clean).square(), weights)

    def _attribute_errors(self, predicted: Tensor | None, clean: Tensor, mask: Tensor) -> LossTerms:
        assert predicted is not None
        weights = self.conditioning.codec.weights(self._pixel_weights(mask))
        error = (predicted.float() - clean).square().chunk(len(TRIPLETS), dim=1)
        terms = dict(zip(TRIPLETS, error, strict=True))
        lit = terms.pop("environment").mean()
        return {name: _weighted_mean(e, weights) for name, e in terms.items()} | {"environment": lit}

    def _draw_given(self, batch: int, generator: torch.Generator) -> Bool[Tensor, "b 6"]:
        kept = torch.rand(batch, len(TRIPLETS), generator=generator) >= self.map_dropout
        never_dropped = torch.tensor([name not in DROPPABLE for name in TRIPLETS])
        return kept | never_dropped


def _with_gradient(value: Tensor, x: Tensor, gradient: Tensor) -> Float[Tensor, ""]:
    """A scalar that has this value, and this gradient with respect to `x`: nothing upstream of x but x is reached."""
    linear = (gradient * x).sum()
    return value + linear - linear.detach()


def _weighted_mean(error: Tensor, weights: Tensor) -> Float[Tensor, ""]:
    return (error * weights).sum() / weights.sum()


def _noise_like(x: Tensor, generator: torch.Generator) -> Tensor:
    """Gaussian noise drawn on the CPU, so that a seed means the same on every device."""
    return torch.randn(x.shape, generator=generator).to(x)
