"""Milliseconds of a decomposition and of a render at the suite's resolution, by steps and batch.

What users call is timed, `pipeline.decompose` and `pipeline.render`: everything between a numpy picture and numpy maps.
A batch of n is a call for n samples, which is one batch of the network; its time is divided by n. Decompositions are
not closed, except in their own row: closing renders the predicted maps once more.
"""

from dataclasses import dataclass
from typing import Any

from unirender_evaluation.studies.speed.timing import Part, Timing, timed
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tables.formats import MISSING
from unirender_evaluation.tables.text import TextTable
from unirender_evaluation.tasks import picture

STEPS = (1, 4, 10)
BATCHES = (1, 16)
DECOMPOSE, CLOSED, RENDER = "decompose", "decompose, closed", "render"
NOTE = (
    "Milliseconds per picture through `pipeline.decompose` and `pipeline.render`, median of {repeats} after a warm-up. "
    "A batch of n: one call for n samples, its time divided by n. Closed: what `decompose` does by default; it "
    "renders once more. Render: the true maps, s and d among them."
)


@dataclass(frozen=True)
class NetworkTime:
    """One action."""

    what: str  # `DECOMPOSE`, `CLOSED` or `RENDER`
    steps: int  # of the sampler
    batch: int  # samples in one call
    timing: Timing  # of the call

    @property
    def milliseconds(self) -> float:
        """Per picture."""
        return 1e3 * self.timing.median / self.batch


def network_times(pipeline: Any, suite: Suite, scene: Scene, repeats: int) -> list[NetworkTime]:
    """Times every action on one scene."""
    import torch

    seen = picture(suite, scene, suite.spec.base)
    given = suite.intrinsics(scene, suite.spec.base).replace(environment=None)
    found = []
    for batch in BATCHES:
        for steps in STEPS:
            how: dict[str, Any] = {
                "mode": "sample",
                "num_inference_steps": steps,
                "num_samples": batch,
                "generator": torch.Generator().manual_seed(0),
            }
            actions = {
                DECOMPOSE: lambda how=how: pipeline.decompose(**seen, closed=False, **how),
                RENDER: lambda how=how: pipeline.render(given, **how),
            }
            if batch == 1:
                actions[CLOSED] = lambda how=how: pipeline.decompose(**seen, closed=True, **how)
            found += [NetworkTime(what, steps, batch, timed(action, repeats)) for what, action in actions.items()]
    return found


def network_part(pipeline: Any, suite: Suite, scene: Scene, repeats: int) -> Part:
    """The part `network`."""
    found = network_times(pipeline, suite, scene, repeats)
    size = suite.spec.resolution
    data = [
        {"what": t.what, "steps": t.steps, "batch": t.batch, "ms_per_picture": t.milliseconds, **t.timing.to_json()}
        for t in found
    ]
    return Part("network", (network_table(found, size, repeats),), {"resolution": size, "times": data})


def network_table(found: list[NetworkTime], size: int, repeats: int) -> TextTable:
    """An action a row; batch and steps across."""
    by_key = {(t.what, t.batch, t.steps): t for t in found}
    rows = []
    for what in (DECOMPOSE, CLOSED, RENDER):
        own = [by_key.get((what, batch, steps)) for batch in BATCHES for steps in STEPS]
        rows.append((what, *(MISSING if one is None else f"{one.milliseconds:.1f}" for one in own)))
    titles = ("ms per picture", *(f"batch {b}, {s} step{'s' * (s > 1)}" for b in BATCHES for s in STEPS))
    return TextTable(f"The network at {size} px", titles, (tuple(rows),), (NOTE.format(repeats=repeats),))
