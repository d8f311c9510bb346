"""What a physics test is: formula, unit, direction, what a perfect renderer scores, and a twin that must fail.

A *renderer* test asks a function `maps -> image`, a *decomposer* test a function `(stage, material, picture) -> maps`,
a *posterior* test the same for samples of the material (a method sees the picture alone; Mitsuba and the twins know the
rest; see `questions`). A test is sound where its twin (`twins`) is worse than Mitsuba on the same
scenes by more than its margin.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from unirender_evaluation.metrics import Metric, metric_key
from unirender_evaluation.physics.stage import Stage


@dataclass(frozen=True)
class PhysicsTest:
    """One test; `run`, `twin` and `expected` are of a renderer, a decomposer or a posterior, whichever it asks."""

    name: str  # as in records: the quantity of its metric key
    label: str  # as in tables
    formula: str  # one line; notation of `physics`
    metric: Metric  # unit, direction and decimals
    expected: float | str  # value of a perfect one, noise apart; in words where it is the scene's
    asks: Literal["render", "decompose", "sample"]
    run: Callable[[Any, Stage], float]  # (who is asked, stage) -> value
    twin: Any  # a broken one
    twin_is: str  # what is broken, in words
    margin: float  # how much worse than Mitsuba on the same scenes counts as failing
    in_run: bool = True  # whether `bench run` measures it, or `bench physics` alone

    @property
    def key(self) -> str:
        """The metric key of its value."""
        return metric_key(self.name, self.metric)

    def fails(self, value: float, mitsuba: float) -> bool:
        """Whether a value is worse than Mitsuba's by more than the margin."""
        return (mitsuba - value if self.metric.higher_is_better else value - mitsuba) > self.margin
