"""The light figure: balls under the light that a method finds in one picture, beside those under the true one."""

from collections.abc import Sequence

import numpy as np

from unirender.errors import UnirenderError
from unirender_evaluation.figures.grid import Grid, Line, Shown, Tile
from unirender_evaluation.figures.panels import Subject, able, input_tile
from unirender_evaluation.light_balls import GLOSSY, ball_mask, ball_values
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.report.pictures import BALL_PICTURES, BALLS, ball_pictures
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tasks import picture

SIZE = 96  # pixels of a ball
AROUND = 0.15  # display value behind the balls, on which bright and dark ones stand out


def light_figure(subjects: Sequence[Subject], suite: Suite, scenes: Sequence[Scene]) -> Grid:
    """What every subject's light makes of three balls, a row each, the truth below; with the aligned errors."""
    taking_part, lines = able(subjects, "decompose", "light"), []
    for scene in scenes:
        seen, true = picture(suite, scene, suite.spec.base), suite.environment(scene)
        for number, subject in enumerate(taking_part):
            found = getattr(subject.ask("decompose", **seen), "environment", None)
            if found is None:
                raise UnirenderError(f"light: {subject.label} finds none; leave it out, or the figure with --kinds")
            errors = ball_values(found, true)
            shown = [Tile(_on_dark(ball), _error(errors, name)) for name, ball in ball_pictures(found, SIZE).items()]
            lines.append(Line(subject.label, (input_tile(seen, number), *shown), starts=number == 0))
        truth = [Tile(_on_dark(ball)) for ball in ball_pictures(true, SIZE).values()]
        lines.append(Line("true light", (None, *truth)))
    caption = (
        "Under the light found in the picture at the left, as bright as it was found: a white ball, one with F = 1 and "
        f"roughness {GLOSSY:g}, and a mirror. Errors with one factor for each ball."
    )
    return Grid(("input", *BALL_PICTURES), tuple(lines), caption)


def _on_dark(ball: Shown) -> Shown:
    mask = ball_mask(SIZE)
    return (ball * mask + AROUND * (1 - mask)).astype(np.float32)


def _error(errors: dict[str, float], name: str) -> str:
    if name not in BALLS:
        return ""
    return f"{errors[metric_key(BALLS[name], 'rmse_relative', Variant(scale='aligned'))]:.2f}"
