"""Who is faster to the same albedo: the arithmetic of the race, on curves that were measured.

A loop's clock stands while its albedo is measured. A value counts from the moment of its measure on; nothing is
interpolated. The albedo of the start, which is the same grey for everybody, does not count as reached.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from unirender.errors import UnirenderError


@dataclass(frozen=True)
class Point:
    """One measure."""

    iteration: int  # of the descent
    seconds: float  # of work until then
    psnr: float  # of the albedo, dB


@dataclass(frozen=True)
class Curve:
    """How the albedo got better (or worse)."""

    name: str  # who made it
    points: tuple[Point, ...]  # in the order of time

    def __post_init__(self) -> None:
        if not self.points:
            raise UnirenderError(f"race: the curve of {self.name} has no point, expected at least one measure")

    @property
    def best(self) -> Point:
        """The first of the best points."""
        return max(self.points, key=lambda point: (point.psnr, -point.seconds))

    def reaches(self, psnr: float) -> float | None:
        """Seconds after which the albedo is at least that good for the first time; None: never."""
        return next((point.seconds for point in self.points if point.psnr >= psnr), None)

    def at(self, seconds: float) -> float | None:
        """The last value that was there by then; None: none was."""
        return next((point.psnr for point in reversed(self.points) if point.seconds <= seconds), None)


@dataclass(frozen=True)
class Finish:
    """The race on one object."""

    target: float  # the best albedo that any plain loop reaches, dB
    plain: str  # the loop that is there first
    plain_seconds: float  # when
    our_seconds: float | None  # when ours is at least there; None: never
    our_end: Point
    plain_then: float | None  # the best of the plain loops at that time; None: none had been measured

    @property
    def ratio(self) -> float:
        """Our seconds over the plain loop's, to the same albedo; infinite where ours never reaches it."""
        return math.inf if self.our_seconds is None else self.our_seconds / self.plain_seconds


def finish(ours: Curve, loops: Sequence[Curve]) -> Finish:
    """The race of one curve against the faster of several plain loops."""
    target = max(loop.best.psnr for loop in loops)
    times = {loop.name: seconds for loop in loops if (seconds := loop.reaches(target)) is not None}
    plain = min(times, key=lambda name: times[name])
    end = ours.points[-1]
    then = [value for loop in loops if (value := loop.at(end.seconds)) is not None]
    return Finish(target, plain, times[plain], ours.reaches(target), end, max(then, default=None))


def geometric_mean(ratios: Sequence[float]) -> float:
    """Of positive numbers; infinite where one of them is."""
    return math.exp(sum(map(math.log, ratios)) / len(ratios))
