"""The passes of training and nothing else: a network's forward and backward on random tensors.

A batch is cut into parts that run side by side, and in each part

    pass     rendering and inverse rows at once, each decoded in its own stream; backward to all weights
    cycle    a share of the inverse rows once more, rendering; backward to its input alone, or to the weights as well if
             the preset's cycle trains the renderer

The autocast is that of training. No reader, no encoding or decoding, no losses but a mean square, no optimiser.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor

from unirender.diffusion.schedule import NUM_TIMESTEPS
from unirender.errors import UnirenderError
from unirender.models.conditioning import Conditioning, Extras
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS
from unirender.training.config import TrainConfig

LAST = NUM_TIMESTEPS - 1


@dataclass(frozen=True)
class Rows:
    """Rows of one of the parts that run side by side."""

    render: int  # rows that render; they come first
    inverse: int  # rows of inverse rendering
    cycle: int  # of these, rows that are rendered again


@dataclass(frozen=True)
class Inputs:
    """Random inputs of one part."""

    rows: Rows
    attributes: Tensor
    image: Tensor
    extras: Extras


def cut_batch(config: TrainConfig, parallel: int) -> list[Rows]:
    """The parts of a batch, as training cuts it: rows that render come first, then those that are rendered again, then
    the other inverse ones, and part j of k has the rows j, j + k, j + 2k, ...

    Raises:
        UnirenderError: the preset trains by other passes than these.
    """
    if config.timestep_rule != "conditional":
        raise UnirenderError(
            f"bare passes: got the timestep rule {config.timestep_rule!r}, expected 'conditional'; choose another "
            "preset"
        )
    size, render = config.batch_size, round(config.batch_size * config.p_render)
    again = round(config.loss.cycle_share * (size - render)) if config.loss.cycle else 0
    number = min(parallel, size)

    def taken(part: int, first: int, end: int) -> int:
        return sum(first <= row < end for row in range(part, size, number))

    return [Rows(taken(j, 0, render), taken(j, render, size), taken(j, render, render + again)) for j in range(number)]


class BarePasses:
    """Runs the passes of a batch when it is called."""

    def __init__(
        self, model: DualStreamModel, conditioning: Conditioning, config: TrainConfig, parallel: int, dtype: torch.dtype
    ) -> None:
        self.model, self.config, self.dtype = model, config, dtype
        self.parameters = list(model.parameters())
        self.device = self.parameters[0].device
        self.inputs = [self._random(rows, conditioning) for rows in cut_batch(config, parallel)]
        self.pool = ThreadPoolExecutor(len(self.inputs), "unirender-bare") if len(self.inputs) > 1 else None

    def __call__(self) -> None:
        """One batch."""
        if self.pool is None:
            for part in self.inputs:
                self._run(part)
        else:
            list(self.pool.map(self._run, self.inputs))

    def close(self) -> None:
        """Ends the threads."""
        if self.pool is not None:
            self.pool.shutdown()

    def _random(self, rows: Rows, conditioning: Conditioning) -> Inputs:
        count, size = rows.render + rows.inverse, self.config.model.resolution
        latent, generator = size // conditioning.codec.factor, torch.Generator().manual_seed(0)

        def noise(channels: int) -> Tensor:
            return torch.randn(count, channels, latent, latent, generator=generator).to(self.device)

        known = torch.zeros(count, len(TRIPLETS), dtype=torch.bool, device=self.device)
        extras = conditioning.extras(torch.ones(count, 1, size, size, device=self.device), known)
        return Inputs(rows, noise(conditioning.attribute_channels), noise(conditioning.codec.channels), extras)

    def _run(self, part: Inputs) -> None:
        loss = self._pass(part)
        if not part.rows.cycle:
            torch.autograd.grad(loss, self.parameters, allow_unused=True)
            return
        error, leaf = self._cycle(part)
        if self.config.loss.cycle_into_renderer:
            torch.autograd.grad(loss + error, [*self.parameters, leaf], allow_unused=True)
        else:
            torch.autograd.grad(error, leaf)
            torch.autograd.grad(loss, self.parameters, allow_unused=True)

    def _pass(self, part: Inputs) -> Tensor:
        """The squared error of one pass of the bare network."""
        rows, extras = part.rows, part.extras
        is_render = torch.arange(len(part.image), device=self.device) < rows.render
        with self._autocast():
            out = self.model(
                part.attributes,
                part.image,
                torch.where(is_render, 0, LAST),
                torch.where(is_render, LAST, 0),
                extras.attributes,
                extras.image,
                image_prior=extras.prior,
                attribute_rows=slice(rows.render, None) if rows.inverse else None,
                image_rows=slice(0, rows.render) if rows.render else None,
            )
        known = [x for x in (out.attributes, out.image) if x is not None]
        return torch.stack([x.float().square().mean() for x in known]).sum()

    def _cycle(self, part: Inputs) -> tuple[Tensor, Tensor]:
        """The error of what is rendered again, and the input to which its gradient goes."""
        again = slice(part.rows.render, part.rows.render + part.rows.cycle)
        leaf, extras = part.attributes[again].clone().requires_grad_(), part.extras
        clean = torch.zeros(part.rows.cycle, dtype=torch.long, device=self.device)
        with self._autocast():
            out = self.model(
                leaf,
                part.image[again],
                clean,
                clean + LAST,
                extras.attributes[again],
                extras.image[again],
                image_prior=None if extras.prior is None else extras.prior[again],
                attribute_rows=None,
            )
        assert out.image is not None
        return out.image.float().square().mean(), leaf

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, self.dtype, enabled=self.dtype != torch.float32)
