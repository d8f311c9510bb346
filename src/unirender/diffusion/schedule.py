"""The noise schedule: zero terminal SNR, timestep 0 exactly clean.

    x_t = sqrt(alpha_bar_t) x_0 + sqrt(1 - alpha_bar_t) eps,    alpha_bar_0 = 1,  alpha_bar_T = 0,  T = the last index

Stable Diffusion's schedule is shifted and scaled so that both ends are exact (Lin et al. 2024, algorithm 1, extended
to the first step). The network predicts x_0; sampling spaces its steps from T downwards ("trailing").
"""

import torch
from diffusers.configuration_utils import ConfigMixin
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor

NUM_TIMESTEPS = 1000
BETA_START, BETA_END = 0.00085, 0.012  # Stable Diffusion's "scaled linear"


def zero_terminal_betas(num_timesteps: int = NUM_TIMESTEPS) -> list[float]:
    """Betas with `beta_0 = 0` (clean) and `beta_T = 1` (pure noise)."""
    betas = torch.linspace(BETA_START**0.5, BETA_END**0.5, num_timesteps, dtype=torch.float64) ** 2
    root = torch.cumprod(1 - betas, dim=0).sqrt()
    alpha_bar = ((root - root[-1]) / (root[0] - root[-1])) ** 2
    alphas = torch.cat([alpha_bar[:1], alpha_bar[1:] / alpha_bar[:-1]])
    return (1 - alphas).tolist()


def make_scheduler(num_timesteps: int = NUM_TIMESTEPS) -> DDIMScheduler:
    """The diffusers scheduler of this schedule."""
    return DDIMScheduler(
        num_train_timesteps=num_timesteps,
        trained_betas=zero_terminal_betas(num_timesteps),  # pyright: ignore[reportArgumentType] - a list, for its JSON
        rescale_betas_zero_snr=True,  # changes nothing here; tells other schedulers made from this config
        prediction_type="sample",
        timestep_spacing="trailing",
        clip_sample=False,
        set_alpha_to_one=True,
    )


def last_timestep(scheduler: ConfigMixin) -> int:
    """T, of any scheduler of diffusers."""
    return int(scheduler.config["num_train_timesteps"]) - 1


def add_noise(
    scheduler: DDIMScheduler,
    clean: Float[Tensor, "b c h w"],
    noise: Float[Tensor, "b c h w"],
    timestep: Int[Tensor, " b"],
) -> Float[Tensor, "b c h w"]:
    """x_t; exactly `clean` at 0 and exactly `noise` at T."""
    alpha_bar = scheduler.alphas_cumprod.to(clean.device)[timestep][:, None, None, None]
    return alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * noise
