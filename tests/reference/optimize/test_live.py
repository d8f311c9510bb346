"""What is shown of a run, in a terminal and elsewhere; the curve of its history."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from unirender_reference.optimize.show.live import clock, live_report
from unirender_reference.optimize.show.plots import loss_curve
from unirender_reference.optimize.show.report import Report, refinement_note, views_note
from unirender_reference.optimize.views import Step

FIRST = Report(Step("transport", 1, 2.4, {"cost": 12.5}), 1, 2, None, None)
SECOND = Report(Step("refine", 30, 70.6, {"loss": 0.012344, "psnr": 31.254}), 2, 2, 120, 95.0)


def test_a_line_for_each_stage_without_a_terminal():
    stream = io.StringIO()
    with live_report(Console(file=stream, width=200)) as show:
        for report in (FIRST, FIRST, SECOND, SECOND):
            show(report)
    assert stream.getvalue().splitlines() == [
        "stage 1 of 2: transport  step 1  2 s  cost 12.5",
        "stage 2 of 2: refine  step 30 of 120  1:11 min, 1:35 min left of this stage  loss 0.01234  psnr 31.25",
    ]


def test_a_terminal_shows_the_last_step_and_clears_it():
    stream = io.StringIO()
    with live_report(Console(file=stream, width=120, force_terminal=True, color_system=None)) as show:
        show(FIRST)
        show(SECOND)
    text = stream.getvalue()
    assert "step 30 of 120" in text
    assert "1:35 min left of this stage" in text
    assert text.endswith("\x1b[2K") or "\x1b[1A\x1b[2K" in text  # lines are erased at the end


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0 s"), (59.4, "59 s"), (59.6, "1:00 min"), (3725, "1:02 h"), (-1, "0 s")]
)
def test_clock(seconds: float, shown: str):
    assert clock(seconds) == shown


def drawn(history: list[dict], path: Path) -> np.ndarray:
    loss_curve(history, path)
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def blue_rows(image: np.ndarray) -> list[float]:
    """The height of a line in matplotlib's first colour, column by column, in pixels from the top."""
    blue = (image[..., 2] - image[..., 0] > 60) & (image[..., 2] > image[..., 1])
    return [float(np.nonzero(blue[:, column])[0].mean()) for column in np.nonzero(blue.any(axis=0))[0]]


def test_the_curve_goes_down_where_the_loss_does(tmp_path: Path):
    """The upper panel's line ends below its beginning; that of a flat history does not."""
    falls = []
    for factor in (0.8, 1.0):
        history = [{"stage": "refine", "values": {"loss": factor**k, "psnr": 20 + k}} for k in range(30)]
        image = drawn(history, tmp_path / "loss.png")
        rows = blue_rows(image[: image.shape[0] // 2])
        falls.append(rows[-1] - rows[0])
    assert falls[0] > 80
    assert abs(falls[1]) < 3


def test_the_transport_stage_has_a_panel_of_its_own(tmp_path: Path):
    """Its cost falls in the upper panel; a history without a cost has one panel less."""
    costs = [{"stage": "transport", "values": {"cost": 0.5**k, "roughness": 0.3}} for k in range(25)]
    losses = [{"stage": "refine", "values": {"loss": 1.0, "psnr": 30.0}} for _ in range(25)]
    both, alone = (drawn(history, tmp_path / "loss.png") for history in (costs + losses, losses))
    assert both.shape[0] > alone.shape[0] + 100
    rows = blue_rows(both[: both.shape[0] // 3])
    assert rows[-1] - rows[0] > 80
    only = drawn(costs, tmp_path / "loss.png")
    assert only.shape[0] < alone.shape[0]
    assert blue_rows(only)[-1] - blue_rows(only)[0] > 80


def test_a_run_without_a_step_has_a_curve_without_lines(tmp_path: Path):
    assert not blue_rows(drawn([], tmp_path / "empty.png"))


def test_a_refinement_that_gained_nothing_is_named():
    rows = [{"stage": "transport", "steps": 9}, {"stage": "refine", "steps": 30, "kept_step": 0}]
    assert refinement_note(rows) == "refine: no gain on the held-out views, the start was kept"
    assert refinement_note([rows[0], {**rows[1], "kept_step": 20}]) is None


def test_held_out_views_that_are_explained_much_worse_are_told():
    note = views_note({"seen_psnr_db": 40.5, "held_out_psnr_db": 19.5})
    assert note is not None
    assert note.startswith("held-out views are 21.0 dB worse: what was found suits the pictures that it was fitted to")
    assert views_note({"seen_psnr_db": 36.0, "held_out_psnr_db": 31.0}) is None
    assert views_note({"seen_psnr_db": 36.0}) is None
