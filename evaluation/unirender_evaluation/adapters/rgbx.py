"""RGB-to-X as a benchmark method: one Stable Diffusion network, a text prompt for each map (Zeng et al. 2024).

    --method 'unirender_evaluation.adapters.rgbx:RgbToX?folder=FOLDER'

The network denoises the latent of a map beside the latent of the picture (4 + 4 input channels). Latents are those of
*linear* values: picture and albedo without a transfer function, normals as they are in [-1, 1], roughness and metallic
in the first channel. It runs as its authors run it: DDIM, trailing steps down from a zero terminal SNR, no guidance.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from jaxtyping import Float
from torch import Tensor

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.adapters.conditioned import ConditionedDiffusion, Fit, fit
from unirender_evaluation.adapters.folder import FolderMethod, inside, load_parts, part_configs, unit_normal
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.predictions.conventions import AXES, CHOICES, Conventions

PROMPTS = {
    "albedo": "Albedo (diffuse basecolor)",
    "normal": "Camera-space Normal",
    "roughness": "Roughness",
    "metallic": "Metallicness",
}
STEPS, RESOLUTION = 50, 1000  # of the authors' demonstration
SCHEDULE = {"rescale_betas_zero_snr": True, "timestep_spacing": "trailing"}  # as they set it; their file has neither


@dataclass
class RgbToX(FolderMethod):
    """Albedo, normal, roughness and metallic.

    Its irradiance is not asked for: no unit of it is stated, and a scale of ours would be an invention.

    Attributes:
        normal_axes: what the three channels of its normals are in camera axes.
        roughness: whether it means perceptual roughness, or alpha, its square.
    """

    normal_axes: str = "+x+y+z"
    roughness: str = "perceptual"

    def __post_init__(self) -> None:
        super().__post_init__()
        axes = tuple(re.findall("[+-][xyz]", self.normal_axes))
        if "".join(axes) != self.normal_axes or sorted(axis[1] for axis in axes) != list(AXES):
            raise UnirenderError(f"normal_axes: got {self.normal_axes!r}, expected x, y and z once each: +x-y-z")
        if self.roughness not in CHOICES["roughness"]:
            raise UnirenderError(f"roughness: got {self.roughness!r}, expected {' or '.join(CHOICES['roughness'])}")
        self.conventions = Conventions(normal_axes=axes, roughness=self.roughness)
        configs = part_configs(self.folder)
        latent = configs["vae"].get("latent_channels", 4)
        channels = configs["unet"].get("in_channels", 4), configs["unet"].get("out_channels", 4)
        if channels != (2 * latent, latent):
            raise UnirenderError(
                f"{self.folder / 'unet'}: got {channels[0]} input and {channels[1]} output channels, expected "
                f"{2 * latent} and {latent} for a picture and a map; this is no network of RGB-to-X"
            )

    @property
    def config(self) -> dict[str, Any]:
        conventions = {"normal_axes": self.normal_axes, "roughness": self.roughness}
        return self.settings(*self._used) | conventions | {"prompts": PROMPTS}

    @property
    def _used(self) -> tuple[int, int]:
        """Steps and resolution."""
        return self.steps or STEPS, RESOLUTION if self.resolution is None else self.resolution

    @cached_property
    def network(self) -> ConditionedDiffusion:
        """Loaded at the first question."""
        return ConditionedDiffusion(**load_parts(self.folder, DDIMScheduler, self.device, self.dtype, **SCHEDULE))

    def condition(self, image_srgb: Image, mask: Mask) -> tuple[Float[Tensor, "1 c lh lw"], Fit]:
        """The latent of the picture's linear values, and the way back to its size."""
        linear = torch.from_numpy(srgb_decode(self.picture(image_srgb, mask).numpy()))
        fitted, way = fit(2 * linear - 1, self._used[1], self.network.factor)
        return self.network.encode(fitted), way

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        network, steps = self.network, self._used[0]
        condition, way = self.condition(image_srgb, mask)
        decoded = {}
        for name, prompt in PROMPTS.items():
            words, generator = network.words(prompt), self.generator()  # the same noise for every map
            samples = [network.denoise(condition, words, steps, generator) for _ in range(self.ensemble)]
            back = way.back(torch.stack(samples).clamp(-1, 1).mean(dim=0))
            decoded[name] = back[0].movedim(0, -1).numpy()
        return Intrinsics(**contract_maps(decoded, mask, self.conventions), mask=mask, camera=camera)


def contract_maps(
    decoded: dict[str, Float[np.ndarray, "h w 3"]], mask: Mask, conventions: Conventions
) -> dict[str, Float[np.ndarray, "h w c"]]:
    """The contract's maps.

    Args:
        decoded: three channels in [-1, 1] for each of `PROMPTS`.
        mask: coverage.
        conventions: axes of the normals, meaning of the roughness.
    """
    unit = {name: np.clip(value / 2 + 0.5, 0, 1) for name, value in decoded.items()}
    return {
        "albedo": inside(unit["albedo"], mask),
        "normal": unit_normal(conventions.camera_normal(decoded["normal"]), mask),
        "roughness": inside(conventions.perceptual(unit["roughness"][..., :1]), mask),
        "metallic": inside(unit["metallic"][..., :1], mask),
    }
