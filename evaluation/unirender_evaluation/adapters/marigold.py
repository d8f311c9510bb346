"""Marigold's pipelines of diffusers as benchmark methods: intrinsic images (appearance, lighting) and normals.

    --method 'unirender_evaluation.adapters.marigold:MarigoldIntrinsics?folder=FOLDER'
    --method 'unirender_evaluation.adapters.marigold:MarigoldNormals?folder=FOLDER'

How predictions become the contract's maps: `adapters_marigold_maps`.
"""

import inspect
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

from diffusers.pipelines.marigold.pipeline_marigold_intrinsics import MarigoldIntrinsicsPipeline
from diffusers.pipelines.marigold.pipeline_marigold_normals import MarigoldNormalsPipeline
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_lcm import LCMScheduler

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.adapters.folder import (
    FolderMethod,
    load_parts,
    load_scheduler,
    part_configs,
    read_json,
    unit_normal,
)
from unirender_evaluation.adapters.marigold_maps import check_properties, decoded_targets, target_maps
from unirender_evaluation.methods.method import Image, Mask

SCHEDULERS = {"DDIMScheduler": DDIMScheduler, "LCMScheduler": LCMScheduler}
DEFAULTS = {"steps": "default_denoising_steps", "resolution": "default_processing_resolution"}


@dataclass
class _Marigold(FolderMethod):
    """What the two pipelines have in common.

    Attributes:
        index: the folder's `model_index.json`.
    """

    kind: ClassVar[Any]  # diffusers' class
    index: dict[str, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        path = self.folder / "model_index.json"
        self.index = read_json(path, f"the index of a {self.kind.__name__}")
        if self.index.get("_class_name") != self.kind.__name__:
            raise UnirenderError(
                f"{path}: got the pipeline {self.index.get('_class_name')!r}, expected {self.kind.__name__!r}"
            )
        for setting, key in DEFAULTS.items():
            if getattr(self, setting) is None and not isinstance(self.index.get(key), int):
                raise UnirenderError(f"{path}: has no {key}, expected a number; say {setting}= yourself")
        configs = part_configs(self.folder)
        latent = configs["vae"].get("latent_channels", 4)
        unet = configs["unet"].get("in_channels", 4), configs["unet"].get("out_channels", 4)
        wanted = latent * (self.targets + 1), latent * self.targets
        if unet != wanted:
            raise UnirenderError(
                f"{self.folder / 'unet'}: got {unet[0]} input and {unet[1]} output channels, expected {wanted[0]} and "
                f"{wanted[1]} for a picture and {self.targets} targets; use the parts of one model"
            )
        factor = 2 ** (len(configs["vae"]["block_out_channels"]) - 1)
        if self.used("resolution") % factor:
            raise UnirenderError(f"resolution: got {self.resolution}, expected a multiple of {factor}, or 0")
        check_steps(load_scheduler(self.folder, SCHEDULERS), self.used("steps"))

    @property
    def targets(self) -> int:
        """How many pictures the model predicts."""
        return 1

    def used(self, setting: str) -> int:
        """`steps` or `resolution`: as given, else the folder's own."""
        given = getattr(self, setting)
        return self.index[DEFAULTS[setting]] if given is None else given

    @property
    def config(self) -> dict[str, Any]:
        return self.settings(self.used("steps"), self.used("resolution"))

    @cached_property
    def pipeline(self) -> Any:
        """Loaded at the first question, with the options that the folder's index states."""
        parts = load_parts(self.folder, SCHEDULERS, self.device, self.dtype)
        taken = inspect.signature(self.kind).parameters.keys() - parts.keys()  # the rest diffusers leaves out, too
        pipeline = self.kind(**parts, **{key: value for key, value in self.index.items() if key in taken})
        pipeline.set_progress_bar_config(disable=True)
        return pipeline

    def predict(self, image_srgb: Image, mask: Mask) -> Any:
        """The pipeline's answer, (targets, h, w, 3); it pads, works at its resolution and returns the input's size."""
        return self.pipeline(
            self.picture(image_srgb, mask),
            num_inference_steps=self.used("steps"),
            ensemble_size=self.ensemble,
            processing_resolution=self.used("resolution"),
            generator=self.generator(),
        ).prediction


@dataclass
class MarigoldIntrinsics(_Marigold):
    """Albedo, roughness and metallic (appearance), or albedo and d (lighting), as the folder has them."""

    kind = MarigoldIntrinsicsPipeline

    @property
    def targets(self) -> int:
        properties: Any = self.index.get("target_properties")
        check_properties(properties, self.folder)
        return len(properties["target_names"])

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        properties = self.index["target_properties"]
        targets = decoded_targets(self.predict(image_srgb, mask), properties)
        return Intrinsics(**target_maps(targets, properties, image_srgb, mask), mask=mask, camera=camera)


@dataclass
class MarigoldNormals(_Marigold):
    """Normals; the pipeline's axes are the contract's: +x right, +y up, +z to the viewer."""

    kind = MarigoldNormalsPipeline

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        normal = unit_normal(self.predict(image_srgb, mask)[0], mask)
        return Intrinsics(normal=normal, mask=mask, camera=camera)


def check_steps(scheduler: Any, steps: int) -> None:
    """Looks whether diffusers, whose own timesteps the pipelines take, makes as many as there are steps.

    It counts trailing ones down in floating point and ends, for 61 and other numbers, with one too many: that of pure
    noise.

    Raises:
        UnirenderError: it does not, or takes no such number.
    """
    try:
        scheduler.set_timesteps(steps)
    except ValueError as error:
        raise UnirenderError(f"steps: got {steps}, which {type(scheduler).__name__} does not take: {error}") from error
    if (made := len(scheduler.timesteps)) != steps:
        raise UnirenderError(
            f"steps: got {steps}, of which {type(scheduler).__name__} makes {made} timesteps, the last at pure noise; "
            "expected another number"
        )
