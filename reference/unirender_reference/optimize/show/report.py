"""Where an optimisation stands, and what to say of it at its end, for whoever shows it. Light to import."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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


FAR = 6.0  # dB by which held-out views are explained worse than others, from which it is said: errors twice as large

OnReport = Callable[[Report], None]  # whoever shows it


def refinement_note(stages: Sequence[Mapping[str, Any]]) -> str | None:
    """A sentence where a refinement found nothing better than its start; None: each did.

    Args:
        stages: of `solution.json`.
    """
    idle = [row["stage"] for row in stages if row.get("kept_step") == 0]
    return f"{', '.join(idle)}: no gain on the held-out views, the start was kept" if idle else None


def views_note(figures: Mapping[str, float]) -> str | None:
    """A sentence where held-out views are explained much worse than those that were fitted; None: they are not.

    Args:
        figures: of `solution.json`.
    """
    gap = figures["seen_psnr_db"] - figures.get("held_out_psnr_db", figures["seen_psnr_db"])
    if gap < FAR:
        return None
    return (
        f"held-out views are {gap:.1f} dB worse: what was found suits the pictures that it was fitted to more than the "
        "object; judge it by the held-out figure, and expect no better of other views and lights; pictures from more "
        "sides may help"
    )
