"""`unirender bench ...`: the benchmark's commands. Light to import; each command loads what it needs when it runs."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from unirender.command_line.option_checks import at_least
from unirender_evaluation.crosscheck_command import BenchCrosscheck
from unirender_evaluation.physics.command import BenchPhysics
from unirender_evaluation.public.command import BenchPublic
from unirender_evaluation.results.commands import (
    BenchCompare,
    BenchLs,
    BenchTables,
    BenchValidate,
    BenchVerdict,
    asked_variants,
)
from unirender_evaluation.runs.command import BenchRun
from unirender_evaluation.shard_scores_command import BenchShards
from unirender_evaluation.studies.derived_light.command import BenchDerivedLight
from unirender_evaluation.studies.optimiser.commands import BenchIngredients, BenchRace
from unirender_evaluation.studies.sampling.command import BenchSampling
from unirender_evaluation.studies.speed.command import BenchSpeed
from unirender_evaluation.studies.training.command import BenchTraining
from unirender_evaluation.studies.unknown_mesh.command import BenchUnknownMesh
from unirender_evaluation.studies.warm_start.command import BenchWarmStart
from unirender_evaluation.truth.commands import BenchCheck, BenchTruth


@dataclass(frozen=True)
class BenchReport:
    """Write the report of a finished run again, from its records and kept pictures. Nothing is measured."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder that `unirender bench run --out` wrote."""
    suite: str | None = None
    """A bundled suite, or the path of a suite's TOML file; None: the name that the run recorded."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """How the numbers of its tables are taken, as in `bench run`; repeatable."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        asked_variants(self.variant)

    def run(self) -> int:
        """Writes `report.html` into the folder."""
        self.check()
        from unirender_evaluation.runs.report import rebuild

        path = rebuild(self.folder, self.suite, asked_variants(self.variant))
        print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB)")
        return 0


@dataclass(frozen=True)
class BenchExport:
    """Write a suite's inputs for foreign code: pictures, masks, lights and what is asked of each."""

    out: Path
    """Folder to write."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    limit: int | None = None
    """Scenes; None: all."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, limit=self.limit)

    def run(self) -> int:
        """Writes the folder."""
        self.check()
        from unirender.new_folders import new_folder
        from unirender_evaluation.export import export_inputs
        from unirender_evaluation.suites.suite import load_suite

        with new_folder(self.out) as folder:
            kinds = export_inputs(load_suite(self.suite), folder, self.limit)
        asked = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
        limit = "" if self.limit is None else f" --limit {self.limit}"
        scores = f"`unirender bench run --suite {self.suite}{limit} --methods plugins --predictions NAME=FOLDER`"
        print(f"{kinds.total()} questions about the pictures in {self.out} ({asked}); {scores} scores the answers")
        return 0


@dataclass(frozen=True)
class Bench:
    """The benchmark: score methods, check, merge and compare results, check the truth, export inputs; studies beside
    it."""

    command: tyro.conf.OmitSubcommandPrefixes[
        Annotated[
            Annotated[BenchRun, tyro.conf.subcommand("run")]
            | Annotated[BenchCheck, tyro.conf.subcommand("check")]
            | Annotated[BenchExport, tyro.conf.subcommand("export")]
            | Annotated[BenchReport, tyro.conf.subcommand("report")]
            | Annotated[BenchTruth, tyro.conf.subcommand("truth")]
            | Annotated[BenchCompare, tyro.conf.subcommand("compare")]
            | Annotated[BenchLs, tyro.conf.subcommand("ls")]
            | Annotated[BenchPhysics, tyro.conf.subcommand("physics")]
            | Annotated[BenchPublic, tyro.conf.subcommand("public")]
            | Annotated[BenchTables, tyro.conf.subcommand("tables")]
            | Annotated[BenchValidate, tyro.conf.subcommand("validate")]
            | Annotated[BenchVerdict, tyro.conf.subcommand("verdict")]
            | Annotated[BenchCrosscheck, tyro.conf.subcommand("crosscheck")]
            | Annotated[BenchDerivedLight, tyro.conf.subcommand("derived-light")]
            | Annotated[BenchIngredients, tyro.conf.subcommand("ingredients")]
            | Annotated[BenchRace, tyro.conf.subcommand("race")]
            | Annotated[BenchSampling, tyro.conf.subcommand("sampling")]
            | Annotated[BenchShards, tyro.conf.subcommand("shards")]
            | Annotated[BenchSpeed, tyro.conf.subcommand("speed")]
            | Annotated[BenchTraining, tyro.conf.subcommand("training")]
            | Annotated[BenchUnknownMesh, tyro.conf.subcommand("unknown-mesh")]
            | Annotated[BenchWarmStart, tyro.conf.subcommand("warm-start")],
            tyro.conf.arg(name=""),
        ]
    ] = field()

    def run(self) -> int:
        """Runs the chosen command."""
        return self.command.run()
