"""`unirender bench training`. Light to import."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.errors import UnirenderError

if TYPE_CHECKING:
    from unirender_evaluation.studies.training.choices import Choice


@dataclass(frozen=True)
class BenchTraining:
    """Train a small network several times, one choice changed each time, and score them all. A second run continues.

    The same data, steps and seed for every row, and every row against the first, paired by scene.
    """

    data: Path
    """Folder that `unirender dataset` wrote."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    out: Path = Path("results/training")
    """Folder of tables, records and training runs."""
    scenes: int = 24
    """Scenes of the suite, evenly spaced, that every network is scored on."""
    steps: int = 1000
    """Steps of every training."""
    preset: str = "tiny_plain"
    """What every row is a change of. `tiny_plain`: the paper's plain model."""
    choices: tuple[str, ...] = ()
    """Rows by name, or by the question that they answer. None: all that can be trained on the data (one-at-a-time needs
    data of that kind)."""
    batch_size: int | None = None
    """Instead of the preset's."""
    parallel: int | None = None
    """As for `unirender train`."""
    device: Device = "auto"
    """As for `unirender train`."""
    seed: int = 0
    """Seed of weights, data order and noise."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, scenes=self.scenes, steps=self.steps, batch_size=self.batch_size, parallel=self.parallel)
        at_least(0, seed=self.seed)

    def run(self) -> int:
        """Trains and scores what is missing, prints and writes `training.md` and `.json`; returns the exit status."""
        self.check()
        from unirender_evaluation.studies.rows import chosen
        from unirender_evaluation.studies.training.choices import training_choices

        rows = chosen(training_choices(self.seed, self.batch_size, self.preset), self.choices, "--choices")
        if not self.data.is_dir():
            raise UnirenderError(
                f"{self.data}: no such data folder, expected one written by `unirender dataset`; pass --data"
            )
        rows = self._possible(rows)
        from rich.console import Console

        from unirender_evaluation.rows import evenly
        from unirender_evaluation.studies.training.run import TrainingStudy, run
        from unirender_evaluation.suites.suite import load_suite

        suite = load_suite(self.suite)
        study = TrainingStudy(suite, self.data, self.out, self.steps, self.device, self.parallel, self.preset)
        run(study, rows, evenly(suite.scenes, self.scenes), Console())
        return 0

    def _possible(self, rows: "Sequence[Choice]") -> "tuple[Choice, ...]":
        """The rows that can be trained on the data; says which are left out."""
        from unirender.training.data.contrasts import ContrastDataset

        possible = []
        for row in rows:
            try:
                if row.config.group_size > 1:
                    ContrastDataset(self.data, run_length=row.config.group_size)
            except UnirenderError as error:
                if self.choices:
                    raise
                print(f"{row.name}: left out ({error})")
            else:
                possible.append(row)
        return tuple(possible)
