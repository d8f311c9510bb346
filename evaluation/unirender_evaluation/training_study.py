"""What the choices of training are worth: one small network, the same data and steps, one thing changed at a time.

Every row begins with the paper's plain model (Sec. 3.2's timesteps, no physics prior, a cycle whose gradient does not
reach the renderer) and differs from it in what its label says. Rows are trained from the same seed on the same samples,
so that differences are paired by scene; the row `seed` differs in nothing but its seed, and shows what chance is worth.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from unirender.errors import UsageError
from unirender.training.presets import TrainConfig, get_preset

PLAIN = "plain"
BASE_PRESET = "tiny_plain"
QUESTIONS = {
    "chance": "Chance",
    "timesteps": "Timesteps",
    "cycle": "Cycle consistency",
    "physics": "Physics",
    "weights": "Weights of the loss",
    "network": "Network",
}


@dataclass(frozen=True)
class Choice:
    """A row of the study.

    Attributes:
        name: on the command line and in records.
        question: key of `QUESTIONS`; empty for the plain model.
        label: what is different.
        config: of the training.
    """

    name: str
    question: str
    label: str
    config: TrainConfig


def training_choices(seed: int = 0, batch_size: int | None = None) -> tuple[Choice, ...]:
    """All rows, the plain model first.

    Args:
        seed: of weights, data order and noise.
        batch_size: instead of the preset's.
    """
    base = replace(get_preset(BASE_PRESET), seed=seed)
    base = base if batch_size is None else replace(base, batch_size=batch_size)

    def run(name: str, question: str, label: str, **changes: Any) -> Choice:
        return Choice(name, question, label, replace(base, **changes))

    def loss(name: str, question: str, label: str, **changes: Any) -> Choice:
        return run(name, question, label, loss=replace(base.loss, **changes))

    def model(name: str, question: str, label: str, **changes: Any) -> Choice:
        return run(name, question, label, model=replace(base.model, **changes))

    halves = get_preset("tiny_without_unified").model
    return (
        Choice(PLAIN, "", "Plain model", base),
        run("seed", "chance", "another seed", seed=seed + 1),
        run("algorithm1", "timesteps", "Algorithm 1 of the supplement", timestep_rule="algorithm1"),
        run("only-pure-noise", "timesteps", "always pure noise (p_t = 0)", p_t=0.0),
        run("half-noise", "timesteps", "any noise as often as pure noise (p_t = 0.5)", p_t=0.5),
        loss("no-cycle", "cycle", "no cycle", cycle=0.0),
        loss("into-renderer", "cycle", "its gradient reaches the renderer", cycle_into_renderer=True),
        loss("cycle-of-sample", "cycle", "of a sample of two steps", cycle_steps=2),
        loss("composite-loss", "physics", "composite of the maps against the picture", composite=1.0),
        model("composite-prior", "physics", "prior: composite", physics_prior="composite"),
        model("split-sum-prior", "physics", "prior: split-sum", physics_prior="split_sum"),
        loss("min-snr", "weights", "min-SNR", timestep_weight="min_snr"),
        loss("v-weights", "weights", "those of v-prediction", timestep_weight="v"),
        model("patch-1", "network", "pixels as they are", patch=1),
        model("patch-4", "network", "4 x 4 pixels a latent", patch=4),
        model(
            "without-unified",
            "network",
            "two networks of half the size, one per direction",
            **{field.name: getattr(halves, field.name) for field in dataclasses.fields(halves)}
            | {"physics_prior": base.model.physics_prior},
        ),
    )


def chosen(rows: Sequence[Choice], names: Sequence[str]) -> tuple[Choice, ...]:
    """The rows with these names, or that answer these questions, in their order; the plain model is always among them.

    Args:
        rows: to choose from.
        names: none: all rows.

    Raises:
        UsageError: there is no such row or question.
    """
    known = [row.name for row in rows]
    unknown = [name for name in names if name not in known and name not in QUESTIONS]
    if unknown:
        raise UsageError(
            f"--choices {unknown[0]}: no such row, expected some of: {', '.join(known)}; or questions: "
            f"{', '.join(QUESTIONS)}"
        )
    return tuple(row for row in rows if not names or row.name in (PLAIN, *names) or row.question in names)
