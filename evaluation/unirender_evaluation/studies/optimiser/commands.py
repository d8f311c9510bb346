"""`unirender bench ingredients` and `unirender bench race`. Light to import; each loads what it needs when it runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from unirender.command_line.option_checks import at_least


@dataclass(frozen=True)
class BenchIngredients:
    """Measure what each ingredient of the optimiser is worth on objects of the multi-view table. A second run
    continues. All rows take 60 to 80 minutes on 2 cores.
    """

    out: Path = Path("results/ingredients")
    """Folder of the study: records.jsonl, ingredients.md, ingredients.json."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    objects: int = 4
    """Objects, evenly spaced."""
    variants: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all)")] = ()
    """Rows by name, or groups of them: start, refinement, priors, grey. The full method is always one."""
    seed: int = 0
    """Seed of the optimiser."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        from unirender_evaluation.studies.optimiser.ingredients import ingredients
        from unirender_evaluation.studies.rows import chosen

        at_least(1, objects=self.objects)
        at_least(0, seed=self.seed)
        chosen(ingredients(self.seed), self.variants, "--variants")

    def run(self) -> int:
        """Measures what is missing and prints the tables."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.studies.folder import open_folder, write_files
        from unirender_evaluation.studies.optimiser import tables as texts
        from unirender_evaluation.studies.optimiser.ingredients import ingredients
        from unirender_evaluation.studies.optimiser.measure import measure_all, rendered_protocol
        from unirender_evaluation.studies.optimiser.study import Study
        from unirender_evaluation.studies.rows import chosen

        console = Console()
        with open_folder(self.out) as folder:
            study = Study.of(self.suite, self.objects, self.seed, "studies/optimiser/measure")
            rows = chosen(ingredients(self.seed), self.variants, "--variants")
            records = measure_all(study, rows, folder, console)
            lines, protocol = texts.summarise(rows, records), rendered_protocol(study)
            files = {
                "ingredients.md": texts.to_markdown(lines, protocol),
                "ingredients.json": texts.to_json(lines, records, protocol),
            }
            write_files(folder, files)
        texts.show(console, lines, protocol)
        return 0


@dataclass(frozen=True)
class BenchRace:
    """Race the optimiser against the plain loop of Mitsuba's tutorials to the same albedo error. A second run
    continues with the objects that are missing. Takes about 27 minutes on 2 cores.
    """

    out: Path = Path("results/race")
    """Folder of the race: curves.jsonl, race.md, race.json, race.png."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    objects: int = 4
    """Objects, evenly spaced."""
    seed: int = 0
    """Seed of both."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, objects=self.objects)
        at_least(0, seed=self.seed)

    def run(self) -> int:
        """Runs what is missing and prints the table."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.studies.folder import open_folder, write_files
        from unirender_evaluation.studies.optimiser.race import RaceSettings, race_all
        from unirender_evaluation.studies.optimiser.race_report import draw, race_table, to_json
        from unirender_evaluation.studies.optimiser.study import Study
        from unirender_reference.optimize.multiview.config import OptimizeConfig

        console = Console()
        with open_folder(self.out) as folder:
            study = Study.of(self.suite, self.objects, self.seed, "studies/optimiser/race")
            settings = RaceSettings(OptimizeConfig(seed=self.seed))
            races = race_all(study, settings, folder, console)
            plain = f"Adam, {settings.iterations} steps of 16 samples, measured every {settings.plain_every} steps"
            protocol = study.protocol(**{"plain loop": plain})
            table = race_table(races, protocol)
            files = {"race.md": table.markdown(), "race.json": to_json(races, protocol), "race.png": draw(races)}
            write_files(folder, files)
        table.show(console)
        return 0
