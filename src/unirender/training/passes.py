"""One batch's gradient: forward passes by direction, cut into parts that run side by side on a CPU.

On a CPU that others use too, two passes on one thread each are far faster than one pass on two threads, which wait for
each other at every operation (measured: 10 against 0.5 samples/s under load).
"""

import functools
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from unirender.diffusion.schedule import last_timestep
from unirender.diffusion.timesteps import Timesteps, draw_timesteps
from unirender.models.priors import Maps
from unirender.training.losses import LossFunction, LossTerms
from unirender.training.presets import TrainConfig


@dataclass(frozen=True)
class Pass:
    """A forward pass: its share of the batch, and the function that gives its loss terms."""

    share: float
    terms: Callable[[], LossTerms]


class BatchGradient:
    """Sets the gradient of a model's parameters from a batch.

    Args:
        loss: of the model.
        config: batch and timestep rule.
        parallel: parts that run side by side, at most; none is without a row of each kind that the batch has.
        generator: on the CPU; of timesteps, noise and dropped maps.
        dtype: of the autocast; float32: none.
    """

    def __init__(
        self, loss: LossFunction, config: TrainConfig, parallel: int, generator: torch.Generator, dtype: torch.dtype
    ) -> None:
        self.loss, self.config, self.parallel, self.generator, self.dtype = loss, config, parallel, generator, dtype
        self.pool = ThreadPoolExecutor(parallel, "unirender-pass") if parallel > 1 else None

    def __call__(self, batch: Maps) -> dict[str, float]:
        """Runs the passes of a batch on the model's device; sums their gradients and averages their loss terms."""
        model: nn.Module = self.loss.model
        parameters, device = list(model.parameters()), batch["image"].device

        def run(part: Pass) -> tuple[tuple[Tensor | None, ...], dict[str, Tensor]]:
            with torch.autocast(device.type, self.dtype, enabled=self.dtype != torch.float32):
                terms = part.terms()
            loss = part.share * self.loss.total(terms)
            return torch.autograd.grad(loss, parameters, allow_unused=True), terms

        passes = list(self._passes(batch))
        results = list(self.pool.map(run, passes)) if self.pool else [run(part) for part in passes]
        for p, *gradients in zip(parameters, *(grads for grads, _ in results), strict=True):
            known = [g for g in gradients if g is not None]
            p.grad = sum(known[1:], start=known[0]) if known else None
        weighted: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for part, (_, terms) in zip(passes, results, strict=True):
            for name, value in terms.items():
                weighted[name].append((part.share, float(value.detach())))
        return {name: sum(w * v for w, v in pairs) / sum(w for w, _ in pairs) for name, pairs in weighted.items()}

    def _passes(self, batch: Maps) -> Iterator[Pass]:
        size, c = len(batch["image"]), self.config
        last = last_timestep(self.loss.scheduler)
        drawn = draw_timesteps(c.timestep_rule, size, last, c.p_render, c.p_t, self.generator)
        if c.timestep_rule == "conditional":  # rendering samples come first; every part gets its share of both kinds
            count = int((drawn.attributes == 0).sum())
            kinds = [rows for rows in (torch.arange(count), torch.arange(count, size)) if len(rows)]
        else:
            kinds = [torch.arange(size)]
        number = min(self.parallel, *map(len, kinds))  # a part without a kind would drop its share of that kind's loss
        parts = [torch.cat(rows) for rows in zip(*(rows.tensor_split(number) for rows in kinds), strict=True)]
        terms = self.loss.terms if c.timestep_rule == "conditional" else self.loss.joint_terms
        for rows in parts:
            part = {name: value[rows] for name, value in batch.items()}
            device = batch["image"].device
            t = Timesteps(drawn.attributes[rows].to(device), drawn.image[rows].to(device))
            seed = int(torch.randint(0, 2**62, (), generator=self.generator))
            generator = torch.Generator().manual_seed(seed)
            yield Pass(len(rows) / size, functools.partial(terms, part, t, generator))
