"""`unirender bench sampling`. Light to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.diffusion.steps import MOST_STEPS
from unirender.errors import UsageError


@dataclass(frozen=True)
class BenchSampling:
    """Score our model by steps and samples, and the spread of its samples against its error. A second run continues.

    Decompositions and renders of a picture of each scene in mode `mean` and with every number of steps and samples;
    calibration of the samples' spread, map by map. Takes about 4 minutes on 2 cores.
    """

    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    out: Path = Path("results/sampling")
    """Folder of tables, plots and records."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: tiny."""
    scenes: int = 16
    """Scenes, evenly spaced over the suite, a picture each."""
    steps: tuple[int, ...] = (1, 2, 4, 10, 20)
    """Numbers of steps of mode `sample`."""
    samples: tuple[int, ...] = (1, 5, 16)
    """Averaged in mode `sample`; calibration is that of the most."""
    sampler: Literal["ddim", "unipc"] = "ddim"
    """Sampler of mode `sample`."""
    seed: int = 0
    """Seed of the noise."""
    device: Device = "cpu"
    """Where the model runs. auto: cuda, then mps, then cpu, whichever is there."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, scenes=self.scenes)
        at_least(0, seed=self.seed)
        for name, most in (("steps", MOST_STEPS), ("samples", None)):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                shown = " ".join(map(str, values))
                raise UsageError(f"--{name} {shown}: expected at least one number, none of them twice")
            at_least(1, **{name: min(values)})
            if most is not None and max(values) > most:
                raise UsageError(f"--{name} {max(values)}: expected at most {most}")

    def run(self) -> int:
        """Measures what is missing, prints and writes tables and plots; returns the exit status."""
        self.check()
        from rich.console import Console

        from unirender.command_line.options import ModelOptions
        from unirender.models.precision import resolve_device
        from unirender.shipped import checkpoint_folder, checkpoint_sha256
        from unirender_evaluation.methods.pipeline import LazyPipeline
        from unirender_evaluation.rows import evenly
        from unirender_evaluation.studies.sampling.measure import SamplingStudy
        from unirender_evaluation.studies.sampling.run import run
        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.versions import versions

        suite = load_suite(self.suite)
        options = ModelOptions(self.checkpoint, self.device, "float32", progress=False)
        what = SamplingStudy(
            suite=suite,
            out=self.out,
            pipeline=LazyPipeline(options.load),
            weights=checkpoint_sha256(checkpoint_folder(self.checkpoint)),
            device=str(resolve_device(self.device)),
            steps=tuple(sorted(self.steps)),
            samples=tuple(sorted(self.samples)),
            sampler=self.sampler,
            seed=self.seed,
            versions=versions(),
        )
        run(what, evenly(suite.scenes, self.scenes), Console())
        return 0
