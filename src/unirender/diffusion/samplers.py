"""What takes the steps: two named schedulers of diffusers, and which others can take them.

`ddim` is of first order, `unipc` a multistep predictor and corrector of second order; both draw no noise of their own.
Both end with a jump from the last timestep, 1/n of the way up, to E[x0 | x_t]: this part of the error is of first order
in either, and what is left of the spread in it is lost. At T the signal is zero and log-SNR, UniPC's variable, is minus
infinity; diffusers puts alpha_bar = 2^-24 there, which moves a result by 2^-12 at most.
"""

import functools
from typing import Any

from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Float
from torch import Tensor

from unirender.diffusion.schedule import NUM_TIMESTEPS, make_scheduler
from unirender.errors import UnirenderError

PREDICTION_TYPE = "sample"  # diffusers' name of x0
NO_SIGNAL = 1e-6  # alpha_bar at T: 0, or what diffusers puts there for it
# Of sqrt(alpha_bar), up to which two noise schedules are one; diffusers' own rescaling is off by 0.0005.
SAME_SIGNAL = 0.01
CHANGING_X0 = ("clip_sample", "thresholding")  # settings of schedulers
OTHER_NOISE = tuple(f"use_{kind}" for kind in ("karras_sigmas", "exponential_sigmas", "beta_sigmas", "flow_sigmas"))
DDIM = ("DDIMScheduler", "DDIMParallelScheduler")
FINITE: dict[str, dict[str, Any]] = {  # settings without which steps divide by the signal at T or the noise at the end
    "UniPCMultistepScheduler": {"predict_x0": True, "solver_type": "bh2", "lower_order_final": True},
    "DPMSolverMultistepScheduler": {"algorithm_type": "dpmsolver++", "final_sigmas_type": "zero"},
}
LAST_STEP = ("lower_order_final", "final_sigmas_type")  # those of them that make the last step one of first order
SCHEDULERS = (*DDIM, *FINITE)


def make_sampler(name: str, scheduler: Any) -> Any:
    """The named scheduler of diffusers on the same noise schedule.

    Args:
        name: `ddim` or `unipc`.
        scheduler: any diffusers scheduler with that noise schedule in its config.

    Raises:
        UnirenderError: another name.
    """
    if name == "ddim":
        return DDIMScheduler.from_config(scheduler.config)
    if name == "unipc":
        # Here, since it takes scipy along.
        from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler

        return UniPCMultistepScheduler.from_config(scheduler.config)
    raise UnirenderError(f"sampler: got {name!r}, expected 'ddim' or 'unipc'")


def sampler_name(scheduler: Any) -> str:
    """`ddim`, `unipc`, or the class of another scheduler."""
    known = {"DDIMScheduler": "ddim", "UniPCMultistepScheduler": "unipc"}
    return known.get(type(scheduler).__name__, type(scheduler).__name__)


def check_scheduler(scheduler: Any) -> None:
    """Looks whether several steps can be taken with a scheduler: any other would give wrong maps without a word.

    Raises:
        UnirenderError: it takes what the network predicts, x0, for something else, or changes it; its noise schedule is
            not the network's, which ends in noise alone, or has other timesteps; it would divide by zero there, or
            where all is clean; or it is of another kind, which may draw noise of its own, that no seed would fix, or
            want its input scaled.
    """
    name, config = type(scheduler).__name__, getattr(scheduler, "config", {})
    kinds = {base.__name__ for base in type(scheduler).__mro__}
    if kinds.isdisjoint(SCHEDULERS) or "sde" in (config.get("algorithm_type") or ""):
        raise UnirenderError(
            f"scheduler: got {name}, expected one of {', '.join(SCHEDULERS)} (not of sde): others draw noise of their "
            "own or scale their input"
        )
    check_timesteps(scheduler)
    advice = f"make it by {name}.from_config of the config of the checkpoint's own"
    if config.get("prediction_type") != PREDICTION_TYPE:
        raise UnirenderError(
            f"scheduler: got a {name} with prediction_type {config.get('prediction_type')!r}, expected "
            f"{PREDICTION_TYPE!r}, which the network predicts; {advice}"
        )
    wrong = [key for key in (*CHANGING_X0, *OTHER_NOISE, "use_lu_lambdas") if config.get(key)]
    wrong += [] if config.get("timestep_spacing") == "trailing" else ["timestep_spacing"]
    wrong += [] if float(scheduler.alphas_cumprod[-1]) < NO_SIGNAL else ["rescale_betas_zero_snr"]
    if wrong:
        got = ", ".join(f"{key}={config.get(key)!r}" for key in wrong)
        raise UnirenderError(f"scheduler: got a {name} with {got}, unlike what the network was trained with; {advice}")
    apart = float((scheduler.alphas_cumprod.sqrt().cpu() - _signal()).abs().max())
    if apart > SAME_SIGNAL:
        raise UnirenderError(
            f"scheduler: got a {name} with another noise schedule than the network's: its signal, sqrt(alpha_bar), is "
            f"off by up to {apart:.2f}, expected at most {SAME_SIGNAL}; {advice}"
        )
    ends_in_first_order = config.get("solver_order") == 1 or (
        bool(config.get("euler_at_final")) and "DPMSolverMultistepScheduler" in kinds
    )
    for key, value in [setting for kind in kinds & FINITE.keys() for setting in FINITE[kind].items()]:
        if config.get(key) != value and not (ends_in_first_order and key in LAST_STEP):
            raise UnirenderError(
                f"scheduler: got a {name} with {key}={config.get(key)!r}, expected {value!r}: under a schedule that "
                f"begins without signal and ends without noise, the other answers NaN; {advice}"
            )


def check_timesteps(scheduler: Any) -> None:
    """Looks whether a scheduler counts its timesteps as the network does, which knows pure noise by the last one: in
    one step, too, it would be told of another amount of noise than it sees.

    Raises:
        UnirenderError: it has another number of them.
    """
    name, config = type(scheduler).__name__, getattr(scheduler, "config", {})
    count, betas = config.get("num_train_timesteps"), len(getattr(scheduler, "alphas_cumprod", range(NUM_TIMESTEPS)))
    if {count, betas} != {NUM_TIMESTEPS}:
        got = f"{betas} betas" if count == NUM_TIMESTEPS else f"num_train_timesteps={count!r}"
        raise UnirenderError(
            f"scheduler: got a {name} with {got}, expected {NUM_TIMESTEPS}, with which the network was trained; make "
            f"it by {name}.from_config of the config of the checkpoint's own"
        )


@functools.cache
def _signal() -> Float[Tensor, " t"]:
    """sqrt(alpha_bar) of the noise schedule that all networks are trained with."""
    return make_scheduler().alphas_cumprod.sqrt()
