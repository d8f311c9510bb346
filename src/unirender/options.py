"""Options that the model's commands share, and how a command speaks to its user. Light to import."""

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from unirender.errors import UnirenderError, UsageError

if TYPE_CHECKING:
    import torch

    from unirender.camera import Camera
    from unirender.pictures import Picture
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

Device = Literal["auto", "cpu", "cuda", "mps"]
DType = Literal["auto", "float32", "bfloat16", "float16"]
Sampler = Literal["ddim", "unipc"]

MOST_STEPS = 500  # the same as `unirender.diffusion.sampling.MOST_STEPS`, which needs torch
DARK = 0.35  # display value that an object reaches at the exposures of the training data, unless it is dark itself
FULL_COVERAGE = 0.95  # that a mask reaches on an object
MANY_CLIPPED = 0.05  # share of clipped pixels from which a notice is due


def notice(text: str) -> None:
    """One line to the user that is no result."""
    print(f"unirender: {text}", file=sys.stderr)


@contextlib.contextmanager
def usage() -> Iterator[None]:
    """Whatever is refused inside was asked for in a wrong way: a `UnirenderError` becomes a `UsageError`."""
    try:
        yield
    except UnirenderError as error:
        raise UsageError(str(error)) from error


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
        if self.fov is not None:
            from unirender.camera import Camera

            with usage():
                Camera(fov_deg=self.fov)

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
        from unirender.diffusion.sampling import sampler_name, steps_of
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
    """PNG, JPG or EXR (linear, premultiplied), at least 8 pixels along each side. `decompose` takes a folder of them,
    too."""
    mask: Path | None = None
    """Picture of the object's coverage (white: object), or a folder of such pictures, named like those of a folder.
    None: the alpha channel, else the whole frame."""

    def read(self, model: ModelOptions) -> tuple["Picture", "Camera"]:
        """The picture with a mask and its remarks, and its camera; notices say them: what was assumed, and what the
        picture cannot show.

        Raises:
            UnirenderError: an unreadable file, or a mask that does not fit.
        """
        picture, remarks = read_input(self.picture, self.mask)
        remarks |= model.camera_remarks(picture)
        for remark in remarks.values():
            notice(remark)
        return dataclasses.replace(picture, remarks=remarks), model.camera(picture)


def read_input(path: Path, mask: Path | None, option: str = " (--mask)") -> tuple["Picture", dict[str, str]]:
    """A picture with a mask, and remarks by kind: what was assumed, and what the picture cannot show.

    Args:
        path: of the picture.
        mask: of a picture of the coverage; None: the alpha channel, else the whole frame.
        option: what remarks on a mask that is not there add: how one is given.

    Raises:
        UnirenderError: an unreadable file, or a mask that does not fit.
    """
    import numpy as np

    from unirender.pictures import OPAQUE, read_mask_file, read_picture

    picture = read_picture(path)
    remarks = dict(picture.remarks)
    height, width = picture.image_srgb.shape[:2]
    if mask is not None:
        coverage, lost = read_mask_file(mask, (height, width))
        remarks |= lost
        picture = dataclasses.replace(picture, mask=coverage)
        if coverage.min() >= OPAQUE:
            remarks["mask"] = "the mask covers the whole frame, which is taken as the object"
    elif picture.mask is None:
        remarks["mask"] = f"no mask and no alpha channel: the whole frame is taken as the object{option}"
        picture = dataclasses.replace(picture, mask=np.ones((height, width, 1), dtype=np.float32))
    elif picture.mask.min() >= OPAQUE:
        remarks["mask"] = f"the alpha channel covers the whole frame, which is taken as the object{option}"
    assert picture.mask is not None, "the whole frame at least"
    if (most := picture.mask.max()) < FULL_COVERAGE:
        remarks["coverage"] = f"the mask is at most {most:.2f}, as of something transparent: expected 1 on the object"
    if (bright := float(np.percentile(picture.image_srgb[picture.mask[..., 0] > 0.5].max(axis=-1), 99))) < DARK:
        remarks["dark"] = (
            f"the object is dark, 99% of it below {bright:.2f} of display white: the network was taught exposures at "
            "which white is bright, and a darker one goes into the albedo"
        )
    if picture.negative:
        remarks["negative"] = f"{100 * picture.negative:.1g}% of the picture's radiance is negative and was set to 0"
    if picture.clipped > MANY_CLIPPED:
        remarks["clipped"] = (
            f"{picture.clipped:.0%} of the object's pixels are clipped at display white: radiance is lost there"
        )
    return picture, remarks


def check_seed(seed: int) -> None:
    """Looks at the seed of a training.

    Raises:
        UsageError: PyTorch or NumPy does not take it.
    """
    if not 0 <= seed < 2**63:
        raise UsageError(f"--seed {seed}: expected an integer from 0 to 2^63 - 1")


def at_least(low: int, **options: int | None) -> None:
    """Looks at options that have a least value; None is one that was not given.

    Raises:
        UsageError: one is below `low`.
    """
    for name, value in options.items():
        if value is not None and value < low:
            raise UsageError(f"--{name.replace('_', '-')} {value}: expected at least {low}")
