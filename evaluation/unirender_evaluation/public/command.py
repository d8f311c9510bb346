"""`unirender bench public`. Light to import."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.errors import UsageError

if TYPE_CHECKING:
    from unirender_evaluation.public.sets import PublicSet

SetName = Literal["stanford-orb", "iiw", "maw"]


@dataclass(frozen=True)
class BenchPublic:
    """Score methods on a public test set in a folder of yours: Stanford-ORB, IIW or MAW. A second run continues.

    Nothing is downloaded. Layouts, metrics and what could not be verified: docs/public_test_sets.md.
    """

    set: Annotated[SetName, tyro.conf.Positional]
    """Which set."""
    folder: Annotated[Path, tyro.conf.Positional]
    """Where it is, as its authors distribute it."""
    out: Path | None = None
    """Folder of the run; None: results/public-SET."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: tiny."""
    methods: tuple[str, ...] = ("ours", "trivial", "plugins")
    """Groups of rows; plugins: what is installed. The trivial rows also run whenever there is a row of yours."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Methods without an entry point: module:Class (also from the current directory) or path/to/file.py:Class;
    repeatable."""
    predictions: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=FOLDER of somebody's predictions, a subfolder for each photograph; repeatable."""
    limit: int | None = None
    """Samples, evenly spaced; the tables of a partial run carry a watermark."""
    resolution: int = 512
    """Stanford-ORB: columns of everything, predictions too. IIW, MAW: longest side of what methods are handed."""
    tolerance_deg: float | None = None
    """Stanford-ORB: how far the cameras of two photographs may differ to count as one, for relighting. None: 2."""
    device: Device = "cpu"
    """Where our model runs. auto: cuda, then mps, then cpu, whichever is there."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, of another form, or means nothing for the set.
        """
        from unirender_evaluation.runs.command import named_folders

        at_least(1, limit=self.limit, resolution=self.resolution)
        if self.tolerance_deg is not None and (self.set != "stanford-orb" or not 0 <= self.tolerance_deg <= 180):
            raise UsageError(f"--tolerance-deg {self.tolerance_deg:g}: expected 0 to 180, with stanford-orb only")
        named_folders(self.predictions)

    def reader(self) -> "PublicSet":
        """The reader of the set."""
        from unirender_evaluation.public.iiw import Iiw
        from unirender_evaluation.public.maw import Maw
        from unirender_evaluation.public.orb import TOLERANCE_DEG, StanfordOrb

        if self.set == "iiw":
            return Iiw(self.folder, self.resolution)
        if self.set == "maw":
            return Maw(self.folder, self.resolution)
        tolerance = TOLERANCE_DEG if self.tolerance_deg is None else self.tolerance_deg
        return StanfordOrb(self.folder, self.resolution, tolerance)

    def run(self) -> int:
        """Scores what is missing, prints and writes tables and records; 1 where predictions cannot be scored."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.predictions.check import PredictionError
        from unirender_evaluation.public.files import PublicSetError
        from unirender_evaluation.public.rows import public_rows
        from unirender_evaluation.public.run import PublicRun, run
        from unirender_evaluation.runs.command import named_folders

        public = self.reader()
        rows = public_rows(
            public, self.methods, self.method, named_folders(self.predictions), self.checkpoint, self.device
        )
        what = PublicRun.of(public, rows, self.out or Path("results") / f"public-{self.set}", self.limit)
        try:
            run(what, Console())
        except (PublicSetError, PredictionError) as error:
            print(f"unirender: error: {error}", file=sys.stderr)  # a line for each problem
            return 1
        return 0
