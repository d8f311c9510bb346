"""What the parts of the speed study share: timing, and what a part hands back.

Everything is measured in one run on one machine, so that its *ratios* can be compared between machines; seconds are
those of this one. Nothing is stored for a later run. Parts:

    network     milliseconds of `decompose` and `render` by steps and batch     `network`
    mitsuba     against Mitsuba rendering to the same PSNR                      `mitsuba`
    start       cold start of the command line                                  `start`
    training    samples/s against bare forward and backward passes              `training`
    overfit     minutes until one object under one light is reproduced          `overfit`
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from unirender_evaluation.studies.speed.parts import PartName
from unirender_evaluation.tables.text import TextTable


@dataclass(frozen=True)
class Part:
    """What a part found."""

    name: PartName  # which
    tables: tuple[TextTable, ...]  # to print
    data: dict[str, Any]  # the same in full, for JSON


@dataclass(frozen=True)
class Timing:
    """Seconds of one action, several times."""

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    def to_json(self) -> dict[str, Any]:
        """Median and every repeat."""
        return {"median_s": self.median, "repeats_s": list(self.seconds)}


def timed(action: Callable[[], Any], repeats: int) -> Timing:
    """Runs an action and measures it; the first run does not count."""
    found = []
    action()
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        found.append(time.perf_counter() - start)
    return Timing(tuple(found))


def medians(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The median of every entry over at least one row."""
    return {name: statistics.median(row[name] for row in rows) for name in rows[0]}


def aim_text(what: str, value: float, sign: Literal["<=", ">="], bound: float) -> str:
    """Whether an aim is met, as a sentence."""
    met = value <= bound if sign == "<=" else value >= bound
    return f"Aim: {what} {sign} {bound:g}: {value:.2f}, {'met' if met else 'not met'}."
