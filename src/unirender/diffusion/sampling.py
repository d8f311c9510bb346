"""Sampling: from pure noise at T to x0, in one step or in many.

Two named modes. `mean` is one step from T: with zero terminal SNR and x0-prediction the network's output there is
E[x0 | condition], the best PSNR and no spread. `sample` is the paper's: several DDIM steps, several samples; standard
deviations come from it only. Any diffusers scheduler that predicts samples does.
"""

from collections.abc import Callable, Iterable
from typing import Any, Literal

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unirender.camera import Camera
from unirender.diffusion.schedule import NUM_TIMESTEPS, last_timestep
from unirender.errors import UnirenderError
from unirender.models.conditioning import TRIPLETS, Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.priors import Maps

Mode = Literal["mean", "sample"]
SAMPLE_STEPS = 20  # the paper's
NUM_SAMPLES = 5

Predict = Callable[[Float[Tensor, "b c h w"], Int[Tensor, " b"]], Float[Tensor, "b c h w"]]
Progress = Callable[[Iterable[Any]], Iterable[Any]]


def steps_of(mode: str, num_inference_steps: int | None) -> int:
    """Number of steps of a mode: always 1 for `mean`; for `sample` as asked, or the paper's 20.

    Raises:
        UnirenderError: unknown mode, a number of steps outside [1, 1000], or several steps in mode `mean`.
    """
    if mode not in ("mean", "sample"):
        raise UnirenderError(f"mode: got {mode!r}, expected 'mean' (one step, E[x0 | condition]) or 'sample'")
    if num_inference_steps is not None and not 1 <= num_inference_steps <= NUM_TIMESTEPS:
        raise UnirenderError(f"num_inference_steps: got {num_inference_steps}, expected 1 to {NUM_TIMESTEPS}")
    if mode == "mean":
        if num_inference_steps not in (None, 1):
            raise UnirenderError(f"mode mean takes 1 step, got num_inference_steps {num_inference_steps}; use 'sample'")
        return 1
    return num_inference_steps or SAMPLE_STEPS


def denoise(
    predict: Predict,
    noise: Float[Tensor, "b c h w"],
    scheduler: Any,
    steps: int,
    generator: torch.Generator | None = None,
    progress: Progress = iter,
) -> Float[Tensor, "b c h w"]:
    """Runs `steps` scheduler steps from T down to clean.

    Args:
        predict: (x_t, t) -> x0.
        noise: x_T.
        scheduler: a diffusers scheduler with `prediction_type="sample"`; its timesteps are set here.
        steps: 1 returns the prediction at T itself.
        generator: for schedulers that draw noise; DDIM at eta 0 does not.
        progress: wraps the iteration over timesteps.
    """
    if steps == 1:
        t = torch.full((len(noise),), last_timestep(scheduler), device=noise.device)
        return predict(noise, t)
    scheduler.set_timesteps(steps, device=noise.device)
    extra: dict[str, Any] = {"generator": generator} if type(scheduler) is DDIMScheduler else {}
    x_t = noise * scheduler.init_noise_sigma
    for t in progress(scheduler.timesteps):
        x_0 = predict(x_t, t.expand(len(x_t)))
        x_t = scheduler.step(x_0, t, x_t, return_dict=False, **extra)[0]
    return x_t


def draw_noise(
    shape: tuple[int, ...], like: Tensor, generator: torch.Generator | None = None
) -> Float[Tensor, "b c h w"]:
    """Gaussian noise of dtype and device of `like`, drawn on the generator's device (CPU without one), row by row:
    a row's noise does not depend on how many follow it.
    """
    device = generator.device if generator is not None else torch.device("cpu")
    rows = [torch.randn(shape[1:], generator=generator, device=device) for _ in range(shape[0])]
    return torch.stack(rows).to(like)


@torch.no_grad()
def infer_attributes(
    model: DualStreamModel,
    conditioning: Conditioning,
    scheduler: Any,
    image_linear: Float[Tensor, "b 3 H W"],
    mask: Float[Tensor, "b 1 H W"],
    *,
    steps: int = 1,
    generator: torch.Generator | None = None,
    camera: Camera | None = None,
    progress: Progress = iter,
) -> Maps:
    """Inverse rendering: p(attributes | image).

    Args:
        image_linear: premultiplied, linear; clipped to [0, 1] as a camera does.
        mask: coverage.

    Returns:
        Maps as `Packing.unpack` gives them: float32, in physical units.
    """
    image = conditioning.encode_image(image_linear).to(model.dtype)
    given = torch.zeros(len(image), len(TRIPLETS), dtype=torch.bool, device=image.device)
    extras = conditioning.extras(mask, given, camera=camera)
    clean = torch.zeros(len(image), dtype=torch.long, device=image.device)

    def predict(x_t: Tensor, t: Tensor) -> Tensor:
        output = model(
            x_t.to(image), image, t, clean, extras.attributes.to(image), extras.image.to(image), image_rows=None
        )
        return output.attributes.to(x_t)

    noise = draw_noise((len(image), conditioning.attribute_channels, *image.shape[-2:]), image_linear, generator)
    return conditioning.decode_attributes(denoise(predict, noise, scheduler, steps, generator, progress).float())


@torch.no_grad()
def infer_image(
    model: DualStreamModel,
    conditioning: Conditioning,
    scheduler: Any,
    maps: Maps,
    given: Bool[Tensor, "b 6"],
    *,
    steps: int = 1,
    generator: torch.Generator | None = None,
    camera: Camera | None = None,
    progress: Progress = iter,
) -> Float[Tensor, "b 3 H W"]:
    """Rendering: p(image | attributes).

    Args:
        maps: all maps; those not `given` may hold anything and are replaced by noise.
        given: which of the six pictures are known; the mask in `maps` always is.

    Returns:
        Premultiplied linear image in [0, 1].
    """
    latents = conditioning.encode_attributes(maps)
    noise = draw_noise(tuple(latents.shape), latents, generator)
    attributes = torch.where(conditioning.by_triplet(given), latents, noise).to(model.dtype)
    extras = conditioning.extras(maps["mask"], given, maps, camera)
    clean = torch.zeros(len(attributes), dtype=torch.long, device=attributes.device)

    def predict(x_t: Tensor, t: Tensor) -> Tensor:
        output = model(
            attributes,
            x_t.to(attributes),
            clean,
            t,
            extras.attributes.to(attributes),
            extras.image.to(attributes),
            image_prior=extras.prior,  # float32 whatever the weights are: the sum keeps the composite's precision
            attribute_rows=None,
        )
        return output.image.to(x_t)

    noise = draw_noise((len(latents), conditioning.codec.channels, *latents.shape[-2:]), latents, generator)
    return conditioning.decode_image(denoise(predict, noise, scheduler, steps, generator, progress).float())
