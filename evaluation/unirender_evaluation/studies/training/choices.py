"""What the choices of training are worth: one small network, the same data and steps, one thing changed at a time.

Every row begins with one preset and differs from it in what its label says: by default with the paper's plain model
(Sec. 3.2's timesteps, no physics prior, a cycle whose gradient does not reach the renderer). Rows are trained from the
same seed on the same samples, so that differences are paired by scene; the row `seed` differs in nothing but its seed,
and shows what chance is worth.
"""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from unirender.training.config import TrainConfig
from unirender.training.presets import get_preset

PLAIN = "plain"
BASE_PRESET = "tiny_plain"
QUESTIONS = {
    "chance": "Chance",
    "timesteps": "Timesteps",
    "cycle": "Cycle consistency",
    "physics": "Physics",
    "batches": "Batches",
    "optimizer": "Optimiser",
    "network": "Network",
}


@dataclass(frozen=True)
class Choice:
    """A row of the study."""

    name: str  # on the command line and in records
    group: str  # the question that it answers, key of `QUESTIONS`; empty for the plain model
    label: str  # what is different
    config: TrainConfig  # of the training


def training_choices(seed: int = 0, batch_size: int | None = None, preset: str = BASE_PRESET) -> tuple[Choice, ...]:
    """All rows, the one that the others are changes of first; without those that another row is already.

    Raises:
        UnirenderError: no such preset.
    """
    base = replace(get_preset(preset), seed=seed)
    base = base if batch_size is None else replace(base, batch_size=batch_size)

    def run(name: str, group: str, label: str, **changes: Any) -> Choice:
        return Choice(name, group, label, replace(base, **changes))

    def loss(name: str, group: str, label: str, **changes: Any) -> Choice:
        return run(name, group, label, loss=replace(base.loss, **changes))

    def model(name: str, group: str, label: str, **changes: Any) -> Choice:
        return run(name, group, label, model=replace(base.model, **changes))

    def optimizer(name: str, label: str, **changes: Any) -> Choice:
        return run(name, "optimizer", label, optimizer=replace(base.optimizer, **changes))

    whole, halves = (asdict(get_preset(name).model) for name in ("tiny", "tiny_without_unified"))
    side_by_side = math.gcd(get_preset("tiny_one_at_a_time").group_size, base.batch_size)
    rows = (
        Choice(PLAIN, "", "Plain model" if preset == BASE_PRESET else f"`{preset}`", base),
        run("seed", "chance", "another seed", seed=seed + 1),
        run("algorithm1", "timesteps", "Algorithm 1 of the supplement", timestep_rule="algorithm1"),
        run("only-pure-noise", "timesteps", "always pure noise (p_t = 0)", p_t=0.0),
        run("half-noise", "timesteps", "any noise as often as pure noise (p_t = 0.5)", p_t=0.5),
        loss("no-cycle", "cycle", "no cycle", cycle=0.0),
        loss("into-renderer", "cycle", "its gradient reaches the renderer", cycle_into_renderer=True),
        loss("composite-loss", "physics", "composite of the maps against the picture", composite=1.0),
        model("composite-prior", "physics", "prior: composite", physics_prior="composite"),
        model("split-sum-prior", "physics", "prior: split-sum", physics_prior="split_sum"),
        run(
            "one-at-a-time",
            "batches",
            f"runs of {side_by_side} pictures differ in one thing only",
            group_size=side_by_side,
        ),
        optimizer("fast", "twice the learning rate", learning_rate=2 * base.optimizer.learning_rate),
        optimizer("muon", "Muon for hidden matrices", kind="muon"),
        optimizer(
            "muon-fast",
            "Muon at twice the learning rate",
            kind="muon",
            learning_rate=2 * base.optimizer.learning_rate,
        ),
        model("patch-1", "network", "pixels as they are", patch=1),
        model("patch-4", "network", "4 x 4 pixels a latent", patch=4),
        model(
            "without-unified",
            "network",
            "two networks of half the size, one per direction",
            **{name: value for name, value in halves.items() if value != whole[name]},
        ),
    )
    return tuple(row for i, row in enumerate(rows) if row.config not in [earlier.config for earlier in rows[:i]])
