"""`unirender bench ...`: the benchmark's commands. Light to import; each command loads what it needs when it runs."""

import json
import secrets
import sys
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from unirender.errors import UnirenderError, UsageError
from unirender.options import Device, at_least
from unirender_evaluation.crosscheck_command import BenchCrosscheck
from unirender_evaluation.derived_light_study_command import BenchDerivedLight
from unirender_evaluation.optimiser_study_commands import BenchIngredients, BenchRace
from unirender_evaluation.physics_command import BenchPhysics
from unirender_evaluation.public_command import BenchPublic
from unirender_evaluation.results_commands import BenchCompare, BenchLs, BenchTables, BenchValidate, asked_variants
from unirender_evaluation.sampling_study_command import BenchSampling
from unirender_evaluation.shard_scores_command import BenchShards
from unirender_evaluation.speed_study_command import BenchSpeed
from unirender_evaluation.subsets import STANDARD, WHOLE, Subsets
from unirender_evaluation.throughput_command import BenchThroughput
from unirender_evaluation.training_study_command import BenchTraining
from unirender_evaluation.unknown_mesh_command import BenchUnknownMesh
from unirender_evaluation.warm_start_command import BenchWarmStart


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
    """Of sampling methods."""
    check_scenes: int = 4
    """Scenes that Mitsuba renders again on the spot; at least 1."""
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
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, or of another form.
        """
        at_least(1, limit=self.limit, check_scenes=self.check_scenes)
        at_least(0, check_seed=self.check_seed, sample_scenes=self.sample_scenes, jobs=self.jobs)
        at_least(0, optimise_scenes=self.optimise_scenes, view_objects=self.view_objects)
        if not -(2**63) <= self.seed < 2**64:
            raise UsageError(f"--seed {self.seed}: expected an integer of 64 bits")
        if self.cluster is not None and self.jobs is not None:
            raise UsageError(f"--jobs {self.jobs}: expected none with --cluster, whose workers are its own")
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

        from unirender_evaluation import benchmark
        from unirender_evaluation.bench_config import BenchConfig
        from unirender_evaluation.prediction_check import PredictionError
        from unirender_evaluation.table_formats import print_table

        if self.cluster is not None:
            from unirender_reference.cluster import check_address

            check_address(self.cluster)
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
                from unirender_evaluation.dry_run import planned, print_plan

                print_plan(planned(config), console)
                return 0
            result = benchmark.run(config, console)
        except PredictionError as error:
            print(f"unirender: error: {error}", file=sys.stderr)  # a line for each problem
            return 1
        for table in result.tables:
            print_table(console, table)
        console.print(result.verdict, markup=False, highlight=False)
        console.print(f"{result.computed} new records of {len(result.records)}; report: {self.out / 'report.html'}")
        return 0 if result.truth_check.get("passed") else 1


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

        from unirender_evaluation.suites import load_suite
        from unirender_evaluation.truth_check import TruthCheck, check_truth

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
        """Renders what is missing."""
        self.check()
        from rich.console import Console
        from rich.progress import Progress

        from unirender.paths import cache_dir
        from unirender_evaluation.suite_home import target
        from unirender_evaluation.suites import load_suite
        from unirender_evaluation.truth import make_truth, quality_summary

        work, console = self.work or cache_dir() / "truth", Console()
        folders = {"out": self.out, "objects": self.objects, "lights": self.lights}
        with Progress(console=console, transient=not console.is_terminal) as progress:
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
        return 0


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
        from unirender_evaluation.report_run import rebuild

        path = rebuild(self.folder, self.suite, asked_variants(self.variant))
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
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
        from unirender.files import new_folder
        from unirender_evaluation.export import export_inputs
        from unirender_evaluation.suites import load_suite

        with new_folder(self.out) as folder:
            count = export_inputs(load_suite(self.suite), folder, self.limit)
        print(f"{self.out}: {count} questions")
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
            | Annotated[BenchCrosscheck, tyro.conf.subcommand("crosscheck")]
            | Annotated[BenchThroughput, tyro.conf.subcommand("throughput")]
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
