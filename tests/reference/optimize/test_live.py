"""What is shown of a run, in a terminal and elsewhere; the curve of its history."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from unirender_reference.optimize.live import clock, live_report
from unirender_reference.optimize.plots import loss_curve
from unirender_reference.optimize.report import Report
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


def test_the_curve_goes_down_where_the_loss_does(tmp_path: Path):
    """The upper panel's line ends below its beginning; a flat history draws another picture."""
    pictures = []
    for factor in (0.8, 1.0):
        history = [{"stage": "refine", "values": {"loss": factor**k, "psnr": 20 + k}} for k in range(30)]
        loss_curve([{"stage": "transport", "values": {"cost": 3.0}}, *history], tmp_path / "loss.png")
        image = np.asarray(Image.open(tmp_path / "loss.png").convert("RGB")).astype(int)
        upper = image[: image.shape[0] // 2]
        blue = (upper[..., 2] - upper[..., 0] > 60) & (upper[..., 2] > upper[..., 1])  # matplotlib's first colour
        rows = [np.nonzero(blue[:, column])[0].mean() for column in np.nonzero(blue.any(axis=0))[0]]
        pictures.append(rows[-1] - rows[0])
    assert pictures[0] > 80
    assert abs(pictures[1]) < 3
    loss_curve([], tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 0
