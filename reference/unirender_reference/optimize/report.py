"""Where an optimisation stands, for whoever shows it. Light to import."""

from collections.abc import Callable
from dataclasses import dataclass

from unirender_reference.optimize.views import Step


@dataclass(frozen=True)
class Report:
    """What is shown of a run while it works.

    Attributes:
        step: what was done last.
        stage: number of the stage, from 1.
        stages: how many there are.
        total: steps of this stage, where they are known before it ends.
        remaining: seconds that this stage still takes at its pace so far; None: not known.
    """

    step: Step
    stage: int
    stages: int
    total: int | None
    remaining: float | None


Progress = Callable[[Report], None]
