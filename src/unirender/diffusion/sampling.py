"""Sampling: from pure noise at T to x0, in one step or in many.

Two named modes. `mean` is one step from T: with zero terminal SNR and x0-prediction the network's output there is
E[x0 | condition], the best PSNR and no spread. `sample` is the paper's: several steps, several samples; standard
deviations come from it only.

Two named samplers of diffusers, both without noise of their own: `ddim`, of first order, and `unipc`, a multistep
predictor and corrector of second order. Both end with a jump from the last timestep, 1/n of the way up, to E[x0 | x_t]:
this part of the error is of first order in either, and what is left of the spread in it is lost. At T the signal is
zero and log-SNR, UniPC's variable, is minus infinity; diffusers puts alpha_bar = 2^-24 there, which moves a result by
2^-12 at most. DDIM of diffusers strides by 1000 // n timesteps. Where n does not divide 1000 its timesteps lie further
apart than that, and what is amiss adds up over the steps: such steps are made here (`_ddim_step`).
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral
from typing import Any

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor

from unirender.diffusion.schedule import NUM_TIMESTEPS, last_timestep, make_scheduler
from unirender.errors import UnirenderError

SAMPLE_STEPS = 20  # the paper's
NUM_SAMPLES = 5
MOST_STEPS = 500  # of 1000 timesteps; from 667 on a step would start at timestep 0, where nothing is left to do

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

Generators = torch.Generator | Sequence[torch.Generator] | None

Predict = Callable[[Float[Tensor, "b c h w"], Int[Tensor, " b"]], Float[Tensor, "b c h w"]]
Progress = Callable[[Iterable[Any]], Iterable[Any]]
StepEnd = Callable[[int, int, Float[Tensor, "b c h w"]], Float[Tensor, "b c h w"]]


def steps_of(mode: str, num_inference_steps: int | None) -> int:
    """Number of steps of a mode: always 1 for `mean`; for `sample` as asked, or the paper's 20.

    Raises:
        UnirenderError: unknown mode, a number of steps outside [1, 500], or several steps in mode `mean`.
    """
    if mode not in ("mean", "sample"):
        raise UnirenderError(f"mode: got {mode!r}, expected 'mean' (one step, E[x0 | condition]) or 'sample'")
    if num_inference_steps is not None and (
        not is_whole(num_inference_steps) or not 1 <= num_inference_steps <= MOST_STEPS
    ):
        raise UnirenderError(f"num_inference_steps: got {num_inference_steps!r}, expected 1 to {MOST_STEPS}")
    if mode == "mean":
        if num_inference_steps not in (None, 1):
            raise UnirenderError(f"mode mean takes 1 step, got num_inference_steps {num_inference_steps}; use 'sample'")
        return 1
    return SAMPLE_STEPS if num_inference_steps is None else int(num_inference_steps)


def is_whole(value: object) -> bool:
    """Whether it is a whole number, Python's or NumPy's; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


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


def sampler_name(scheduler: Any) -> str:
    """`ddim`, `unipc`, or the class of another scheduler."""
    known = {"DDIMScheduler": "ddim", "UniPCMultistepScheduler": "unipc"}
    return known.get(type(scheduler).__name__, type(scheduler).__name__)


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
