"""What a result says of its run: seconds and kept states of the stages, the names of the pictures."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from optimizer_runs import rendered_views, truth
from posed_views import painted_views

from unirender_reference.optimize.exposure import lit
from unirender_reference.optimize.files.state import open_run
from unirender_reference.optimize.multiview.result import stage_records, write_result
from unirender_reference.optimize.refine.watch import GAIN_DB
from unirender_reference.optimize.show.strips import LEAST_SIDE, MOST_LETTERS, short_names, views_strip
from unirender_reference.optimize.views import Views


def line(stage: str, iteration: int, seconds: float, held_out: float | None = None) -> dict:
    values = {"loss": 0.1} if held_out is None else {"loss": 0.1, "held_out_psnr": held_out}
    return {"stage": stage, "iteration": iteration, "seconds": seconds, "values": values}


HISTORY = [line("transport", 1, 4.5), line("transport", 2, 9.25), line("reshape-1", 1, 12.0), line("refine", 0, 13.0)]


def test_seconds_of_a_stage_are_its_own():
    rows = stage_records(HISTORY, 3)
    assert [(row["stage"], row["steps"], row["seconds"]) for row in rows] == [
        ("transport", 2, 9.25),
        ("reshape-1", 1, 2.75),
        ("refine", 0, 1.0),
    ]
    assert sum(row["seconds"] for row in rows) == HISTORY[-1]["seconds"]


@pytest.mark.parametrize(
    ("looks", "patience", "kept"),
    [
        ((30.0, 29.0, 29.5), 3, 0),
        ((30.0, 30.0 + GAIN_DB / 2, 29.5), 3, 0),  # less than a gain
        ((30.0, 31.0, 29.5), 3, 10),
        ((30.0, 31.0, 29.5), 0, 20),  # the last state
        ((None, None, None), 3, 20),  # nobody looked
    ],
)
def test_the_state_that_was_kept(looks: tuple, patience: int, kept: int):
    history = [*HISTORY[:3], *(line("refine", 10 * k, 20.0 + k, look) for k, look in enumerate(looks))]
    rows = stage_records(history, patience)
    assert [row.get("kept_step") for row in rows] == [None, None, kept]


def test_figures_do_not_see_the_unit_of_linear_pictures(tmp_path: Path):
    """Pictures and light a hundred times as bright have the same figures; the light alone has not."""
    views, solution = rendered_views(truth(), seen=1, held_out=1, side=16, hdr=True), lit(truth(), 1.3)
    bright = dataclasses.replace(
        views,
        seen=tuple(dataclasses.replace(view, image=100 * view.image) for view in views.seen),
        held_out=tuple(dataclasses.replace(view, image=100 * view.image) for view in views.held_out),
    )
    records = []
    for name, given, light in (("one", views, 1), ("hundred", bright, 100), ("twin", views, 100)):
        with open_run(tmp_path / name, {"config": {}, "inputs": {}, "versions": {}}) as folder:
            write_result(lit(solution, light), given, folder, {"config": {"patience": 3}}, pictures=False)
        records.append(json.loads((tmp_path / name / "solution.json").read_text())["figures"])
    assert records[0] == pytest.approx(records[1], abs=0.05)
    assert records[0]["seen_psnr_db"] > records[2]["seen_psnr_db"] + 10


def test_pictures_go_by_their_names():
    assert short_names(["./images/0001", "images/0002.png"]) == ["0001", "0002"]
    assert short_names(["train/r_0.png", "test/r_0.png"]) == ["train/r_0.png", "test/r_0.png"]
    (shown,) = short_names(["a/photograph-of-the-chair-0017.png"])
    assert shown == "…of-the-chair-0017"
    assert len(shown) == MOST_LETTERS


@pytest.mark.parametrize("side", [LEAST_SIDE // 2 + 1, LEAST_SIDE - 1, LEAST_SIDE])
def test_pictures_of_a_strip_are_never_smaller_than_can_be_seen(side: int):
    image, mask = np.zeros((side, side, 3), np.float32), np.ones((side, side, 1), np.float32)
    one = dataclasses.replace(painted_views().seen[0], image=image, mask=mask)
    sheet = views_strip(Views((one,)), np.zeros((1, side, side, 4), np.float32))
    assert min(sheet.height // 2, sheet.width) > LEAST_SIDE


def test_names_stand_above_the_pictures():
    """Other names, another sheet; the pictures below them are the same."""
    views, found = painted_views(), np.zeros((4, 12, 16, 4), np.float32)
    seen = tuple(dataclasses.replace(view, name=f"other/{k}.png") for k, view in enumerate(views.seen))
    sheet, other = views_strip(views, found), views_strip(dataclasses.replace(views, seen=seen), found)
    assert sheet.size == other.size
    assert not np.array_equal(np.asarray(sheet), np.asarray(other))
    bottom = (0, sheet.height // 2, *sheet.size)
    assert np.array_equal(np.asarray(sheet.crop(bottom)), np.asarray(other.crop(bottom)))
