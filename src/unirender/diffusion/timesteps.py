"""The timesteps of the two streams in training: the paper has two rules, which differ.

Section 3.2 (`conditional`, the default): one stream is always clean, the other at t with probability p_t, else at T.

    (t_attributes, t_image) = (0, t~) when rendering, (t~, 0) when inverse             (Eq. 3)
    t~ = t with probability p_t, T otherwise                                           (Eq. 4)

Notation: `t_tilde` is t~, `last` is T.

Algorithm 1 of the supplement (`algorithm1`): one stream, the same for the whole batch, gets uniform timesteps in
[0, T]; each entry of the other is 0 or T. Here both streams can be noisy at once, which Section 3.2 rules out.

The paper uses one letter p for two things and gives neither: `p_render` (rendering or inverse) and `p_t`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from unirender.errors import UnirenderError


@dataclass(frozen=True)
class Timesteps:
    """Timesteps of a batch; 0 clean, T pure noise."""

    attributes: Int[Tensor, " b"]
    image: Int[Tensor, " b"]


def conditional_timesteps(batch: int, last: int, p_render: float, p_t: float, generator: torch.Generator) -> Timesteps:
    """Eq. 3 and Eq. 4. The rendering samples come first; their share of a batch is exact up to random rounding.

    Args:
        batch: samples.
        last: T.
        p_render: probability of rendering; the rest is inverse rendering.
        p_t: probability that the noisy stream is at a random t in [1, T - 1] instead of T.
        generator: CPU generator.
    """
    rendering = int(batch * p_render + torch.rand((), generator=generator).item())
    is_render = torch.arange(batch) < rendering
    partial = torch.rand(batch, generator=generator) < p_t
    t = torch.randint(1, last, (batch,), generator=generator)
    t_tilde = torch.where(partial, t, last)  # Eq. 4
    return Timesteps(attributes=torch.where(is_render, 0, t_tilde), image=torch.where(is_render, t_tilde, 0))  # Eq. 3


def algorithm1_timesteps(batch: int, last: int, generator: torch.Generator) -> Timesteps:
    """Algorithm 1 of the supplement, vectorised; it fills the array that the pseudo-code forgets to return."""
    timesteps = torch.randint(0, 2, (2, batch), generator=generator) * last
    index = int(torch.randint(0, 2, (), generator=generator))
    timesteps[index] = torch.randint(0, last + 1, (batch,), generator=generator)
    return Timesteps(attributes=timesteps[0], image=timesteps[1])


def draw_timesteps(
    rule: str, batch: int, last: int, p_render: float, p_t: float, generator: torch.Generator
) -> Timesteps:
    """Timesteps by the named rule.

    Raises:
        UnirenderError: an unknown rule.
    """
    if rule == "conditional":
        return conditional_timesteps(batch, last, p_render, p_t, generator)
    if rule == "algorithm1":
        return algorithm1_timesteps(batch, last, generator)
    raise UnirenderError(f"timestep rule: got {rule!r}, expected 'conditional' or 'algorithm1'")
