"""`unirender bench speed`. Light to import."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from unirender.command_line.option_checks import at_least, usage
from unirender.command_line.options import Device, DType, ModelOptions
from unirender.errors import UnirenderError, UsageError
from unirender.training.config import TrainConfig
from unirender.training.presets import get_preset
from unirender_evaluation.studies.speed.parts import NEED_DATA, PARTS, PartName

if TYPE_CHECKING:
    from unirender_evaluation.studies.speed.run import Measures

BLOCK_STEPS = 8  # of training; blocks of training and of bare passes take turns
OVERFIT_MINUTES = 3.0


@dataclass(frozen=True)
class BenchSpeed:
    """Measure on this machine how fast the model is: as ratios within one run, nothing is kept for the next.

    network: milliseconds by steps and batch. mitsuba: against Mitsuba to the same PSNR. start: cold start of the
    command line. With --data also training: samples/s against bare passes; overfit: minutes until one object is
    reproduced. Takes about 6 minutes on 2 cores; other work on the machine spoils it.
    """

    out: Path = Path("results/speed")
    """Folder of `speed.md` and `speed.json`."""
    data: Path | None = None
    """Folder that `unirender dataset` wrote, of the preset's size."""
    parts: Annotated[tuple[PartName, ...], tyro.conf.arg(help_behavior_hint="(default: all that can be)")] = ()
    """What is measured. None given: everything, training and overfit with --data only."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    scenes: int = 3
    """Scenes of the part mitsuba, evenly spaced; the other parts take the first of them."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: tiny."""
    preset: str = "tiny"
    """Preset of the part training: a row of `unirender.training.presets.PRESETS`."""
    device: Device = "cpu"
    """Where the model runs and is trained. auto: cuda, then mps, then cpu, whichever is there."""
    dtype: DType = "auto"
    """Precision of the model, and of the autocast in training. auto: bfloat16 only on hardware that computes in it."""
    repeats: int = 9
    """Repetitions of every measure whose median is taken; half as many of cold starts."""

    def check(self) -> tuple[PartName, ...]:
        """Looks at the values; the parts that will be measured.

        Raises:
            UsageError: one is outside its range, or a part has no data.
        """
        at_least(1, scenes=self.scenes, repeats=self.repeats)
        if len(set(self.parts)) < len(self.parts):
            raise UsageError(f"--parts {' '.join(self.parts)}: expected none of them twice")
        missing = [part for part in self.parts if part in NEED_DATA and self.data is None]
        if missing:
            raise UsageError(f"--parts {' '.join(missing)}: expected --data beside it, a folder of shards to train on")
        self.config()
        return self.parts or tuple(part for part in PARTS if self.data is not None or part not in NEED_DATA)

    def config(self) -> TrainConfig:
        """The preset.

        Raises:
            UsageError: there is none of that name, or it needs an autoencoder.
        """
        with usage():
            config = get_preset(self.preset)
        if config.model.codec != "pixel":
            raise UsageError(f"--preset {self.preset}: expected one with the pixel codec, such as tiny or small")
        return config

    def run(self) -> int:
        """Measures, prints and writes; returns the exit status."""
        parts = self.check()
        from rich.console import Console

        from unirender.training.data.groups import list_shards
        from unirender_evaluation.studies.speed.run import run

        if self.data is not None:
            if not self.data.is_dir():
                raise UnirenderError(f"{self.data}: no such data folder, expected one written by `unirender dataset`")
            list_shards(self.data)  # says what is wrong with the data before anything is measured
        run(self.out, self._measures(parts), self._protocol(), Console())
        return 0

    def _measures(self, parts: tuple[PartName, ...]) -> "Measures":
        """What measures each part."""
        from unirender.models.precision import resolve_device, resolve_dtype
        from unirender_evaluation.methods.pipeline import LazyPipeline
        from unirender_evaluation.rows import evenly
        from unirender_evaluation.studies.speed.mitsuba import mitsuba_part
        from unirender_evaluation.studies.speed.network import network_part
        from unirender_evaluation.studies.speed.overfit import overfit_part
        from unirender_evaluation.studies.speed.start import start_part
        from unirender_evaluation.studies.speed.training import training_part
        from unirender_evaluation.suites.suite import load_suite

        suite = load_suite(self.suite)
        scenes, few = evenly(suite.scenes, self.scenes), max(1, self.repeats // 2)
        device = resolve_device(self.device)
        dtype = resolve_dtype(self.dtype, device)
        pipeline = LazyPipeline(ModelOptions(self.checkpoint, self.device, self.dtype, progress=False).load)
        options = ("--device", self.device, "--dtype", self.dtype)
        measures: Measures = {
            "network": partial(network_part, pipeline, suite, scenes[0], self.repeats),
            "mitsuba": partial(mitsuba_part, pipeline, suite, scenes, self.repeats),
            "start": partial(start_part, suite, scenes[0], self.checkpoint, options, few),
        }
        if self.data is not None:
            about = self.data, self.preset, self.config(), device, dtype, BLOCK_STEPS, self.repeats
            measures["training"] = partial(training_part, *about)
            measures["overfit"] = partial(overfit_part, self.data, OVERFIT_MINUTES, device, dtype)
        return {name: measures[name] for name in PARTS if name in parts}

    def _protocol(self) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs: everything one must know to compare."""
        import os
        from datetime import UTC, datetime

        import torch

        from unirender.models.precision import resolve_device, resolve_dtype
        from unirender.shipped import checkpoint_folder, checkpoint_sha256
        from unirender_evaluation.versions import installed_version, versions

        device = resolve_device(self.device)
        return (
            ("cores", str(os.cpu_count())),
            ("threads of torch", str(torch.get_num_threads())),
            ("device", str(device)),
            ("dtype", str(resolve_dtype(self.dtype, device)).removeprefix("torch.")),
            ("weights", checkpoint_sha256(checkpoint_folder(self.checkpoint))[:12]),
            ("torch", installed_version("torch")),
            ("mitsuba", installed_version("mitsuba")),
            ("code", versions().code[:12]),
            ("date", datetime.now(UTC).date().isoformat()),
        )
