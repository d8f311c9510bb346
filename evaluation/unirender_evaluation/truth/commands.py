"""`unirender bench truth` and `bench check`: making a suite's truth, and testing it with Mitsuba. Light to import."""

import json
import secrets
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from unirender.command_line.option_checks import at_least
from unirender.errors import UnirenderError


@dataclass(frozen=True)
class BenchCheck:
    """Render a random part of a suite's truth again with Mitsuba and z-test it against the shipped files."""

    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    scenes: int = 4
    """How many."""
    seed: int | None = None
    """Chooses the scenes and the render seeds; None: drawn anew and printed."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, scenes=self.scenes)
        at_least(0, seed=self.seed)

    def run(self) -> int:
        """Returns 1 where a test fails."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.truth.check import TruthCheck, check_truth

        console = Console()
        seed = secrets.randbits(31) if self.seed is None else self.seed
        console.print(f"--seed {seed}", highlight=False)
        for step in check_truth(load_suite(self.suite), self.scenes, seed):
            if isinstance(step, TruthCheck):
                console.print_json(json.dumps(step.summary()))
                return 0 if step.passed else 1
            console.print(f"{step.name}: {getattr(step, 'test', step)}", highlight=False)
        raise UnirenderError("truth check: nothing was rendered, expected at least one scene")


@dataclass(frozen=True)
class BenchTruth:
    """Make a suite's truth with Mitsuba; resumes by running the same command again.

    A suite of one's own gets it beside its TOML file, `standard` and `paper` in `${UNIRENDER_CACHE}/suites`.
    """

    suite: Annotated[str, tyro.conf.Positional]
    """A bundled suite, or the path of a suite's TOML file. The truth's hash, and the folders, are written into it, or
    into its copy beside the truth."""
    objects: Path | None = None
    """Folder of meshes, for suites that take some; None: the one that the TOML file names."""
    lights: Path | None = None
    """Folder of HDR maps and pictures, likewise."""
    out: Path | None = None
    """Folder for the truth and a copy of the TOML file, which is then a suite by its path."""
    work: Path | None = None
    """Folder for finished objects; None: `${UNIRENDER_CACHE}/truth`."""
    workers: int = 2
    """Processes of one thread each."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, workers=self.workers)

    def run(self) -> int:
        """Renders what is missing; 1 where files cannot be used, with a line for each."""
        self.check()
        try:
            self._make()
        except UnirenderError as error:
            if "\n" not in str(error):
                raise
            print(f"unirender: error: {error}", file=sys.stderr)
            return 1
        return 0

    def _make(self) -> None:
        """Renders the truth and prints what its noise leaves possible."""
        from rich.console import Console

        from unirender.system.paths import cache_dir
        from unirender.system.run_progress import progress_bar
        from unirender_evaluation.suites.home import target
        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.truth.make import make_truth, quality_summary

        work, console = self.work or cache_dir() / "truth", Console()
        folders = {"out": self.out, "objects": self.objects, "lights": self.lights}
        with progress_bar(console) as progress:
            bar = progress.add_task("truth", total=None)
            with closing(make_truth(self.suite, work, self.workers, **folders)) as finished:
                for done, total in finished:
                    progress.update(bar, completed=done, total=total)
        suite = load_suite(target(self.suite, **folders)[0].path)
        print(f"{suite.spec.path}: {len(suite.scenes)} scenes, truth {suite.sha256[:12]}")
        for kind, row in quality_summary(suite).items():
            below = f", {row['share_below_target']:.1%} below the target" if row["share_below_target"] else ""
            text = f"{kind}: noise ceiling {row['mean_db']:.1f} dB in the mean, least {row['min_db']:.1f} dB"
            print(f"{text}{below} (n {row['n']}, {row['mean_spp']:.0f} samples a pixel)")
