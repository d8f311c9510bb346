"""The command line `unirender ...`: the composition root, and the one module that may import all three packages.

What a command needs of another package is handed to it here: the lights of the ground truth, the scores of the
benchmark. Heavy imports stand inside functions, so that `unirender --help` answers at once.

One rule decides the exit status. 2: the command line itself is wrong, whatever the files and the machine (an unknown
option, a value outside its range, options that contradict each other, nothing to do). 1: the command fails. 0: it did
what it was asked for. An error is one line.
"""

import contextlib
import functools
import logging
import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

import unirender
from unirender.command_line.commands import Decompose, Edit, Relight, Render
from unirender.command_line.parse import parse
from unirender.command_line.process_ends import (
    READER_LEFT,
    drop_output,
    hear_ends,
    open_streams,
    quick_start,
    reader_left,
)
from unirender.errors import UnirenderError, UsageError
from unirender.system.ends import Ended, causes, interrupted
from unirender.system.notices import NoticeHandler, notice
from unirender.system.system_errors import out_of_memory, refused_by_system
from unirender.training.after.average import Average
from unirender.training.after.calibrate import Calibrate
from unirender.training.command import Train
from unirender.training.shadows.command import TrainVisibility
from unirender_evaluation.commands import Bench
from unirender_evaluation.demo.command import Demo
from unirender_evaluation.figures.command import Figures
from unirender_evaluation.public.command import BenchPublic
from unirender_evaluation.runs.command import BenchRun
from unirender_evaluation.studies.derived_light.command import BenchDerivedLight
from unirender_evaluation.studies.optimiser.commands import BenchIngredients, BenchRace
from unirender_evaluation.studies.sampling.command import BenchSampling
from unirender_evaluation.studies.training.command import BenchTraining
from unirender_evaluation.studies.unknown_mesh.command import BenchUnknownMesh
from unirender_evaluation.studies.warm_start.command import BenchWarmStart
from unirender_evaluation.truth.commands import BenchTruth
from unirender_reference.commands import Dataset
from unirender_reference.measure.commands import Reference
from unirender_reference.measure.lights import Lights
from unirender_reference.measure.meshes import Meshes
from unirender_reference.mix_command import MixMeshes
from unirender_reference.optimize.commands import Optimize

if TYPE_CHECKING:
    import numpy as np

    from unirender.camera import Camera
    from unirender.intrinsics import Intrinsics
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline
    from unirender.training.loop.validation import Validate


@dataclass(frozen=True)
class Doctor:
    """Show what was found on this machine: LLVM, Mitsuba, torch, caches, checkpoints, LPIPS weights."""

    def run(self) -> int:
        """Returns the exit status: 1 where something is missing or does not work."""
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        from unirender.models.precision import resolve_device, resolve_dtype
        from unirender.shipped import shipped_names
        from unirender.system.paths import cache_dir
        from unirender.system.writing import unusable
        from unirender_evaluation.lpips import available
        from unirender_reference.backend import doctor

        device = resolve_device("auto")
        rows = [("unirender", unirender.__version__, "ok"), *doctor()]
        rows.append(("torch device", f"{device}, {str(resolve_dtype('auto', device)).removeprefix('torch.')}", "ok"))
        shipped = shipped_names()
        rows.append(("checkpoints", ", ".join(shipped) or "missing", "ok" if shipped else "fail"))
        rows.append(("LPIPS backbones", ", ".join(available()), "ok"))
        reason = unusable(cache_dir())
        wrong = f": cannot be written ({reason}); set UNIRENDER_CACHE to another folder"
        rows.append(("cache", f"{cache_dir()}{wrong if reason else ''}", "fail" if reason else "ok"))
        table = Table("what", "found", "status")
        for row in rows:
            table.add_row(*(Text(str(cell), overflow="fold") for cell in row))  # paths are copied from here
        Console().print(table)
        return 1 if any(row[2] == "fail" for row in rows) else 0


Command = (
    Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Decompose, tyro.conf.subcommand("decompose")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Edit, tyro.conf.subcommand("edit")]
    | Annotated[Relight, tyro.conf.subcommand("relight")]
    | Annotated[Optimize, tyro.conf.subcommand("optimize")]
    | Annotated[Dataset, tyro.conf.subcommand("dataset")]
    | Annotated[Lights, tyro.conf.subcommand("lights")]
    | Annotated[Meshes, tyro.conf.subcommand("meshes")]
    | Annotated[MixMeshes, tyro.conf.subcommand("mix-meshes")]
    | Annotated[Reference, tyro.conf.subcommand("reference")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[TrainVisibility, tyro.conf.subcommand("train-visibility")]
    | Annotated[Average, tyro.conf.subcommand("average")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Figures, tyro.conf.subcommand("figures")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)

MODEL = (Decompose, Edit, Relight, Render)  # in a process of their own these have a `quick_start`
RESUMABLE = (
    Dataset,
    MixMeshes,
    Train,
    TrainVisibility,
    BenchRun,
    BenchTruth,
    BenchDerivedLight,
    BenchIngredients,
    BenchPublic,
    BenchRace,
    BenchSampling,
    BenchTraining,
    BenchUnknownMesh,
    BenchWarmStart,
)


def read_light(path: Path) -> "np.ndarray":
    """Radiance `[h w 3]` of a light file as it stands there: lat-long HDR or EXR, or a photograph."""
    from unirender_reference.lights import load_light

    light = load_light(path, normalise=False)
    if share := light.provenance.get("negative_share"):
        notice(f"light {path}: {100 * float(share):.1g}% of its radiance is negative and was set to 0")
    return light.environment


def make_validation(suite: str, scenes: int) -> "Validate":
    """The benchmark's own scores on a few scenes of a suite."""
    from unirender_evaluation.validation import suite_validation

    return suite_validation(suite, scenes)


def score_names() -> tuple[str, ...]:
    """Names of the scores that `make_validation` gives."""
    from unirender_evaluation.validation import SCORES

    return SCORES


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """The folder of a run: made, and written by this process alone."""
    from unirender_reference.folder_lock import locked, made_folder

    with made_folder(folder), locked(folder):
        yield


def predict_maps(image_srgb: "np.ndarray", mask: "np.ndarray", camera: "Camera") -> "Intrinsics":
    """The shipped model's decomposition of a picture, for `optimize --init unirender`."""
    return shipped_pipeline().decompose(image_srgb, mask=mask, camera=camera).intrinsics


@functools.cache
def shipped_pipeline() -> "UniRenderPipeline":
    """The shipped model, loaded once."""
    import diffusers

    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

    diffusers.utils.logging.disable_progress_bar()  # of loading: two small files
    pipeline = UniRenderPipeline.from_pretrained()
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def run(command: Any) -> int:
    """Hands a command what it needs of the other packages; returns its exit status."""
    if isinstance(command, Render | Relight):
        return command.run(read_light)
    if isinstance(command, Train):
        return command.run(make_validation, score_names, alone)
    if isinstance(command, TrainVisibility):
        return command.run(alone)
    if isinstance(command, Optimize):
        return command.run(predict_maps)
    return command.run()


def main(argv: list[str] | None = None) -> None:
    """Entry point of the `unirender` script.

    Exits with 0, 1 (failure), 2 (usage), 130 (interrupted), 141 (who read its output left: `unirender ... | head`), 143
    (SIGTERM) or 129 (SIGHUP).
    `--version` prints the version. `UNIRENDER_DEBUG=1` shows the traceback of an error.
    """
    arguments = sys.argv[1:] if argv is None else argv
    if argv is None:
        open_streams()
        hear_ends()
    command = None
    logger, handler = logging.getLogger("unirender"), NoticeHandler()
    logger.addHandler(handler)
    try:
        if arguments == ["--version"]:
            print(f"unirender {unirender.__version__}", flush=True)
            sys.exit(0)
        command = parse(Command, arguments, "unirender", "A physics-checked renderer and inverse renderer.")
        with quick_start() if argv is None and isinstance(command, MODEL) else contextlib.nullcontext():
            status = run(command)
        sys.stdout.flush()
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, BrokenPipeError) and reader_left():
            drop_output()
            status = READER_LEFT
        elif interrupted(error):
            with contextlib.suppress(OSError):  # a terminal that has closed
                notice("interrupted" + ("; run the same command again to go on" if resumes(command) else ""))
            status = 128 + next((cause.args[0] for cause in causes(error) if isinstance(cause, Ended)), signal.SIGINT)
        elif os.environ.get("UNIRENDER_DEBUG"):
            raise
        else:
            status = refuse(error)
    finally:
        logger.removeHandler(handler)
    sys.exit(status)


def resumes(command: Any) -> bool:
    """Whether a command that was stopped goes on when it is run again."""
    if isinstance(command, Optimize):
        return command.input.is_dir()
    if isinstance(command, Decompose):
        return command.input.picture.is_dir()
    return isinstance(command.command if isinstance(command, Bench) else command, RESUMABLE)


def refuse(error: BaseException) -> int:
    """Prints an error as one line; returns the exit status."""
    if out_of_memory(error):
        said = f" ({error})" if str(error) else ""
        error = UnirenderError(
            f"not enough memory{said}; expected a machine with more, or less asked for at a time: smaller pictures or "
            "batches, fewer samples, looks or workers"
        )
    error = refused_by_system(error) or error
    kind = "" if isinstance(error, UnirenderError) else f"internal error: {type(error).__name__}: "
    hint = "" if isinstance(error, UnirenderError) else " (UNIRENDER_DEBUG=1 shows where)"
    notice(f"error: {kind}{' '.join(str(error).split())}{hint}")
    return 2 if isinstance(error, UsageError) else 1


if __name__ == "__main__":
    main()
