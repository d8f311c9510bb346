"""Sampling: from pure noise at T to x0, in one step or in many (`unirender.diffusion.steps`).

    x_s = sqrt(alpha_bar_s) x_0' + sqrt(1 - alpha_bar_s) (x_t - sqrt(alpha_bar_t) x_0') / sqrt(1 - alpha_bar_t)

is a step of DDIM without noise, to any earlier timestep s (Song, Meng and Ermon 2021, eq. 12); x_0' is what the network
predicts at t. Steps are those of a scheduler of diffusers (`unirender.diffusion.samplers`). Its DDIM strides by 1000 //
n timesteps: where n does not divide 1000 its timesteps lie further apart than that, and what is amiss adds up over the
steps. Such steps are made here (`_ddim_step`).
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unirender.diffusion.samplers import DDIM
from unirender.diffusion.schedule import last_timestep

Generators = torch.Generator | Sequence[torch.Generator] | None

Predict = Callable[[Float[Tensor, "b c h w"], Int[Tensor, " b"]], Float[Tensor, "b c h w"]]
Progress = Callable[[Iterable[Any]], Iterable[Any]]
StepEnd = Callable[[int, int, Float[Tensor, "b c h w"]], Float[Tensor, "b c h w"]]


def denoise(
    predict: Predict,
    noise: Float[Tensor, "b c h w"],
    scheduler: Any,
    steps: int,
    progress: Progress = iter,
    step_end: StepEnd | None = None,
) -> Float[Tensor, "b c h w"]:
    """Runs `steps` scheduler steps from T down to clean.

    Args:
        predict: (x_t, t) -> x0.
        noise: x_T.
        scheduler: a diffusers scheduler with `prediction_type="sample"` that draws no noise; its timesteps are set
            here.
        steps: 1 returns the prediction at T itself.
        progress: wraps the iteration over timesteps.
        step_end: (index of the step, its timestep, what came out) -> what the next step begins with.
    """
    if steps == 1:
        last = last_timestep(scheduler)
        x_0 = predict(noise, torch.full((len(noise),), last, device=noise.device))
        return x_0 if step_end is None else step_end(0, last, x_0)
    set_timesteps(scheduler, steps, noise.device)
    x_t = noise * scheduler.init_noise_sigma
    uneven = _strides_unevenly(scheduler, steps)
    following = [*scheduler.timesteps[1:], None]
    for step, (t, next_t) in enumerate(zip(progress(scheduler.timesteps), following, strict=True)):
        x_0 = predict(x_t, t.expand(len(x_t)))
        if uneven:
            x_t = _ddim_step(scheduler, x_0, x_t, t, next_t)
        else:
            x_t = scheduler.step(x_0, t, x_t, return_dict=False)[0]
        if step_end is not None:
            x_t = step_end(step, int(t), x_t)
    return x_t


def set_timesteps(scheduler: Any, steps: int, device: torch.device) -> None:
    """Sets the timesteps of a diffusers scheduler: as many as there are steps.

    diffusers counts trailing ones down in floating point. For 29 numbers of steps up to 500 (61 is the first) it ends
    with one too many: -1, the index of pure noise.
    """
    scheduler.set_timesteps(steps, device=device)
    if len(scheduler.timesteps) > steps:
        scheduler.timesteps = scheduler.timesteps[:steps]
        scheduler.num_inference_steps = steps
        if hasattr(scheduler, "sigmas"):  # of every timestep, and of the end
            scheduler.sigmas = torch.cat([scheduler.sigmas[:steps], scheduler.sigmas[-1:]])


def _strides_unevenly(scheduler: Any, steps: int) -> bool:
    """Whether it is a DDIM whose timesteps (trailing) are not 1000 // steps apart, as its `step` takes them to be."""
    is_ddim = any(base.__name__ in DDIM for base in type(scheduler).__mro__)
    return is_ddim and scheduler.config.num_train_timesteps % steps != 0


def _ddim_step(
    scheduler: Any,
    x_0: Float[Tensor, "b c h w"],
    x_t: Float[Tensor, "b c h w"],
    t: Int[Tensor, ""],
    following: Int[Tensor, ""] | None,
) -> Float[Tensor, "b c h w"]:
    """DDIM's step without noise (Song, Meng and Ermon 2021, eq. 12) to any earlier timestep; None: to x0."""
    end = scheduler.final_alpha_cumprod
    now, then = scheduler.alphas_cumprod[t], end if following is None else scheduler.alphas_cumprod[following]
    noise = (x_t - now.sqrt() * x_0) / (1 - now).sqrt()
    return then.sqrt() * x_0 + (1 - then).sqrt() * noise


def draw_noise(shape: tuple[int, ...], like: Tensor, generator: Generators = None) -> Float[Tensor, "b c h w"]:
    """Gaussian noise of dtype and device of `like`, drawn in float32 on the generator's device (CPU without one), row
    by row: a row's noise does not depend on how many follow it, nor on torch's default dtype.

    Args:
        shape: of the noise; its first number is that of rows.
        like: a tensor of the right dtype and device.
        generator: one for all rows, or several, each for an equal share of the rows, in order.

    Raises:
        ValueError: the rows cannot be shared equally.
    """
    generators = generator if isinstance(generator, Sequence) else [generator]
    if not generators or shape[0] % len(generators):
        raise ValueError(f"{len(generators)} generators for {shape[0]} rows, expected the same number of rows for each")
    rows = [
        torch.randn(shape[1:], generator=own, device=own.device if own is not None else "cpu", dtype=torch.float32)
        for own in generators
        for _ in range(shape[0] // len(generators))
    ]
    return torch.stack([row.to(like) for row in rows])
