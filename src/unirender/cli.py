"""The command line `unirender ...`: the composition root, and the one module that may import all three packages.

Heavy imports stand inside the commands, so that `unirender --help` answers at once. A `UnirenderError` becomes one line
and exit status 1; wrong usage exits with 2.
"""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from unirender.errors import UnirenderError
from unirender_evaluation.commands import Bench

if TYPE_CHECKING:
    from unirender.camera import Camera
    from unirender.files import Picture
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

MAX_STOPS = 32

Device = Literal["auto", "cpu", "cuda", "mps"]
DType = Literal["auto", "float32", "bfloat16", "float16"]


@dataclass(frozen=True)
class ModelOptions:
    """Which model runs, and how."""

    checkpoint: str | None = None
    """Folder of a checkpoint (`unirender train` writes them); None: the shipped `tiny`."""
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
    fov: float | None = None
    """Vertical field of view of the picture in degrees. None: 36, and a notice."""
    progress: bool = True
    """Show progress."""

    def load(self) -> "UniRenderPipeline":
        """The pipeline on its device.

        Raises:
            UnirenderError: no such checkpoint, or the device is not there.
        """
        import diffusers

        from unirender.models.precision import resolve_device, resolve_dtype
        from unirender.pipelines.unirender_pipeline import UniRenderPipeline

        device = resolve_device(self.device)
        diffusers.utils.logging.disable_progress_bar()  # of loading: two small files
        pipeline = UniRenderPipeline.from_pretrained(self.checkpoint, torch_dtype=resolve_dtype(self.dtype, device))
        pipeline.to(device)
        pipeline.set_progress_bar_config(disable=not self.progress or not sys.stderr.isatty())
        return pipeline

    def sampling(self) -> dict[str, Any]:
        """Keyword arguments of the pipeline's methods."""
        import torch

        if self.samples < 1 or (self.steps is not None and self.steps < 1):
            raise UnirenderError(
                f"--samples {self.samples}, --steps {self.steps}: expected at least 1 of each (or no --steps)"
            )
        sampled = self.samples > 1 or (self.steps or 1) > 1
        return {
            "mode": "sample" if sampled else "mean",
            "num_samples": self.samples if sampled else None,
            "num_inference_steps": self.steps if sampled else None,
            "generator": torch.Generator().manual_seed(self.seed),
        }

    def camera(self) -> "Camera":
        """The picture's camera; a notice is printed where its field of view is assumed."""
        from unirender.camera import DEFAULT_FOV_DEG, Camera

        if self.fov is None:
            notice(f"field of view not given: {DEFAULT_FOV_DEG:g} degrees assumed (--fov)")
            return Camera()
        return Camera(fov_deg=self.fov)

    def meta(self, pipeline: "UniRenderPipeline") -> dict[str, Any]:
        """What goes into `meta.json`."""
        return {
            "checkpoint": self.checkpoint or "tiny (shipped)",
            "seed": self.seed,
            "steps": self.steps,
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
    """PNG, JPG or EXR (linear, premultiplied), any size."""
    mask: Path | None = None
    """Picture of the object's coverage (white: object). None: the alpha channel, else the whole frame."""

    def read(self) -> "Picture":
        """The picture with a mask.

        Raises:
            UnirenderError: an unreadable file, or a mask that does not fit.
        """
        import dataclasses

        import numpy as np

        from unirender.files import read_mask, read_picture

        picture = read_picture(self.picture)
        size = picture.image_srgb.shape[:2]
        if self.mask is not None:
            return dataclasses.replace(picture, mask=read_mask(self.mask, (size[0], size[1])))
        if picture.mask is None:
            notice("no mask and no alpha channel: the whole frame is taken as the object (--mask)")
            return dataclasses.replace(picture, mask=np.ones((*size, 1), dtype=np.float32))
        return picture


def notice(text: str) -> None:
    """One line to the user that is no result."""
    print(f"unirender: {text}", file=sys.stderr)


@dataclass(frozen=True)
class Doctor:
    """Show what was found on this machine: LLVM, Mitsuba, torch, caches, checkpoints, LPIPS weights."""

    def run(self) -> int:
        from rich.console import Console
        from rich.table import Table

        import unirender
        from unirender.models.precision import resolve_device, resolve_dtype
        from unirender.paths import cache_dir
        from unirender.pipelines.unirender_pipeline import SHIPPED_CHECKPOINT
        from unirender_evaluation.lpips import available
        from unirender_reference.backend import doctor

        device = resolve_device("auto")
        rows = [("unirender", unirender.__version__, "ok"), *doctor()]
        rows.append(("torch device", f"{device}, {str(resolve_dtype('auto', device)).removeprefix('torch.')}", "ok"))
        shipped = SHIPPED_CHECKPOINT.is_dir()
        rows.append(("checkpoint tiny", "shipped" if shipped else "missing", "ok" if shipped else "error"))
        rows.append(("LPIPS backbones", ", ".join(available()), "ok"))
        rows.append(("cache", str(cache_dir()), "ok"))
        table = Table("what", "found", "status")
        for row in rows:
            table.add_row(*(str(cell) for cell in row))
        Console().print(table)
        return 1 if any(row[2] == "error" for row in rows) else 0


@dataclass(frozen=True)
class Decompose:
    """Inverse rendering: one picture -> albedo, normal, roughness, metallic, s, d and the environment."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture; otherwise the maps are the network's own."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        from unirender.files import new_folder, write_png, write_result

        picture, camera = self.input.read(), self.model.camera()
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            pipeline, sampling = self.model.load(), self.model.sampling()
            result = pipeline.decompose(picture.image_srgb, picture.mask, camera=camera, closed=self.closed, **sampling)
            meta = {"command": "decompose", "input": str(self.input.picture), "closed": self.closed} | self.model.meta(
                pipeline
            )
            meta |= {"roughness_mean": result.roughness, "metallic_mean": result.metallic}
            write_result(folder, result.intrinsics, meta)
            for name, spread in (result.std or {}).items():
                write_png(folder / f"{name}.std.png", spread / max(float(spread.max()), 1e-6))
        print(f"{self.out.output}: roughness {result.roughness:.2f}, metallic {result.metallic:.2f}")
        return 0


@dataclass(frozen=True)
class Render:
    """Rendering: a folder of maps (as `decompose` writes it) -> picture."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Output of `unirender decompose`, or any folder with `intrinsics.exr` and, for light, `environment.exr`."""
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    environment: Path | None = None
    """Lat-long HDR or EXR light, or a photograph, instead of the folder's; s and d are derived from it."""
    exposure: float | None = None
    """Stops to add to that light as it is in its file. None: it is scaled by the rule of the training data."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        import dataclasses

        from unirender.files import new_folder, read_result, write_result
        from unirender.pipelines.editing import under_light

        intrinsics = read_result(self.folder)
        if self.model.fov is not None:
            intrinsics = intrinsics.replace(camera=dataclasses.replace(intrinsics.camera, fov_deg=self.model.fov))
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            if self.environment is not None:
                light = read_light(self.environment, self.exposure)
                intrinsics = under_light(intrinsics, light, "auto" if self.exposure is None else "keep")
            pipeline = self.model.load()
            image = pipeline.render(intrinsics, **self.model.sampling())
            meta = {"command": "render", "input": str(self.folder)} | self.model.meta(pipeline)
            write_result(folder, intrinsics, meta, image)
        print(f"{self.out.output}")
        return 0


@dataclass(frozen=True)
class Edit:
    """Material edit: decompose a picture, change roughness or metallic, render again."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    roughness: float | None = None
    """New roughness of the whole object, in [0, 1]."""
    metallic: float | None = None
    """New metallic of the whole object, in [0, 1]."""
    anchored: bool = True
    """Carry over what the decomposition could not explain: the input times render(after) / render(before)."""
    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture; otherwise the maps are the network's own."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        from unirender.files import new_folder, write_result

        if self.roughness is None and self.metallic is None:
            raise UnirenderError("edit: nothing to change, expected --roughness or --metallic (or both)")
        for name in ("roughness", "metallic"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise UnirenderError(f"--{name} {value}: expected a number in [0, 1]")
        picture, camera = self.input.read(), self.model.camera()
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            pipeline, sampling = self.model.load(), self.model.sampling()
            result = pipeline.edit(
                picture.image_srgb,
                picture.mask,
                roughness=self.roughness,
                metallic=self.metallic,
                anchored=self.anchored,
                camera=camera,
                closed=self.closed,
                **sampling,
            )
            meta = {"command": "edit", "input": str(self.input.picture)} | self.model.meta(pipeline)
            meta |= {
                "roughness": self.roughness,
                "metallic": self.metallic,
                "anchored": self.anchored,
                "closed": self.closed,
            }
            write_result(folder, result.intrinsics, meta, result.image_linear)
        print(f"{self.out.output}")
        return 0


@dataclass(frozen=True)
class Relight:
    """Relighting: decompose a picture, put it under another environment, render again."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    environment: Path
    """Lat-long HDR or EXR, or a photograph as a light."""
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    exposure: float | None = None
    """Stops to add to the light as it is in the file. None: the light is scaled by the rule of the training data."""
    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture; otherwise the maps are the network's own."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        from unirender.files import new_folder, write_result

        picture, camera = self.input.read(), self.model.camera()
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            light = read_light(self.environment, self.exposure)
            pipeline, sampling = self.model.load(), self.model.sampling()
            result = pipeline.relight(
                picture.image_srgb,
                light,
                picture.mask,
                exposure="auto" if self.exposure is None else "keep",
                camera=camera,
                closed=self.closed,
                **sampling,
            )
            meta = {"command": "relight", "input": str(self.input.picture), "environment": str(self.environment)}
            write_result(folder, result.intrinsics, meta | self.model.meta(pipeline), result.image_linear)
        print(f"{self.out.output}")
        return 0


def read_light(path: Path, exposure: float | None) -> Any:
    """Radiance `[h w 3]` of a light file as it stands there, times `2**exposure`.

    Raises:
        UnirenderError: an unreadable file, or an exposure that is no number of stops.
    """
    if exposure is not None and not abs(exposure) <= MAX_STOPS:
        raise UnirenderError(f"--exposure {exposure}: expected stops between -{MAX_STOPS} and {MAX_STOPS}")
    from unirender_reference.lights import load_light

    return load_light(path, normalise=False).environment * 2.0 ** (exposure or 0.0)


@dataclass(frozen=True)
class Dataset:
    """Render a training set with Mitsuba: WebDataset shards, resumable by running the same command again."""

    out: Path
    """Folder for the shards and `manifest.json`."""
    objects: int = 20
    """Procedural objects; each is one group."""
    pairs: int = 36
    """Pairs an object. basis: 3 x lights x roughness values, so a multiple of 3; paper: 121."""
    resolution: int = 64
    """Pixels along each side."""
    vary: Literal["basis", "independent", "one-at-a-time", "paper"] = "basis"
    """What changes inside a group."""
    split: Literal["train", "test"] = "train"
    """Seeds, object families and lights of this side only."""
    seed: int = 0
    """First seed."""
    spp: int = 64
    """Samples per pixel of an image."""
    workers: int = 0
    """Processes; 0: one for each core."""

    def run(self) -> int:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from unirender_reference.dataset import generate
        from unirender_reference.plan import DatasetConfig

        config = DatasetConfig(
            objects=self.objects,
            pairs=self.pairs,
            resolution=self.resolution,
            vary=self.vary,
            out=self.out,
            seed=self.seed,
            split=self.split,
            spp=self.spp,
            workers=self.workers,
        )
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task("groups", total=None)
            report = generate(config, lambda done, total: bar.update(task, completed=done, total=total))
        if report.groups == 0:
            print(
                f"{self.out}: complete already, {report.skipped_shards} shards; manifest {report.manifest_sha256[:12]}"
            )
            return 0
        print(
            f"{self.out}: {report.samples} pairs in {report.groups} groups, {report.seconds:.1f} s on {report.workers} "
            f"workers, {report.overhead:.2f} x the bare renders ({report.render_seconds:.1f} s over all workers); "
            f"{report.skipped_shards} shards were there; {report.nan_pixels} NaN pixels rendered again; "
            f"manifest {report.manifest_sha256[:12]}"
        )
        return 0


@dataclass(frozen=True)
class Train:
    """Train a preset on shards; resumes by running the same command again."""

    data: Path
    """Folder that `unirender dataset` wrote."""
    preset: str = "tiny"
    """Row of `unirender.training.presets.PRESETS`."""
    out: Path | None = None
    """Run folder. None: `${UNIRENDER_CACHE}/runs/<preset>`."""
    minutes: float | None = None
    """Stop, with the learning rate decayed, after this many minutes of training."""
    steps: int | None = None
    """Stop after this many steps instead of the preset's."""
    batch_size: int | None = None
    """Instead of the preset's."""
    device: Device = "auto"
    dtype: DType = "auto"
    seed: int = 0

    def run(self) -> int:
        from unirender.paths import cache_dir
        from unirender.training.run import train

        train(
            preset=self.preset,
            data=self.data,
            out=self.out or cache_dir() / "runs" / self.preset,
            minutes=self.minutes,
            steps=self.steps,
            batch_size=self.batch_size,
            device=self.device,
            dtype=self.dtype,
            seed=self.seed,
        )
        return 0


Command = (
    Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Decompose, tyro.conf.subcommand("decompose")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Edit, tyro.conf.subcommand("edit")]
    | Annotated[Relight, tyro.conf.subcommand("relight")]
    | Annotated[Dataset, tyro.conf.subcommand("dataset")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


def main(argv: list[str] | None = None) -> None:
    """Entry point of the `unirender` script; exits with 0, 1 (failure) or 2 (usage).

    `UNIRENDER_DEBUG=1` shows the traceback of an error.
    """
    command = tyro.cli(
        Command, args=argv, prog="unirender", description="A physics-checked renderer and inverse renderer."
    )
    try:
        status = command.run()
    except KeyboardInterrupt:
        notice("interrupted")
        status = 130
    except Exception as error:
        if os.environ.get("UNIRENDER_DEBUG"):
            raise
        kind = "" if isinstance(error, UnirenderError) else f"internal error: {type(error).__name__}: "
        hint = "" if isinstance(error, UnirenderError) else " (UNIRENDER_DEBUG=1 shows where)"
        print(f"unirender: error: {kind}{' '.join(str(error).split())}{hint}", file=sys.stderr)
        status = 1
    sys.exit(status)


if __name__ == "__main__":
    main()
