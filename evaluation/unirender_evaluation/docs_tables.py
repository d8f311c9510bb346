"""Copies the tables and plots of studies into the documentation, so that no number is typed.

    python -m unirender_evaluation.docs_tables results/speed results/sampling [--docs docs] [--check] [--partial]

Each folder is one that a study's command wrote. A page of the documentation includes a study's tables from a file of
their own, whose name begins with an underscore; plots go to `_static/`. `--check` writes nothing and says what differs.
A study that was run without some of its rows is refused, unless with `--partial`; `--piece NAME` gives a second run of
a study, say on other data, a file of its own.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError, UsageError
from unirender_evaluation.studies.folder import write_files
from unirender_evaluation.studies.optimiser.ingredients import ingredients
from unirender_evaluation.studies.speed.parts import PARTS
from unirender_evaluation.studies.training.choices import BASE_PRESET, training_choices

PLOT_FOLDER = "_static"
HEADING = "### "  # of a table: pages include it below a heading of the second level


@dataclass(frozen=True)
class Plot:
    """A picture that a study writes beside its tables.

    Attributes:
        file: its name, in the study's folder and in the documentation.
        alt: what it shows, for who cannot see it.
        caption: below it.
    """

    file: str
    alt: str
    caption: str

    def markdown(self) -> str:
        """The picture as a page of the documentation shows it."""
        return f"```{{figure}} {PLOT_FOLDER}/{self.file}\n:alt: {self.alt}\n{self.caption}\n```\n"


@dataclass(frozen=True)
class Study:
    """A study whose results the documentation shows.

    Attributes:
        tables: file of its tables, in the folder that it writes; no two studies have the same.
        piece: file of the documentation that a page includes.
        plots: below the tables.
        rows: gives the names of all rows, or parts, that options can choose from, of what the study's JSON says of its
            run; None: there are no such options.
    """

    tables: str
    piece: str
    plots: tuple[Plot, ...] = ()
    rows: Callable[[Mapping[str, Any]], Sequence[str]] | None = None


def _choices(run: Mapping[str, Any]) -> list[str]:
    return [choice.name for choice in training_choices(preset=run.get("preset", BASE_PRESET))]


def _ingredients(run: Mapping[str, Any]) -> list[str]:
    return [ingredient.name for ingredient in ingredients()]


STUDIES = (
    Study("speed.md", "_speed.md", rows=lambda run: PARTS),
    Study(
        "sampling.md",
        "_sampling.md",
        (
            Plot(
                "sampling.png",
                "PSNR of albedo and of the render over steps less that of mode mean, a line for each number of samples",
                "PSNR against steps, less that of mode `mean` on the same pictures; bars: the paired 95 % intervals.",
            ),
            Plot(
                "calibration.png",
                "error over spread, a panel for each map, on logarithmic axes",
                "Error of the samples' mean against their spread, in each map's own units, pixels grouped by spread. A "
                "dot's area is its share of the pixels; a spread below 0.004 stands at the left edge.",
            ),
        ),
    ),
    Study("derived_light.md", "_derived_light.md"),
    Study("physics.md", "_physics.md"),
    Study("training.md", "_training_choices.md", rows=_choices),
    Study("ingredients.md", "_optimization_ingredients.md", rows=_ingredients),
    Study("race.md", "_optimization_race.md"),
    Study("unknown_mesh.md", "_optimization_unknown_mesh.md"),
    Study("warm_start.md", "_optimization_warm_start.md"),
)


def study_of(folder: Path) -> Study:
    """The study that wrote a folder, by the file of its tables.

    Raises:
        UnirenderError: the tables of none, or of several, are there.
    """
    found = [study for study in STUDIES if (folder / study.tables).is_file()]
    if len(found) != 1:
        got = " and ".join(study.tables for study in found) or "none of them"
        expected = ", ".join(study.tables for study in STUDIES)
        raise UnirenderError(f"{folder}: got {got}, expected a study's folder, with one of {expected}")
    return found[0]


def missing(folder: Path, study: Study) -> list[str]:
    """The rows that a study was run without, by the JSON that it writes beside its tables.

    Raises:
        UnirenderError: the JSON is missing or broken.
    """
    if study.rows is None:
        return []
    path = (folder / study.tables).with_suffix(".json")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = content.get("rows", content)
        found = {row["name"] for row in rows} if isinstance(rows, list) else set(rows)
        possible = study.rows(content.get("run", {}))
    except (OSError, ValueError, AttributeError, TypeError, KeyError) as error:
        raise UnirenderError(f"{path}: cannot be read as what the study wrote ({error}); run it again") from error
    return [name for name in possible if name not in found]


def pieces(folder: Path, partial: bool = False, piece: str | None = None) -> dict[str, str | bytes]:
    """What the documentation shows of a study: path below the documentation's folder -> content.

    Args:
        folder: that the study wrote.
        partial: take a study that was run without some of its rows, and say below the tables which they are.
        piece: file of the documentation that the tables go to; None: the study's.

    Raises:
        UnirenderError: the folder is no study's, its tables are none, a plot is missing, or, without `partial`, a row.
    """
    study = study_of(folder)
    text = (folder / study.tables).read_text(encoding="utf-8")
    if not text.startswith(HEADING):
        raise UnirenderError(
            f"{folder / study.tables}: got {text[:40]!r}, expected a table below a heading {HEADING!r}; "
            "run the study again"
        )
    absent = ", ".join(missing(folder, study))
    if absent and not partial:
        raise UnirenderError(
            f"{folder}: a part of the study, without {absent}; run it without options that choose, or pass --partial"
        )
    left_out = [f"Not measured in this run: {absent}.\n"] if absent else []
    shown = [text, *left_out, *(plot.markdown() for plot in study.plots)]
    found: dict[str, str | bytes] = {piece or study.piece: "\n".join(shown)}
    for plot in study.plots:
        path = folder / plot.file
        if not path.is_file():
            raise UnirenderError(f"{path}: no such file, expected the study's plot; run the study again")
        found[f"{PLOT_FOLDER}/{plot.file}"] = path.read_bytes()
    return found


def differing(docs: Path, content: dict[str, str | bytes]) -> list[str]:
    """The paths below the documentation's folder that are missing there or have other content."""

    def stored(name: str) -> bytes | None:
        return (docs / name).read_bytes() if (docs / name).is_file() else None

    return [name for name, new in content.items() if stored(name) != (new if isinstance(new, bytes) else new.encode())]


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, or 1 with a line on standard error for whatever is wrong or differs."""
    parser = argparse.ArgumentParser(
        prog="python -m unirender_evaluation.docs_tables",
        description="Copies the tables and plots of studies into the documentation.",
    )
    parser.add_argument("folders", type=Path, nargs="+", help="that `unirender bench speed` and the others wrote")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the documentation's sources")
    parser.add_argument("--partial", action="store_true", help="also studies that were run without some of their rows")
    parser.add_argument("--piece", help="file that the tables of a single folder go to, instead of the study's own")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if anything differs")
    arguments = parser.parse_args(argv)
    try:
        if arguments.piece is not None and len(arguments.folders) > 1:
            raise UsageError(f"--piece {arguments.piece}: got {len(arguments.folders)} folders, expected one")
        found = [pieces(folder, arguments.partial, arguments.piece) for folder in arguments.folders]
        content = {name: value for of_one in found for name, value in of_one.items()}
        changed = differing(arguments.docs, content)
        if arguments.check:
            for name in changed:
                print(f"{arguments.docs / name}: not what the study wrote", file=sys.stderr)
            return int(bool(changed))
        for name in changed:
            path = arguments.docs / name
            write_files(path.parent, {path.name: content[name]})
            print(path)
    except (UnirenderError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
