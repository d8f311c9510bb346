"""Validation of a run: the averaged weights, as users would load them, are scored by a function that is passed in.

What the scores are is not known here: the composition root hands in the benchmark's own. Every validation is logged;
with `keep_best` the pipeline that scored best stands in the run's folder `best/`, with its scores in
`validation.json`.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unirender.errors import UnirenderError
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.score import Score
from unirender.training.logs.run_log import LOG_FILE, read_lines
from unirender.training.loop.checkpoint import differences
from unirender.training.loop.export import SCORES_FILE, TRAINING_FILE, averaged_pipeline, export_pipeline

if TYPE_CHECKING:
    from unirender.training.loop.trainer import Trainer

Validate = Callable[[UniRenderPipeline], Mapping[str, Score]]

BEST_FOLDER = "best"


@dataclass(frozen=True)
class Validation:
    """How a run is validated.

    Attributes:
        validate: pipeline -> scores by name.
        keep_best: name of the score by which `best/` is chosen; None: no such folder.
    """

    validate: Validate
    keep_best: str | None = None

    def begin(self, trainer: "Trainer") -> None:
        """Looks at the `best/` of a run that begins or goes on: it may be its own.

        Raises:
            UnirenderError: it is that of a run of another configuration, or was scored on other scenes.
        """
        path = trainer.run.out / BEST_FOLDER / TRAINING_FILE
        if self.keep_best is None or not path.is_file():
            return
        try:
            facts = json.loads(path.read_text())
            differing = differences(facts["train"], trainer.config)
            scored_on = facts.get("scored_on")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UnirenderError(
                f"{path}: cannot be read as the record of a training ({error}); move it away"
            ) from error
        if differing:
            raise UnirenderError(
                f"{path.parent}: is the best of another run, with {', '.join(differing)}, whose scores these weights "
                "would have to beat; move it away, or pass another --out"
            )
        if None not in (scored_on, trainer.run.scored_on) and scored_on != trainer.run.scored_on:
            raise UnirenderError(
                f"{path.parent}: is the best on {scored_on}, expected {trainer.run.scored_on}: scores on other scenes "
                "cannot be compared; repeat --validate and --validate-suite of that run, leave --keep-best out, or "
                "move the folder away"
            )

    def is_done(self, trainer: "Trainer") -> bool:
        """Whether the log has the scores of the weights as they are now, on the same scenes, and `best/` knows them."""
        lines = read_lines(trainer.run.out / LOG_FILE)
        line = next((line for line in reversed(lines) if "validation" in line), {})
        here = line.get("step") == trainer.step and line.get("scored_on") == trainer.run.scored_on
        best = trainer.run.out / BEST_FOLDER
        return here and (self.keep_best is None or best_score(best, self.keep_best) is not None)

    def run(self, trainer: "Trainer") -> dict[str, Any]:
        """Scores the averaged weights, and keeps them if they are the best so far; returns a line for the log.

        Raises:
            UnirenderError: there is no score of the name `keep_best`.
        """
        start = time.monotonic()
        scores = self.validate(averaged_pipeline(trainer))
        values = {name: score.value for name, score in scores.items()}
        line = {"step": trainer.step, "validation": values, "validation_s": round(time.monotonic() - start, 2)}
        line |= {} if trainer.run.scored_on is None else {"scored_on": trainer.run.scored_on}
        if self.keep_best is None:
            return line
        if self.keep_best not in scores:
            raise UnirenderError(
                f"the best of {self.keep_best!r}: there is no such score, expected one of: {', '.join(scores)}"
            )
        folder = trainer.run.out / BEST_FOLDER
        plain = {name: dataclasses.asdict(score) for name, score in scores.items()}
        record = {"step": trainer.step, "chosen_by": self.keep_best, "scores": plain}
        text = json.dumps(record, indent=2) + "\n"
        before = best_score(folder, self.keep_best)
        if before is None or scores[self.keep_best].better_than(before):
            export_pipeline(trainer, folder, beside={SCORES_FILE: text})
        return line | {"best": (folder / SCORES_FILE).read_text() == text}  # also if it was kept before a kill


def best_score(folder: Path, name: str) -> Score | None:
    """The named score of the pipeline in `best/`; None where there is none."""
    path = folder / SCORES_FILE
    if not path.is_file():
        return None
    stored = json.loads(path.read_text())["scores"].get(name)
    return None if stored is None else Score(**stored)
