"""Muon: a matrix steps along the orthogonal factor of its momentum, so that all its directions learn alike.

    M <- mu M + (1 - mu) G,    N = mu M + (1 - mu) G = U S V',    W <- (1 - rate decay) W - rate scale U V'

(Jordan et al. 2024, "Muon: an optimizer for hidden layers in neural networks".) With scale = 0.2 sqrt(max(rows,
columns)) the step's root mean square is that of AdamW's, so that both can have one learning rate (Liu et al. 2025,
"Muon is scalable for LLM training"). A convolution's kernel is the matrix (out, in x rows x columns). AdamW keeps what
carries numbers from outside or to it, or begins at zero (first and last convolutions, the embedding of time, the
connections between streams), small matrices, and all vectors.

U V' comes from five steps of a Newton-Schulz iteration, X <- a X + b X X' X + c (X X')^2 X, which takes singular values
of [0.01, 1] to about [0.7, 1.2]: near enough. Each step multiplies X from the left by a polynomial of X X', so the
polynomials are multiplied first, in the smaller dimension, and X once:

    A <- X X',    Q <- 1,    5 times:  P = a + b A + c A^2,    Q <- P Q,    A <- P A P';      U V' = Q X
"""

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unirender.training.config import OptimizerConfig

STEPS, A, B, C = 5, 3.4445, -4.775, 2.0315  # of the iteration; Jordan et al.
STEP_RMS = 0.2  # of AdamW's update; Liu et al.
LEAST_SIDE = 32  # smaller matrices have few directions
KEPT = frozenset(("conv_in", "conv_out", "time_embedding", "attribute_extra", "image_extra"))
KEPT_BETWEEN = frozenset(("attributes_to_image", "image_to_attributes"))


def is_hidden_matrix(name: str, parameter: Tensor) -> bool:
    """Whether Muon takes a network's parameter."""
    parts = set(name.split("."))
    if parameter.dim() < 2 or (KEPT | KEPT_BETWEEN) & parts:
        return False
    return min(matrix_shape(parameter)) >= LEAST_SIDE


def matrix_shape(parameter: Tensor) -> tuple[int, int]:
    """Rows and columns of a weight: output channels, and all else."""
    return parameter.shape[0], parameter.numel() // parameter.shape[0]


def orthogonal_factor(matrices: Float[Tensor, "n rows columns"]) -> Float[Tensor, "n rows columns"]:
    """About U V' of each matrix U S V'; zeros for a matrix of zeros."""
    if matrices.shape[1] > matrices.shape[2]:
        return orthogonal_factor(matrices.mT).mT
    x = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp_min(1e-20)
    a = x @ x.mT
    q = a
    for step in range(STEPS):
        p = torch.baddbmm(a, a, a, beta=B, alpha=C)
        p.diagonal(dim1=1, dim2=2).add_(A)
        q = p @ q if step else p
        if step < STEPS - 1:
            a = p @ a @ p.mT
    return q @ x


class Muon(torch.optim.Optimizer):
    """Of matrices alone; each has its output channels outermost in memory, and so has its gradient.

    Args:
        params: weights with at least two dimensions.
        lr: learning rate.
        momentum: mu.
        weight_decay: decoupled, times the learning rate.
        pool: computes the iterations of several shapes side by side; None: one after the other.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: float,
        momentum: float = 0.95,
        weight_decay: float = 0.01,
        pool: Executor | None = None,
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})
        self.pool = pool

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # pyright: ignore[reportIncompatibleMethodOverride] - one overload
        """One step of every parameter that has a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            weights = [p for p in group["params"] if p.grad is not None]
            for p in weights:
                if "momentum" not in self.state[p]:
                    self.state[p]["momentum"] = torch.zeros_like(p)
            by_shape: defaultdict[tuple[int, int], list[Tensor]] = defaultdict(list)
            for p in weights:
                by_shape[matrix_shape(p)].append(p)
            costliest_first = sorted(by_shape.values(), key=_cost, reverse=True)
            run = self.pool.map if self.pool else map
            list(run(self._update, costliest_first, itertools.repeat(group)))
        return loss

    @torch.no_grad()  # the mode is a thread's own
    def _update(self, weights: Sequence[Tensor], group: dict[str, Any]) -> None:
        """Of weights of one shape."""
        mu, rate = group["momentum"], group["lr"]
        directions = []
        for p in weights:
            momentum, gradient = _matrix(self.state[p]["momentum"]), _matrix(p.grad)
            momentum.lerp_(gradient, 1 - mu)
            directions.append(gradient.lerp(momentum, mu))
        steps = orthogonal_factor(torch.stack(directions))
        scale = STEP_RMS * math.sqrt(max(steps.shape[1:]))
        for p, step in zip(weights, steps, strict=True):
            _matrix(p).mul_(1 - rate * group["weight_decay"]).add_(step, alpha=-rate * scale)


class Together:
    """Several optimisers of one network as one."""

    def __init__(self, *parts: torch.optim.Optimizer) -> None:
        self.parts = parts

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """Of all of them, to be changed in place."""
        return [group for part in self.parts for group in part.param_groups]

    @property
    def state(self) -> dict[Tensor, dict[str, Any]]:
        """What is kept of each parameter, to be changed in place."""
        return dict(itertools.chain.from_iterable(part.state.items() for part in self.parts))

    def step(self) -> None:
        for part in self.parts:
            part.step()

    def state_dict(self) -> dict[str, Any]:
        return {"parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for part, own in zip(self.parts, state["parts"], strict=True):
            part.load_state_dict(own)


def make_optimizer(
    model: nn.Module, config: OptimizerConfig, pool: Executor | None = None
) -> torch.optim.Optimizer | Together:
    """The optimiser of a config's `kind`.

    Args:
        model: on its device, its kernels laid out as they will be trained.
        config: learning rate, moments, weight decay.
        pool: of threads that are idle between the passes.
    """

    def adamw(params: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        # fused: one pass over the weights instead of ten; a state from before keeps the way it was made with
        betas = (config.beta1, config.beta2)
        return torch.optim.AdamW(params, config.learning_rate, betas, weight_decay=config.weight_decay, fused=True)

    if config.kind == "adamw":
        return adamw(model.parameters())
    named = dict(model.named_parameters())
    hidden = {name: p for name, p in named.items() if is_hidden_matrix(name, p)}
    rest = [p for name, p in named.items() if name not in hidden]
    muon = Muon(hidden.values(), config.learning_rate, weight_decay=config.weight_decay, pool=pool)
    return Together(muon, adamw(rest))


def _cost(same: Sequence[Tensor]) -> int:
    """About the multiplications of `orthogonal_factor`."""
    small, large = sorted(matrix_shape(same[0]))
    return len(same) * small * small * (2 * large + 3 * STEPS * small)


def _matrix(values: Tensor | None) -> Float[Tensor, "rows columns"]:
    """A view of a weight, or of its gradient, in the order of memory: that of the columns makes no difference."""
    assert values is not None, "only parameters with a gradient come here"
    rows, columns = matrix_shape(values)
    assert values.stride(0) == columns, "output channels are outermost, without gaps"
    return values.as_strided((rows, columns), (columns, 1))
