"""A dual-stream model as a diffusers pipeline: its components, how they are read, and the network that a call asks for.

`from_pretrained`, `save_pretrained`, `to`, `torch_dtype` and progress bars are those that users of diffusers know. What
is saved does not say where the parts were read, so that it is the same wherever they lay.
"""

import copy
import logging
import math
from collections.abc import Iterable
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.pipelines.pipeline_utils import DiffusionPipeline
from diffusers.schedulers.scheduling_utils import SchedulerMixin

from unirender.diffusion.samplers import check_scheduler, check_timesteps, make_sampler
from unirender.errors import UnirenderError
from unirender.models.codec import make_codec
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.pipelines.calibration import Lines, check_lines
from unirender.pipelines.loading import (
    INDEX_FILE,
    check_complete,
    check_options,
    copy_weights,
    find_pipeline,
    forget_place,
    reading,
)
from unirender.pipelines.network import Network, Overflow
from unirender.pipelines.settings import check_material

P = TypeVar("P", bound="DualStreamPipeline")

logger = logging.getLogger(__name__)


class DualStreamPipeline(DiffusionPipeline):
    """The components of a model.

    Args:
        dual_stream: the network.
        scheduler: with zero terminal SNR and `prediction_type="sample"`, without noise of its own: DDIM or UniPC.
        vae: for models with the KL codec.
        material: whether metallic and roughness are one number per object or maps, as the checkpoint was trained.
        calibration: lines by which predicted roughness and metallic are read (`unirender.pipelines.calibration`).

    Raises:
        UnirenderError: the network's configuration contradicts itself, or a setting is none.
    """

    model_cpu_offload_seq = "dual_stream->vae"
    _optional_components: ClassVar[list[str]] = ["vae"]

    def __init__(
        self,
        dual_stream: DualStreamModel,
        scheduler: SchedulerMixin,
        vae: AutoencoderKL | None = None,
        material: str = "scalar",
        calibration: Lines | None = None,
    ) -> None:
        super().__init__()
        check_material(material)
        for part in (dual_stream, vae):
            forget_place(part)
        self.register_modules(dual_stream=dual_stream, scheduler=scheduler, vae=vae)
        self.register_to_config(material=material, calibration=check_lines(calibration))
        self.dual_stream: DualStreamModel
        self.scheduler: SchedulerMixin
        self.vae: AutoencoderKL | None
        self.conditioning.check_channels(dict(dual_stream.config))
        self._reported: set[str] = set()  # of what something was logged

    @classmethod
    def from_pretrained(  # pyright: ignore[reportIncompatibleMethodOverride] - a path may be left out here
        cls: type[P], pretrained_model_name_or_path: str | Path | None = None, **kwargs: Any
    ) -> P:
        """Loads a pipeline folder, or a shipped checkpoint by its name (`tiny` without one). Weights become float32
        without `torch_dtype`.

        Raises:
            UnirenderError: no such folder, no pipeline in it, or it cannot be read.
        """
        path = find_pipeline(pretrained_model_name_or_path)
        if kwargs.get("dual_stream", path) is None:  # so diffusers leaves a part out
            raise UnirenderError("dual_stream: got None, expected a DualStreamModel; leave the argument out")
        old_name = kwargs.pop("torch_dtype", None)  # diffusers calls it `dtype` now; both work here
        kwargs = {"dtype": old_name or torch.float32, "use_safetensors": True} | kwargs
        with reading(path, given=bool(kwargs.keys() - {"dtype", "use_safetensors"})):
            pipeline = super().from_pretrained(str(path), **kwargs)
        check_options(pipeline, path / INDEX_FILE)
        if "dual_stream" not in kwargs:
            check_options(pipeline.dual_stream, path / "dual_stream" / "config.json")
            check_complete(pipeline.dual_stream, path / "dual_stream")
        forget_place(pipeline)
        for name, part in pipeline.components.items():
            if isinstance(part, torch.nn.Module) and name not in kwargs:
                copy_weights(part)
        # Faster on a CPU, most so in batches.
        pipeline.dual_stream.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] - diffusers' own
        return pipeline

    @property
    def components(self) -> dict[str, Any]:
        """What the class takes to make this pipeline again: its parts and its settings, which decide answers, too."""
        return super().components | {name: self.config[name] for name in ("material", "calibration")}

    # Of the network that is there: users of diffusers exchange parts of a pipeline.
    @property
    def conditioning(self) -> Conditioning:
        """How maps enter the network."""
        config = dict(self.dual_stream.config)
        return Conditioning.of(config, make_codec(config["codec"], config["patch"], self.vae))

    @property
    def size(self) -> int:
        """Side of the network's own square, pixels."""
        return self.dual_stream.config["sample_size"] * self.conditioning.codec.factor

    @property
    def size_multiple(self) -> int:
        """What the side of the network's square must be a multiple of: so that the codec and the levels of the U-Nets
        halve it without a rest, and the light's rows and columns fall on whole pixels.
        """
        levels = len(self.dual_stream.config["block_out_channels"])
        return math.lcm(self.conditioning.codec.factor * 2 ** (levels - 1), *self.conditioning.packing.environment_size)

    def check_size(self, size: int) -> None:
        """Looks at a side of the network's square.

        Raises:
            UnirenderError: it is no multiple of `size_multiple`.
        """
        if not isinstance(size, Integral) or size < 1 or size % self.size_multiple:
            raise UnirenderError(f"size: got {size}, expected a multiple of {self.size_multiple}, like {self.size}")

    def _network(self, mode: str = "mean", sampler: str | None = None, size: int | None = None) -> Network:
        """The network as a call asks for it.

        Raises:
            UnirenderError: no such sampler or size; a sampler in mode `mean`, which takes one step; or a scheduler
                that several steps cannot be taken with.
        """
        if sampler is not None and mode == "mean":
            raise UnirenderError(f"sampler {sampler}: mode mean takes one step and no sampler; use mode 'sample'")
        if size is not None:
            self.check_size(size)
        # A scheduler remembers its steps: each call has its own, so that calls at the same time do not share them.
        scheduler = copy.deepcopy(self.scheduler) if sampler is None else make_sampler(sampler, self.scheduler)
        check = check_scheduler if mode == "sample" else check_timesteps
        check(scheduler)
        # Weights that accelerate offloads lie elsewhere than they compute; of others the model knows, with one search.
        device = self._execution_device if hasattr(self.dual_stream, "_hf_hook") else self.dual_stream.device
        return Network(self.dual_stream, self.conditioning, scheduler, size or self.size, device, self._progress)

    def _progress(self, steps: Iterable[Any]) -> Iterable[Any]:
        return self.progress_bar(steps)  # pyright: ignore[reportAttributeAccessIssue] - diffusers' own

    def _report_overflow(self, overflow: dict[str, Overflow]) -> None:
        for name, over in overflow.items():
            self._report_once(name, f"{over}; they are kept, but what it makes of them is a guess")

    def _report_once(self, name: str, remark: str) -> None:
        if name not in self._reported:
            self._reported.add(name)
            logger.warning("%s: %s", name, remark)
