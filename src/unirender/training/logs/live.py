"""What a user sees of a training run: one live line in a terminal, plain lines anywhere else."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from unirender.training.config import OptimizerConfig

Report = Callable[[dict[str, Any]], None]

RATES = ("step", "minutes", "samples_per_s")  # entries of a line of losses; the others are its losses


@contextlib.contextmanager
def live_report(steps: int | None, minutes: float | None, console: Console) -> Iterator[Report]:
    """Gives the function that shows a line of the log.

    Args:
        steps: length of the run, if it has one in steps.
        minutes: the same in minutes.
        console: where to. Its lines of losses replace each other if it is a terminal; all else stands.
    """
    if not console.is_terminal:
        yield lambda line: console.print(words(line), soft_wrap=True, highlight=False, markup=False)
        return
    with Live(console=console, auto_refresh=False, transient=False) as live:

        def report(line: dict[str, Any]) -> None:
            if "samples_per_s" in line:
                live.update(progress_line(line, steps, minutes), refresh=True)
            else:
                console.print(words(line), highlight=False, markup=False)

        yield report


def progress_line(line: dict[str, Any], steps: int | None, minutes: float | None) -> Group:
    """A bar with step, minutes and samples/s, and the losses below it."""
    done = max(line["step"] / steps if steps else 0.0, line["minutes"] / minutes if minutes else 0.0)
    step = f"step {line['step']}" + (f" of {steps}" if steps else "")
    clock = f"{line['minutes']:.1f}" + (f" of {minutes:g}" if minutes else "") + " min"
    row = Table.grid(padding=(0, 2))
    row.add_row(ProgressBar(total=1.0, completed=done, width=30), step, clock, f"{line['samples_per_s']:.1f} samples/s")
    losses = {name: value for name, value in line.items() if name not in RATES}
    return Group(row, Text(words(losses), style="dim"))


def standing(step: int, done_minutes: float, steps: int | None, minutes: float | None) -> str:
    """Where a run that is taken up again stands, and what would prolong it if it is over.

    Args:
        step: steps done.
        done_minutes: of training.
        steps: length of the run, if it has one in steps.
        minutes: the same in minutes.
    """
    place = f"step {step}" + (f" of {steps}" if steps else "")
    place += f", after {done_minutes:.1f} of {minutes:g} minutes" if minutes else ""
    ends = {f"--steps (more than {step})": bool(steps and step >= steps)}
    longest = max(minutes or 0, math.ceil(10 * done_minutes) / 10)
    ends |= {f"--minutes (more than {longest:g})": bool(minutes and done_minutes >= minutes)}
    reached = [option for option, end in ends.items() if end]
    if not reached:
        return f"resumed at {place}"
    return f"finished at {place}: nothing to train; pass {' and '.join(reached)} to go on from there"


def never_at_peak(step: int, config: OptimizerConfig) -> str | None:
    """In words: a run that ended at this step has learned at a small rate only; None: it was past the warm-up."""
    if step > config.warmup_steps:
        return None
    return (
        f"the run ended at step {step}, and the learning rate rises for {config.warmup_steps} steps: it never reached "
        f"its peak of {config.learning_rate:g}; pass more --steps or --minutes to go on"
    )


def words(line: dict[str, Any]) -> str:
    """`name value  name value ...`, numbers to four digits."""
    parts: list[str] = []
    for name, value in line.items():
        if isinstance(value, dict):
            parts.append(f"{name}: {words(value)}")
        else:
            parts.append(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
    return "  ".join(parts)
