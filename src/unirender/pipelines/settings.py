"""How the network is asked: the mode, and what follows from it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float

from unirender.arguments import check_switches
from unirender.camera import Camera
from unirender.diffusion.sampling import Generators, StepEnd
from unirender.diffusion.steps import NUM_SAMPLES, is_whole, steps_of
from unirender.errors import UnirenderError
from unirender.pipelines.looks import check_looks

# of `decompose`: how a picture is taken apart, and its default; and all
TAKING_APART = {"looks": 1, "tile": False, "material": None, "closed": True, "flat": False}
NOISE = ("mode", "num_inference_steps", "num_samples", "generator", "sampler", "callback_on_step_end")
SETTINGS = ("camera", *NOISE, "size", *TAKING_APART)
MATERIALS = ("scalar", "map")  # one number per object, or maps
FIXED_SEED = 0  # of the noise in mode `mean`: an expectation depends on no draw


@dataclass(frozen=True)
class Sampling:
    """Steps, samples and noise of one call.

    Attributes:
        mode: `mean` or `sample`.
        steps: of the scheduler; 1 in mode `mean`.
        count: samples.
        generator: of the noise, on the CPU: one, or one for each picture of a batch. None: a fixed noise in mode
            `mean`, torch's global state in mode `sample`.
        looks: at each picture that is taken apart (`unirender.pipelines.looks`); 1 in mode `sample`.
        step_end: is told of every step, and may change what the next one begins with; None: nothing is.
    """

    mode: str
    steps: int
    count: int
    generator: Generators
    looks: int = 1
    step_end: StepEnd | None = None

    @classmethod
    def of(
        cls,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: Generators = None,
        looks: int = 1,
        step_end: StepEnd | None = None,
    ) -> "Sampling":
        """Resolves the arguments of a call.

        Raises:
            UnirenderError: an unknown mode, numbers that do not go with it, or a generator that is none.
        """
        _check_generators(generator)
        steps, count = steps_of(mode, num_inference_steps), _sample_count(mode, num_samples)
        return cls(mode, steps, count, generator, check_looks(looks, mode), step_end)

    def generators(self, pictures: int) -> Generators:
        """The noise of a batch: a picture with a generator of its own, or in mode `mean` without any, gets in it what
        it would get alone; of one generator all draw in turn, as in diffusers.

        Raises:
            UnirenderError: several generators, but not one for each picture.
        """
        if isinstance(self.generator, Sequence) and len(self.generator) != pictures:
            raise UnirenderError(
                f"generator: got {len(self.generator)} for {pictures} pictures, expected one, or one for each picture"
            )
        if self.generator is None and self.mode == "mean":
            return same_noise(FIXED_SEED, pictures)
        return self.generator

    def draw_seed(self) -> int:
        """A seed from the generator's state, which moves on.

        Raises:
            UnirenderError: several generators, but it is asked for one picture.
        """
        own = self.generators(1)
        own = own[0] if isinstance(own, Sequence) else own
        return int(torch.randint(0, 2**62, (), generator=own, device=own.device if own is not None else "cpu"))


def step_end_of(pipeline: Any, callback: Any) -> StepEnd | None:
    """What is done at the end of each step, by diffusers' `callback_on_step_end`.

    Args:
        pipeline: which the callback is told.
        callback: (pipeline, index of the step, timestep, {"latents": tensor}) -> the same dictionary, whose latents
            count from then on, or None; None: there is no callback.

    Raises:
        UnirenderError: it cannot be called; or, at a step, it returns something else, or latents of another kind.
    """
    if callback is None:
        return None
    if not callable(callback):
        raise UnirenderError(
            f"callback_on_step_end: got {callback!r:.60}, expected a function (pipeline, step, timestep, "
            "callback_kwargs) that returns callback_kwargs"
        )

    def step_end(step: int, timestep: int, latents: Float[torch.Tensor, "b c h w"]) -> Float[torch.Tensor, "b c h w"]:
        answer = callback(pipeline, step, timestep, {"latents": latents})
        if answer is None:
            return latents
        if not isinstance(answer, Mapping) or set(answer) - {"latents"}:
            got = sorted(map(str, answer)) if isinstance(answer, Mapping) else repr(answer)
            raise UnirenderError(f"callback_on_step_end: returned {got!s:.60}, expected a dictionary of latents alone")
        changed = answer.get("latents", latents)
        if not isinstance(changed, torch.Tensor) or changed.shape != latents.shape:
            got = list(changed.shape) if isinstance(changed, torch.Tensor) else type(changed).__name__
            raise UnirenderError(
                f"callback_on_step_end: returned latents {got}, expected a tensor {list(latents.shape)} as it was given"
            )
        return changed.to(latents)

    return step_end


def list_cameras(cameras: Any, count: int) -> list[Camera]:
    """One camera for each picture.

    Args:
        cameras: one for all, one for each, or None for the contract's default.
        count: of pictures.

    Raises:
        UnirenderError: something is no camera.
    """
    each = list(cameras) if isinstance(cameras, Iterable) else [Camera() if cameras is None else cameras] * count
    for camera in each:
        if not isinstance(camera, Camera):
            raise UnirenderError(f"camera: got {camera!r}, expected a unirender.camera.Camera, like {Camera()}")
    return each


def check_settings(sampling: Mapping[str, Any], **switches: Any) -> None:
    """Looks at the settings that `edit` and `relight` hand on: with a decomposition at hand nothing else would.

    Args:
        sampling: those settings.
        **switches: their own, as for `check_switches`.

    Raises:
        TypeError: there is no such setting, as Python has it of an argument.
        UnirenderError: as `check_switches`.
    """
    if unknown := sorted(set(sampling) - set(SETTINGS)):
        raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}, expected some of {', '.join(SETTINGS)}")
    check_switches(**switches)


def check_material(material: Any) -> str:
    """What roughness and metallic are, as it was given.

    Raises:
        UnirenderError: neither one number per object nor maps.
    """
    if material not in MATERIALS:
        raise UnirenderError(f"material: got {material!r:.60}, expected 'scalar' or 'map'")
    return material


def same_noise(seed: int, count: int) -> list[torch.Generator]:
    """Generators that all draw the same."""
    return [torch.Generator().manual_seed(seed) for _ in range(count)]


def _check_generators(given: Any) -> None:
    if given is None:
        return
    for own in given if isinstance(given, Sequence) and not isinstance(given, str) else [given]:
        if not isinstance(own, torch.Generator):
            raise UnirenderError(
                f"generator: got {own!r:.60}, expected a torch.Generator, like torch.Generator().manual_seed(0)"
            )


def _sample_count(mode: str, num_samples: int | None) -> int:
    if num_samples is not None and (not is_whole(num_samples) or num_samples < 1):
        raise UnirenderError(f"num_samples: got {num_samples!r}, expected a whole number, at least 1")
    if mode == "mean" and num_samples not in (None, 1):
        raise UnirenderError(f"mode mean gives 1 sample, got num_samples {num_samples}; use mode 'sample'")
    return 1 if mode == "mean" else int(num_samples or NUM_SAMPLES)
