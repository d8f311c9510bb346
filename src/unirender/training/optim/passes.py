"""One batch's gradient, however the batch is cut: over processes, over CPU threads, over time.

Process r of R holds the rows r, r + R, r + 2R, ... of a batch, and cuts them into k parts in the same way: part j takes
every k-th of them. Part p = r + R j is then every (R k)-th row of the batch from p on, whoever computes it. Under the
conditional rule a batch is sorted (rows that render; inverse rows that are rendered again; other inverse rows), so that
every part has its share of each kind. Timesteps of the whole batch and a seed for each part are drawn by every process
alike. Hence the loss depends on the number of parts alone, and on that through the noise alone:

    term = sum over parts p of  mass_p / mass * term_p,      mass_p = weight of the part's rows in the term's mean

On a CPU, two passes on one thread each do not wait for each other at every operation, as the threads of one pass do;
the more others use the cores, the longer that wait: hence parts side by side (`samples_per_s` in the log, with
`--parallel 1` and without, shows what it is worth). On a GPU parts one after the other save memory.
"""

import contextlib
import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unirender.diffusion.schedule import last_timestep
from unirender.diffusion.timesteps import Timesteps, draw_timesteps
from unirender.errors import UnirenderError
from unirender.models.packing import Maps
from unirender.training.config import TrainConfig
from unirender.training.losses.loss_function import LossFunction
from unirender.training.losses.terms import COLOURS, Errors, LossTerms, gradients
from unirender.training.optim.processes import ALONE, Processes

OWN_ROWS = ("image", "environment", "composite", "cycle")  # terms whose means have weights of their own

Gradients = list[Tensor | None]  # by parameter; None: it took no part
ByName = dict[str, float]


@contextlib.contextmanager
def side_by_side(device: torch.device, parallel: int | None = None) -> Iterator[int]:
    """How many parts of a batch run side by side; inside this block each has one thread of its own.

    Args:
        device: of the passes.
        parallel: what is asked for. None: on a CPU as many as PyTorch has threads, elsewhere 1.
    """
    threads = torch.get_num_threads()
    parallel = parallel or (threads if device.type == "cpu" else 1)
    if parallel > 1:
        torch.set_num_threads(1)
    try:
        yield parallel
    finally:
        torch.set_num_threads(threads)


@dataclass(frozen=True)
class Split:
    """How a batch is cut.

    Attributes:
        batch_size: rows of the batch, over all processes.
        processes: that share it.
        parallel: parts that a process computes side by side, at most.
        accumulate: how many times it does so, one after the other, at most.
    """

    batch_size: int
    processes: Processes = ALONE
    parallel: int = 1
    accumulate: int = 1

    def __post_init__(self) -> None:
        if self.batch_size < self.processes.size:
            raise UnirenderError(
                f"training: a batch of {self.batch_size} for {self.processes.size} processes, expected at least one "
                "sample for each; pass a larger --batch-size, or torchrun a smaller --nproc-per-node"
            )

    @property
    def own(self) -> slice:
        """The rows of this process."""
        return slice(self.processes.rank, None, self.processes.size)

    @property
    def parts(self) -> int:
        """Parts of each process; none is empty."""
        return min(self.parallel * self.accumulate, self.batch_size // self.processes.size)

    @property
    def all_parts(self) -> int:
        """Parts of the batch."""
        return self.processes.size * self.parts

    @property
    def at_once(self) -> int:
        """Parts that a process computes side by side."""
        return -(-self.parts // self.accumulate)


@dataclass(frozen=True)
class Part:
    """What one forward pass computes.

    Attributes:
        rows: of the batch that this process holds.
        timesteps: of these rows.
        seed: of noise and dropped maps.
        cycle_share: share of its inverse rows, from the first on, that are rendered again.
        mass: weight of its rows in the mean of each term of `OWN_ROWS`, of those of `COLOURS` ("colours") and of the
            others ("attributes").
    """

    rows: slice
    timesteps: Timesteps
    seed: int
    cycle_share: float
    mass: ByName


class BatchGradient:
    """Sets the gradient of a model's parameters from a batch.

    Args:
        loss: of the model.
        config: timestep rule.
        split: of the batch.
        generator: on the CPU, in the same state on every process; of timesteps, noise and dropped maps.
        dtype: of the autocast; float32: none.
    """

    def __init__(
        self, loss: LossFunction, config: TrainConfig, split: Split, generator: torch.Generator, dtype: torch.dtype
    ) -> None:
        self.loss, self.config, self.split, self.generator, self.dtype = loss, config, split, generator, dtype
        self.pool = ThreadPoolExecutor(split.at_once, "unirender-pass") if split.at_once > 1 else None

    def __call__(self, batch: Maps) -> dict[str, float]:
        """Runs the passes of a batch on the model's device and sums their gradients.

        Args:
            batch: this process's rows.

        Returns:
            The loss terms of the whole batch.
        """
        model: nn.Module = self.loss.model
        parameters = [p for p in model.parameters() if p.requires_grad]
        parts = self.parts(batch)
        mass = _sum(self.split.processes.gather(_sum(part.mass for part in parts)))

        def run(part: Part) -> tuple[Sequence[Tensor | None], ByName]:
            with torch.autocast(batch["image"].device.type, self.dtype, enabled=self.dtype != torch.float32):
                means = self.terms(part, batch)
            shares = {name: part.mass[kind_of(name)] / mass[kind_of(name)] for name in means}
            terms = {name: shares[name] * mean for name, mean in means.items()}
            if not terms:  # Algorithm 1 may leave both streams of a row clean
                return [None] * len(parameters), {}
            found = gradients(self.loss.total(terms), parameters, self.loss.scale)
            return found, {name: float(term.detach()) for name, term in terms.items()}

        summed: Gradients = [None] * len(parameters)
        values: list[ByName] = []
        for first in range(0, len(parts), self.split.at_once):
            some = parts[first : first + self.split.at_once]
            for more, terms in self.pool.map(run, some) if self.pool else map(run, some):
                summed = _plus(summed, more)
                values.append(terms)
        for p, gradient in zip(parameters, self._over_processes(parameters, summed), strict=True):
            p.grad = None if gradient is None else laid_out_like(p, gradient)
        return _sum(self.split.processes.gather(_sum(values)))

    def parts(self, batch: Maps) -> list[Part]:
        """Draws the random numbers of a batch; what this process is to compute of it.

        Raises:
            UnirenderError: the batch does not hold this process's rows.
        """
        split, c = self.split, self.config
        expected = len(range(split.batch_size)[split.own])
        if len(batch["image"]) != expected:
            raise UnirenderError(
                f"training: got {len(batch['image'])} rows, expected {expected} (process {split.processes.rank} of "
                f"{split.processes.size}, batch of {split.batch_size})"
            )
        last = last_timestep(self.loss.scheduler)
        drawn = draw_timesteps(c.timestep_rule, split.batch_size, last, c.p_render, c.p_t, self.generator)
        inverse = (drawn.attributes > 0) & (drawn.image == 0)
        # A share of few rows is no whole number: rounded at random it is right in the mean, of one row too.
        count = int(self.loss.config.cycle_share * int(inverse.sum()) + float(torch.rand((), generator=self.generator)))
        again = inverse & (inverse.cumsum(0) <= count)
        seeds = [int(torch.randint(0, 2**62, (), generator=self.generator)) for _ in range(split.all_parts)]
        weight = self._row_weights(batch["mask"])
        floors = self.loss.config.image_floor, self.loss.config.colour_floor
        of_image, of_colours = (torch.ones_like(weight) if floor else weight for floor in floors)  # see `_decibels`
        parts: list[Part] = []
        for j in range(split.parts):
            rows = slice(j, None, split.parts)
            t_attributes, t_image, is_inverse, is_again = (
                of_batch[split.own][rows] for of_batch in (drawn.attributes, drawn.image, inverse, again)
            )
            weights = {
                "image": of_image[rows][t_image > 0],
                "attributes": weight[rows][t_attributes > 0],
                "colours": of_colours[rows][t_attributes > 0],
                "environment": t_attributes > 0,
                "composite": weight[rows][is_inverse],
                "cycle": weight[rows][is_again],
            }
            mass = {kind: float(of_rows.sum()) for kind, of_rows in weights.items()}
            seed = seeds[split.processes.rank + split.processes.size * j]
            cycle_share = int(is_again.sum()) / max(1, int(is_inverse.sum()))
            parts.append(Part(rows, Timesteps(t_attributes, t_image), seed, cycle_share, mass))
        return parts

    def terms(self, part: Part, batch: Maps) -> LossTerms:
        """The loss terms of a part, each a mean over the part's rows."""
        device = batch["image"].device
        rows = {name: value[part.rows] for name, value in batch.items()}
        t = Timesteps(part.timesteps.attributes.to(device), part.timesteps.image.to(device))
        # The cycle has a share of the batch's inverse rows. Of the part's own, if there is but one, it would have none.
        config = dataclasses.replace(self.loss.config, cycle_share=part.cycle_share)
        loss = dataclasses.replace(self.loss, config=config)
        return loss.terms(rows, t, torch.Generator().manual_seed(part.seed))

    def _row_weights(self, mask: Tensor) -> Float[Tensor, " b"]:
        """Weight of each row in a mean over pixels, on the CPU."""
        errors = Errors(self.loss.conditioning, self.loss.config.background)
        return errors.pixel_weights(mask.double()).sum(dim=(1, 2, 3)).cpu()

    def _over_processes(self, parameters: Sequence[Tensor], own: Gradients) -> Gradients:
        """Sums over the processes. A parameter that took no part in any of them keeps None as its gradient."""
        processes = self.split.processes
        here = [gradient is not None for gradient in own]
        used = [any(flags) for flags in zip(*processes.gather(here), strict=True)]
        held = [
            torch.zeros_like(p) if gradient is None else gradient
            for p, gradient, is_used in zip(parameters, own, used, strict=True)
            if is_used
        ]
        summed = iter(processes.sum(held))
        return [next(summed) if is_used else None for is_used in used]


def kind_of(term: str) -> str:
    """The name under which `Part.mass` has the weights of a loss term's mean."""
    return term if term in OWN_ROWS else "colours" if term in COLOURS else "attributes"


def _plus(summed: Sequence[Tensor | None], more: Sequence[Tensor | None]) -> Gradients:
    """Sums by parameter. Not in place: autograd may give two parameters one tensor."""
    pairs = list(zip(summed, more, strict=True))
    sums = [other if own is None else own for own, other in pairs]
    both = {i: (own, other) for i, (own, other) in enumerate(pairs) if own is not None and other is not None}
    if both:
        firsts, seconds = zip(*both.values(), strict=True)
        added = torch._foreach_add(firsts, seconds)  # pyright: ignore[reportPrivateImportUsage] - torch.optim uses it
        for i, total in zip(both, added, strict=True):
            sums[i] = total
    return sums


def laid_out_like(p: Tensor, values: Tensor) -> Tensor:
    """A gradient, or a moment of it, with its values in memory as the parameter's: on a CPU the fused optimiser goes
    through all of them side by side without looking at strides."""
    return values if values.stride() == p.stride() else torch.empty_like(p).copy_(values)


def _sum(terms: Iterable[ByName]) -> ByName:
    """Name by name."""
    sums: defaultdict[str, float] = defaultdict(float)
    for one in terms:
        for name, value in one.items():
            sums[name] += value
    return dict(sums)
