"""Options that the model's commands share. Light to import."""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from unirender.command_line.input_picture import (
    BYTES_A_PIXEL,
    TILED_BYTES_A_PIXEL,
    TILED_SAMPLE_BYTES_A_PIXEL,
    read_input,
)
from unirender.command_line.option_checks import at_least, usage
from unirender.diffusion.steps import MOST_STEPS, steps_of
from unirender.errors import UsageError

if TYPE_CHECKING:
    import torch

    from unirender.camera import Camera
    from unirender.pictures import Picture
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

Device = Literal["auto", "cpu", "cuda", "mps"]
DType = Literal["auto", "float32", "bfloat16", "float16"]
Sampler = Literal["ddim", "unipc"]
MaterialForm = Literal["scalar", "map"]


@dataclass(frozen=True)
class ModelOptions:
    """Which model runs, and how."""

    checkpoint: Path | None = None
    """Folder of a checkpoint (`unirender train` writes them), or a shipped one by its name. None: `tiny`."""
    device: Device = "auto"
    """auto: cuda, then mps, then cpu, whichever is there."""
    dtype: DType = "auto"
    """auto: bfloat16 only on hardware that computes in it, else float32."""
    seed: int = 0
    """Seed of the noise."""
    steps: int | None = None
    """Sampler steps. None: 1, the mean prediction, or 20 where several samples are asked for."""
    samples: int = 1
    """1: the mean prediction. More: that many diffusion samples, their average, and their spread."""
    sampler: Sampler | None = None
    """What takes the steps, where there is more than one. None: the checkpoint's scheduler, ddim in those shipped."""
    size: int | None = None
    """Side of the square at which the network runs, pixels: a multiple of 32 (of 64 for some checkpoints). None: the
    size it was trained at, which it is best at."""
    fov: float | None = None
    """Vertical field of view of the picture in degrees. None: that in the header of an EXR of ours, else 36, and a
    notice."""
    progress: bool = True
    """Show progress."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
        """
        at_least(1, samples=self.samples, size=self.size)
        if self.steps is not None and not 1 <= self.steps <= MOST_STEPS:
            raise UsageError(f"--steps {self.steps}: expected 1 to {MOST_STEPS}")
        if self.sampler is not None and (self.mode == "mean" or self.steps == 1):
            raise UsageError(f"--sampler {self.sampler}: one step needs none, expected more --steps (or --samples)")
        if not -(2**63) <= self.seed < 2**64:
            raise UsageError(f"--seed {self.seed}: expected an integer of 64 bits")
        if self.fov is not None and not 0 < self.fov < 180:
            raise UsageError(f"--fov {self.fov:g}: expected degrees between 0 and 180")

    def load(self) -> "UniRenderPipeline":
        """The pipeline on its device.

        Raises:
            UnirenderError: no such checkpoint, or the device is not there.
            UsageError: the model cannot run at that size.
        """
        import diffusers

        from unirender.models.precision import resolve_device, resolve_dtype
        from unirender.pipelines.unirender_pipeline import UniRenderPipeline

        device = resolve_device(self.device)
        diffusers.utils.logging.disable_progress_bar()  # of loading: two small files
        pipeline = UniRenderPipeline.from_pretrained(self.checkpoint, torch_dtype=resolve_dtype(self.dtype, device))
        pipeline.to(device)
        if self.size is not None:
            with usage():
                pipeline.check_size(self.size)
        pipeline.set_progress_bar_config(disable=not self.progress or not sys.stderr.isatty())
        return pipeline

    def side(self, pipeline: "UniRenderPipeline") -> int:
        """Of the square at which the network runs, pixels."""
        return self.size or pipeline.size

    @property
    def mode(self) -> str:
        """`mean`, or `sample` where several samples or steps are asked for."""
        return "sample" if self.samples > 1 or (self.steps or 1) > 1 else "mean"

    def sampling(self) -> dict[str, Any]:
        """Keyword arguments of the pipeline's methods."""
        sampled = self.mode == "sample"
        return {
            "mode": self.mode,
            "num_samples": self.samples if sampled else None,
            "num_inference_steps": self.steps if sampled else None,
            "sampler": self.sampler,
            "size": self.size,
            "generator": self.generators(1)[0] if sampled or self.seed else None,  # as a call of the API without one
        }

    def generators(self, count: int) -> list["torch.Generator"]:
        """Generators that all draw the same noise."""
        from unirender.pipelines.settings import same_noise

        return same_noise(self.seed, count)

    def camera(self, picture: "Picture") -> "Camera":
        """The picture's camera: that of its header, else the contract's, with the field of view that is given."""
        from unirender.camera import Camera

        camera = picture.camera or Camera()
        return camera if self.fov is None else dataclasses.replace(camera, fov_deg=self.fov)

    def camera_remarks(self, picture: "Picture") -> dict[str, str]:
        """By kind, what the camera was taken from where it is not given."""
        if self.fov is not None:
            return {}
        if picture.camera is None:
            return {"camera": f"field of view not given: {self.camera(picture).fov_deg:g} degrees assumed (--fov)"}
        return {"header": f"field of view of {picture.camera.fov_deg:g} degrees, as the picture's header says (--fov)"}

    def provenance(self, pipeline: "UniRenderPipeline") -> dict[str, Any]:
        """What goes into `meta.json` and the headers: which model ran, and how."""
        import unirender
        from unirender.diffusion.samplers import sampler_name
        from unirender.shipped import checkpoint_folder, checkpoint_label, checkpoint_sha256

        steps = steps_of(self.mode, self.steps)
        return {
            "unirender": unirender.__version__,
            "checkpoint": checkpoint_label(self.checkpoint),
            "checkpoint_sha256": checkpoint_sha256(checkpoint_folder(self.checkpoint)),
            "mode": self.mode,
            "seed": self.seed,
            "steps": steps,
            "sampler": (self.sampler or sampler_name(pipeline.scheduler)) if steps > 1 else None,
            "size": self.side(pipeline),
            "samples": self.samples,
            "device": str(pipeline.device),
            "dtype": str(pipeline.dtype).removeprefix("torch."),
        }


@dataclass(frozen=True)
class DecompositionOptions:
    """How the picture is taken apart."""

    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture, and the light to agree; else all is predicted."""
    flat: bool = False
    """Make the albedo even between its edges; the detail that it loses goes into s and d."""
    looks: int = 1
    """Looks at the picture, 1 to 12: mirrored, and with its colour channels exchanged. Their mean is better and takes
    longer; 6 give most of it."""
    tile: bool = False
    """Add to albedo and normal the detail of overlapping tiles, seen at the picture's own resolution."""
    material: MaterialForm | None = None
    """scalar: one roughness and one metallic for the object; map: one for each pixel. None: as the checkpoint was
    trained, scalar for those shipped."""

    def check(self, mode: str) -> None:
        """Looks at the values.

        Args:
            mode: of the model, `mean` or `sample`.

        Raises:
            UsageError: no such number of looks, or several samples are asked for beside them.
        """
        if self.looks != 1:
            from unirender.pipelines.looks import check_looks

            with usage():
                check_looks(self.looks, mode)

    def bytes_a_pixel(self, samples: int) -> int:
        """Of memory, that a decomposition or an edit takes, as of `read_input`. (`flat` and looks take no more.)"""
        if not self.tile:
            return BYTES_A_PIXEL
        return TILED_BYTES_A_PIXEL + (TILED_SAMPLE_BYTES_A_PIXEL * samples if samples > 1 else 0)

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the pipeline's methods, and facts for `meta.json`."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class OutputOptions:
    """Where the result goes."""

    output: Path
    """Folder to write; it appears complete or not at all."""
    overwrite: bool = False
    """Replace the folder if it is there."""


@dataclass(frozen=True)
class InputOptions:
    """The picture."""

    picture: Annotated[Path, tyro.conf.Positional]
    """PNG, JPG, TIFF, WebP, BMP or EXR (linear, premultiplied), at least 8 pixels along each side. `decompose` takes a
    folder of them, too."""
    mask: Path | None = None
    """Picture of the object's coverage (white: object; of RGBA the alpha channel, unless it is opaque), or a folder of
    such pictures, named like those of a folder. None: the picture's alpha channel, else the whole frame."""

    @property
    def files(self) -> dict[str, Path | None]:
        """For `meta.json`."""
        return {"input": self.picture, "mask": self.mask}

    def read(self, model: ModelOptions, bytes_a_pixel: int) -> tuple["Picture", "Camera"]:
        """The picture with a mask and its remarks (what was assumed, and what it cannot show), and its camera.
        `bytes_a_pixel` as of `read_input`.

        Raises:
            UnirenderError: as `read_input`.
        """
        picture, remarks = read_input(self.picture, self.mask, bytes_a_pixel=bytes_a_pixel, samples=model.samples)
        remarks |= model.camera_remarks(picture)
        return dataclasses.replace(picture, remarks=remarks), model.camera(picture)
