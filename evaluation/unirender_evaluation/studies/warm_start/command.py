"""`unirender bench warm-start`. Light to import."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import tyro

from unirender.command_line.option_checks import at_least
from unirender_reference.optimize.single.config import SingleConfig


@dataclass(frozen=True)
class BenchWarmStart:
    """Score single-view optimisation with our model's prediction as its start, and without. A second run continues.

    The same pictures and the same steps, with a known mesh and without one; printed are the figures of both, those of
    the prediction alone, and the paired differences with their intervals. Takes about 5 minutes on 2 cores.
    """

    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    out: Path = Path("results/warm-start")
    """Folder of tables and records."""
    scenes: int = 8
    """Scenes, evenly spaced over the suite, a picture each."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: tiny."""
    single: tyro.conf.AvoidSubcommands[SingleConfig] = field(default_factory=SingleConfig)
    """Of the optimisation, cold and warm."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, scenes=self.scenes)

    def run(self) -> int:
        """Measures what is missing, prints and writes `warm_start.md` and `.json`; returns the exit status."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.rows import evenly
        from unirender_evaluation.studies.warm_start.measure import Geometry, WarmStart
        from unirender_evaluation.studies.warm_start.run import our_method, run
        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.versions import versions

        suite = load_suite(self.suite)
        base = our_method(self.checkpoint)
        what = WarmStart(suite, self.out, base, self.single, get_args(Geometry), versions())
        run(what, evenly(suite.scenes, self.scenes), Console())
        return 0
