"""What a user sees of an optimisation: one live line in a terminal, a line for each stage anywhere else."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from unirender_reference.optimize.show.report import Report

FIGURES = 4  # of a step are shown


@contextlib.contextmanager
def live_report(console: Console) -> Iterator[Callable[[Report], None]]:
    """Gives the function that shows where a run stands; what it shows goes when the block ends.

    Args:
        console: where to. Without a terminal a line is printed when a stage begins.
    """
    if not console.is_terminal:
        begun: set[str] = set()

        def line(report: Report) -> None:
            if report.step.stage not in begun:
                begun.add(report.step.stage)
                console.print(words(report), soft_wrap=True, highlight=False, markup=False)

        yield line
        return
    with Live(console=console, refresh_per_second=8, transient=True) as live:
        yield lambda report: live.update(picture(report))


def picture(report: Report) -> Group:
    """A bar with the stage, its steps and the time it still takes, and figures below it."""
    row = Table.grid(padding=(0, 2))
    done = report.step.iteration / report.total if report.total else None
    row.add_row(ProgressBar(total=1.0, completed=done or 0.0, pulse=done is None, width=30), *parts(report))
    return Group(row, Text(figures(report), style="dim"))


def words(report: Report) -> str:
    """The same as one line."""
    return "  ".join([*parts(report), figures(report)])


def parts(report: Report) -> list[str]:
    """Stage, steps, clock."""
    of = "" if report.total is None else f" of {report.total}"
    left = "" if report.remaining is None else f", {clock(report.remaining)} left of this stage"
    return [
        f"stage {report.stage} of {report.stages}: {report.step.stage}",
        f"step {report.step.iteration}{of}",
        f"{clock(report.step.seconds)}{left}",
    ]


def figures(report: Report) -> str:
    """The first figures of the step."""
    return "  ".join(f"{name} {value:.4g}" for name, value in list(report.step.values.items())[:FIGURES])


def clock(seconds: float) -> str:
    """`12 s`, `3:05 min`, `1:02 h`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
