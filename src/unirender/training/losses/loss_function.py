"""The loss of one batch: x0 regression in both directions, and consistency with the image (paper Sec. 3.2).

    a_0', i_0' = f(a_t, i_t, t_a, t_i)
    L = sum over k of  w_k |a_0 - a_0'|_k^2  +  w_image |i_0 - i_0'|^2                 (Eq. 2)
      + w_cycle |i_0 - i_0'(a_0', i_T, 0, T)|^2                                        (Eq. 5)

The regression is UniDiffuser's, of x0 in place of the noise. Each stream is compared where it is noisy: the image
stream's x0 with the true image, the attribute stream's with each of the six attribute pictures k. Every picture has a
weight of its own. Pixels are weighted by coverage (those of the light: all alike). In an *inverse* row the image is
clean and the attributes are not. There the predicted attributes are rendered, too, and compared with the image: see
`unirender.training.losses.consistency`.

Notation: a attributes, i image, a_0 clean latents, a_t noised ones, a_0' predicted ones; t timestep; f the network
(`unirender.models.dual_stream`); n = 6 pictures of c latent channels each.
"""

from dataclasses import dataclass

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Bool, Float
from torch import Tensor

from unirender.diffusion.schedule import add_noise
from unirender.diffusion.timesteps import Timesteps
from unirender.models.conditioning import Conditioning, Extras
from unirender.models.dual_stream import DualStreamModel, DualStreamOutput
from unirender.models.packing import TRIPLETS, Maps
from unirender.pipelines.rendered_maps import told_derived
from unirender.training.config import LossConfig
from unirender.training.losses.consistency import Consistency
from unirender.training.losses.terms import Errors, LossTerms, noise_like, predict

DROPPABLE = ("albedo", "specular", "diffuse", "environment")  # maps that a renderer must be able to do without


@dataclass
class LossFunction:
    """The loss of a model under a config.

    Attributes:
        cycle_scale: multiplies the cycle's weight; the trainer raises it from 0 after the warm-up.
        scale: of the loss while its gradient is taken (`unirender.training.optim.loss_scale`); terms are without it.
    """

    model: DualStreamModel
    conditioning: Conditioning
    scheduler: DDIMScheduler
    config: LossConfig
    map_dropout: float = 0.0
    cycle_scale: float = 1.0
    scale: float = 1.0

    def terms(self, batch: Maps, timesteps: Timesteps, generator: torch.Generator) -> LossTerms:
        """The loss terms of a batch; {} where nothing is noisy.

        Where the attributes are clean, some of the maps that a renderer must be able to do without are replaced by
        noise, and flagged as unknown.

        Args:
            batch: as the reader gives it.
            timesteps: of either rule. Rows in between are decoded for nothing where those that are noisy in a stream
                do not stand together; under Section 3.2's rule they do.
            generator: CPU generator of noise and dropped maps.
        """
        a_0, i_0 = self._encode(batch)
        noisy_a, noisy_i = (t.cpu() > 0 for t in (timesteps.attributes, timesteps.image))  # a GPU is waited for once
        a_t, i_t, extras = self._noised(batch, a_0, i_0, timesteps, noisy_a, generator)
        span_a, span_i = _span(noisy_a), _span(noisy_i)
        output = predict(self.model, a_t, i_t, timesteps, extras, span_a, span_i)
        errors = Errors(self.conditioning, self.config.background)
        terms: LossTerms = {}
        if span_i is not None:
            assert output.image is not None
            rows = _Rows(span_i, noisy_i)
            truth, mask = (rows.of(x) for x in (i_0, batch["mask"]))
            predicted = rows.of_decoded(output.image)
            terms["image"] = errors.image(predicted, truth, mask, self.config.image_floor)
        if span_a is not None:
            assert output.attributes is not None
            rows = _Rows(span_a, noisy_a)
            truth, mask = (rows.of(x) for x in (a_0, batch["mask"]))
            predicted = rows.of_decoded(output.attributes)
            terms |= errors.attributes(predicted, truth, mask, self.config.colour_floor)
            inverse = _Rows(span_a, noisy_a & ~noisy_i)
            terms |= self._inverse_terms(output, i_0, batch, inverse, errors, generator)
        return terms

    def total(self, terms: LossTerms) -> Float[Tensor, ""]:
        """The weighted sum; the cycle's weight is scaled by its warm-up."""
        scale = {"cycle": self.cycle_scale}
        weights = [getattr(self.config, name) * scale.get(name, 1.0) for name in terms]
        return torch.stack([weight * term for weight, term in zip(weights, terms.values(), strict=True)]).sum()

    def _noised(
        self,
        batch: Maps,
        a_0: Float[Tensor, "b nc h w"],
        i_0: Float[Tensor, "b c h w"],
        timesteps: Timesteps,
        noisy_a: Bool[Tensor, " b"],
        generator: torch.Generator,
    ) -> tuple[Float[Tensor, "b nc h w"], Float[Tensor, "b c h w"], Extras]:
        """Both streams' latents at their timesteps, and what enters beside them; dropped maps are noise throughout."""
        seen, derived = self._seen(batch, timesteps.attributes == 0)
        shown_a = a_0 if seen is batch else self._encode_attributes(seen)
        given = self._draw_given(len(a_0), generator) & ~noisy_a[:, None]
        known = self.conditioning.by_triplet(given | noisy_a[:, None]).to(a_0.device)
        given = given.to(a_0.device)
        noise_a = noise_like(a_0, generator)
        a_t = torch.where(known, add_noise(self.scheduler, shown_a, noise_a, timesteps.attributes), noise_a)
        i_t = add_noise(self.scheduler, i_0, noise_like(i_0, generator), timesteps.image)
        return a_t, i_t, self.conditioning.extras(batch["mask"], given, seen, derived=derived)

    @torch.no_grad()  # an autoencoder is not trained here, and its activations would be kept
    def _encode(self, batch: Maps) -> tuple[Tensor, Tensor]:
        return self.conditioning.encode_attributes(batch), self.conditioning.encode_image(batch["image"])

    @torch.no_grad()
    def _encode_attributes(self, batch: Maps) -> Tensor:
        return self.conditioning.encode_attributes(batch)

    def _seen(self, batch: Maps, clean: Bool[Tensor, " b"]) -> tuple[Maps, Bool[Tensor, "b 6"] | None]:
        """The maps that a renderer sees, in which s and d may have been derived from the light; and which lack shadows.

        Of those that have the shadows that are seen, d alone is said to lack others, as
        `unirender.pipelines.rendered_maps.told_derived` says it of a light that is given.
        """
        rows = clean & (batch["derived"].flatten() > 0) if "derived" in batch else None
        if rows is None or not rows.any():
            return batch, None
        names = ("specular", "diffuse")
        swapped = {n: torch.where(rows[:, None, None, None], batch[f"derived_{n}"], batch[n]) for n in names}
        of_light, of_diffuse = (
            torch.tensor([name in told_derived(names, shadows) for name in TRIPLETS], device=rows.device)
            for shadows in (False, True)
        )
        shadowed = batch["shadowed"].flatten()[:, None] > 0
        return batch | swapped, rows[:, None] & torch.where(shadowed, of_diffuse, of_light)

    def _inverse_terms(
        self,
        output: DualStreamOutput,
        i_0: Float[Tensor, "b c h w"],
        batch: Maps,
        inverse: "_Rows",
        errors: Errors,
        generator: torch.Generator,
    ) -> LossTerms:
        """What the attributes predicted of clean images render to; the cycle: of a share of the rows."""
        assert output.attributes is not None
        predicted = inverse.of_decoded(output.attributes).float()
        truth, image, mask = (inverse.of(x) for x in (i_0, batch["image"], batch["mask"]))
        consistency = Consistency(self.model, self.conditioning, self.scheduler, self.config, errors, self.scale)
        terms: LossTerms = {}
        if self.config.composite and len(predicted):
            terms["composite"] = consistency.composite(predicted, image, mask)
        share = self.config.cycle_share
        count = min(max(1, round(share * len(predicted))), len(predicted)) if share else 0  # one even of few rows
        if self.config.cycle and self.cycle_scale and count:
            terms["cycle"] = consistency.cycle(predicted[:count], truth[:count], mask[:count], generator)
        return terms

    def _draw_given(self, batch: int, generator: torch.Generator) -> Bool[Tensor, "b 6"]:
        kept = torch.rand(batch, len(TRIPLETS), generator=generator) >= self.map_dropout
        never_dropped = torch.tensor([name not in DROPPABLE for name in TRIPLETS])
        return kept | never_dropped


@dataclass(frozen=True)
class _Rows:
    """The `chosen` rows of a batch, all of them inside the `span` that a stream decoded."""

    span: slice
    chosen: Bool[Tensor, " b"]

    def of(self, x: Tensor) -> Tensor:
        """From the whole batch."""
        return self.of_decoded(x[self.span])

    def of_decoded(self, x: Tensor) -> Tensor:
        """From the rows that were decoded."""
        inside = self.chosen[self.span]
        return x if inside.all() else x[inside]


def _span(chosen: Bool[Tensor, " b"]) -> slice | None:
    """From the first to the last chosen row; None without any."""
    places = chosen.nonzero()
    return slice(int(places[0]), int(places[-1]) + 1) if len(places) else None
