"""`unirender bench run`: its options, and what it refuses of them. Light to import."""

import sys
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.errors import UsageError
from unirender_evaluation.results.commands import asked_variants
from unirender_evaluation.subsets import STANDARD, WHOLE, Subsets

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from unirender_evaluation.tables.build import Table

CLAIM = 9  # columns before a claim of the verdict: whether it holds
FOLDED = ("  stated ", "  not run ")  # lines of the verdict that claim nothing


@dataclass(frozen=True)
class BenchRun:
    """Score methods on a suite: tables, verdict, per-sample records and an HTML report. A second run continues."""

    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    out: Path = Path("results")
    """Folder of the run."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: the shipped one for pictures of the
    suite's size."""
    methods: tuple[str, ...] = ("ours", "optimisation", "trivial", "plugins")
    """Groups of rows; optimisation: of each picture, and the multi-view table; plugins: what is installed. The trivial
    rows also run whenever there is a row of yours."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Methods without an entry point: module:Class (also from the current directory) or path/to/file.py:Class, then
    ?name=value&name=value for its arguments; repeatable."""
    predictions: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=FOLDER of somebody's predictions (`unirender bench export` writes the inputs); repeatable."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """How the numbers of tables and report are taken: masked or whole, srgb or linear, raw, aligned or aligned_rgb,
    with - between (masked-linear), or all; repeatable. None: whole beside the published values, and masked."""
    limit: int | None = None
    """Scenes; the tables of a partial run carry a watermark."""
    seed: int = 0
    """Seed of sampling methods."""
    check_scenes: int = 4
    """Scenes that Mitsuba renders again on the spot; 0: none, and the tables say that their truth is unchecked."""
    check_seed: int | None = None
    """Chooses them; None: drawn anew in a new folder, kept in one that is continued."""
    recheck: bool = False
    """Render them again also where the folder holds a check of the same truth, code and seed."""
    dry_run: bool = False
    """Print what would be computed and what is stored, by row; compute and write nothing."""
    sample_scenes: int | None = None
    """Scenes of the sampling rows; 0 leaves them out. None: 4, with `--full` all."""
    optimise_scenes: int | None = None
    """Scenes of the rows that optimise each picture; 0 leaves them out. None: 4, with `--full` all."""
    view_objects: int | None = None
    """Objects of the multi-view table; 0 leaves it out. None: 4, with `--full` all."""
    jobs: int | None = None
    """Worker processes of one thread each; 0: all in this one. None: 2."""
    cluster: str | None = None
    """Compute on a cluster instead: tcp://HOST:PORT of a dask scheduler, slurm, or slurm:JOBS."""
    device: Device = "cpu"
    """Where our model runs. auto: cuda, then mps, then cpu, whichever is there."""
    full: bool = False
    """Run what is slow on all scenes instead of on its fixed subset: sampling and optimisation rows, `shade(true
    maps)`, the physics and the multi-view table."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range, or of another form."""
        at_least(1, limit=self.limit)
        at_least(0, check_scenes=self.check_scenes, check_seed=self.check_seed)
        at_least(0, sample_scenes=self.sample_scenes, jobs=self.jobs)
        at_least(0, optimise_scenes=self.optimise_scenes, view_objects=self.view_objects)
        if not -(2**63) <= self.seed < 2**64:
            raise UsageError(f"--seed {self.seed}: expected an integer of 64 bits")
        if self.cluster is not None and self.jobs is not None:
            raise UsageError(f"--jobs {self.jobs}: expected none with --cluster, whose workers are its own")
        if self.cluster is not None:
            from unirender_reference.cluster import check_address

            check_address(self.cluster)
        if not self.check_scenes and (self.recheck or self.check_seed is not None):
            option = "--recheck" if self.recheck else f"--check-seed {self.check_seed}"
            raise UsageError(f"{option}: expected none with --check-scenes 0, which renders nothing again")
        if not (self.methods or self.method or self.predictions):
            raise UsageError("--methods: got no group, expected some of ours, optimisation, trivial and plugins")
        named_folders(self.predictions)
        asked_variants(self.variant)

    @property
    def subsets(self) -> Subsets:
        """On how many scenes the slow rows run."""
        given = {"sample": self.sample_scenes, "optimise": self.optimise_scenes, "views": self.view_objects}
        return replace(WHOLE if self.full else STANDARD, **{k: v for k, v in given.items() if v is not None})

    def run(self) -> int:
        """Returns the exit status: 1 where predictions cannot be scored or the truth does not stand up to Mitsuba."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.predictions.check import PredictionError
        from unirender_evaluation.runs import benchmark
        from unirender_evaluation.runs.config import BenchConfig
        from unirender_evaluation.tables.formats import print_tables

        console = Console()
        config = BenchConfig(
            suite=self.suite,
            out=self.out,
            checkpoint=self.checkpoint,
            methods=self.methods,
            method=self.method,
            predictions=named_folders(self.predictions),
            limit=self.limit,
            seed=self.seed,
            check_scenes=self.check_scenes,
            check_seed=self.check_seed,
            recheck=self.recheck,
            jobs=2 if self.jobs is None else self.jobs,
            cluster=self.cluster,
            device=self.device,
            subsets=self.subsets,
            variants=asked_variants(self.variant),
        )
        try:
            if self.dry_run:
                from unirender_evaluation.runs.dry_run import planned, print_plan

                print_plan(planned(config), console)
                return 0
            result = benchmark.run(config, console)
        except PredictionError as error:
            print(f"unirender: error: {error}", file=sys.stderr)  # a line for each problem
            return 1
        shown = shown_tables(result.tables)
        print_tables(console, shown)
        print_verdict(console, result.verdict, self.out)
        if others := [table.heading for table in result.tables if table not in shown]:
            said = f"{len(others)} more tables in {self.out / 'tables.md'} (`unirender bench tables {self.out}`): "
            console.print(said + "; ".join(others), highlight=False, markup=False)
        checked = " beside the truth check's" if self.check_scenes else ""
        counts = f"{result.computed} new records of {result.asked}{checked}"
        console.print(f"{counts}; report: {self.out / 'report.html'}", highlight=False, markup=False)
        return 1 if result.truth_check.get("passed", False) is False else 0


def shown_tables(tables: "Sequence[Table]") -> "list[Table]":
    """What a run prints of its tables: all that a row of yours answers; the paper's protocols and the physics, unless
    your row ran without ours and has no answer there."""
    from unirender_evaluation.physics.tests import PHYSICS_TABLE
    from unirender_evaluation.tables.specs import PROTOCOLS

    kinds = [{row.kind for row in table.rows} for table in tables]
    yours = any("external" in own for own in kinds)
    return [
        table
        for table, own in zip(tables, kinds, strict=True)
        if "external" in own
        or (
            (PROTOCOLS[table.protocol_key].published or table.name == PHYSICS_TABLE.name)
            and ("ours" in own or not yours)
        )
    ]


def print_verdict(console: "Console", verdict: str, out: Path) -> None:
    """A claim on each line, without lines that claim nothing; at a terminal that is narrower its rest is set below its
    beginning."""
    lines = verdict.splitlines()
    kept = [line for line in lines if not line.startswith(FOLDED)]
    if folded := len(lines) - len(kept):
        kept.append(f"  ({folded} more lines, which claim nothing: {out / 'verdict.txt'})")
    for line in kept:
        shown = (
            textwrap.fill(line, console.width, subsequent_indent=CLAIM * " ", break_on_hyphens=False)
            if console.is_terminal
            else line
        )
        console.print(shown, markup=False, highlight=False, soft_wrap=True)


def named_folders(pairs: tuple[str, ...]) -> dict[str, Path]:
    """`NAME=FOLDER` strings as a dict.

    Raises:
        UsageError: a string of another form, or a name given twice.
    """
    folders: dict[str, Path] = {}
    for pair in pairs:
        name, separator, folder = pair.partition("=")
        if not (name and separator and folder):
            raise UsageError(f"--predictions {pair}: expected NAME=FOLDER")
        if name in folders:
            raise UsageError(f"--predictions {name}: given twice, expected one folder for each name")
        folders[name] = Path(folder)
    return folders
