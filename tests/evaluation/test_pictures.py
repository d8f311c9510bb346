"""The gallery's pictures: every prediction is kept, and the worst, the median and the best sample are shown."""

from pathlib import Path

import numpy as np
import pytest

from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender_evaluation.engine import Prediction
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.report.pictures import Pictures, chosen_places, question, ranking
from unirender_evaluation.report.samples import make_sheets
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import tasks


def first_task(suite: Suite, table: str, protocol: str) -> Task:
    return next(tasks(suite, table, protocol, [suite.scenes[0]]))


def edit_records(suite: Suite, method: str, levels: range) -> list[Record]:
    """One record per material edit of the suite, PSNR `levels`."""
    asked = list(tasks(suite, "rendering", "from-image", list(suite.scenes)))
    return [
        Record("rendering", "from-image", method, t.sample, t.scene.object, {metric_key(t.quantity, "psnr"): level})
        for t, level in zip(asked, levels, strict=True)
    ]


@pytest.mark.parametrize(
    ("count", "places"),
    [
        (0, {}),
        (1, {0: "worst"}),
        (2, {0: "worst", 1: "best"}),
        (5, {0: "worst", 2: "median", 4: "best"}),
        (144, {0: "worst", 72: "median", 143: "best"}),
    ],
)
def test_worst_median_and_best_are_chosen_in_this_order(count: int, places: dict[int, str]) -> None:
    assert list(chosen_places(count).items()) == list(places.items())


def test_the_ranking_is_the_main_rows_and_begins_with_its_lowest_psnr(suite: Suite) -> None:
    records = edit_records(suite, "other", range(12)) + edit_records(suite, "mine", range(12, 0, -1))
    samples = [record.sample for record in records[:12]]
    leader, ranked = ranking(records, "rendering", "mine")
    assert (leader, ranked[0], ranked[-1]) == ("mine", (samples[-1], 1), (samples[0], 12))
    leader, ranked = ranking(records, "rendering", "absent")
    assert (leader, ranked[0]) == ("other", (samples[0], 0))
    assert ranking([], "rendering", "mine") == ("mine", [])


@pytest.mark.parametrize(("table", "protocol"), PROTOCOLS)
def test_the_question_names_edit_material_or_light(suite: Suite, table: str, protocol: str) -> None:
    scene = suite.scenes[0]
    found = [question(task, suite) for task in tasks(suite, table, protocol, [scene])]
    true = [f"metallic {m:.1f}, roughness {r:.1f}" for m, r in scene.materials]
    expected = {
        ("rendering", "from-image"): ["metallic 0.5 → 1.0", "roughness 0.5 → 0.1", "roughness 0.5 → 0.9"],
        ("inverse", "single-image"): [f"decompose: true {text}" for text in true],
        "rendering": [f"render: metallic {m:.1f}, roughness {r:.1f}" for m, r in suite.spec.edits],
        "relighting": [f"relit by {suite.other_light(scene).light}"],
        "light": [f"the light, {scene.light}"],
    }
    assert found == expected.get((table, protocol), expected.get(table))


def test_a_kept_prediction_is_known_by_its_key_alone(suite: Suite, tmp_path: Path) -> None:
    pictures = Pictures(tmp_path, suite, list(suite.scenes))
    task = first_task(suite, "rendering", "from-image")
    assert not pictures.has(task, "mine", "key")
    pictures.keep(task, "mine", "key", Prediction(image=task.truth_image))
    assert pictures.has(task, "mine", "key")
    assert not pictures.has(task, "mine", "another key")
    assert not pictures.has(task, "another row", "key")
    nothing = first_task(suite, "relighting", "from-image-hdri")
    pictures.keep(nothing, "mine", "key", Prediction())  # a row without an answer that could be shown
    assert pictures.has(nothing, "mine", "key")
    assert {path.suffix for path in tmp_path.iterdir()} == {".png"}


def test_the_gallery_shows_the_kept_predictions_of_the_chosen_samples(suite: Suite, tmp_path: Path) -> None:
    pictures = Pictures(tmp_path, suite, list(suite.scenes))
    asked = list(tasks(suite, "rendering", "from-image", list(suite.scenes)))
    records = edit_records(suite, "bound", range(100, 112)) + edit_records(suite, "mine", range(20, 32))
    for task in asked:
        assert task.truth_image is not None
        pictures.keep(task, "mine", "key", Prediction(image=0.5 * task.truth_image))
    items = pictures.items(records, "absent")  # "bound" has no pictures: it chooses nothing
    assert [(item.rank, item.place, item.figure) for item in items] == [
        ("worst", 1, "PSNR 20.0 dB"),
        ("median", 7, "PSNR 26.0 dB"),
        ("best", 12, "PSNR 31.0 dB"),
    ]
    worst = items[0]
    assert (worst.sample, worst.leader, worst.count) == (asked[0].sample, "mine", 12)
    assert worst.question == "metallic 0.5 → 1.0"
    assert list(worst.predictions) == ["mine"]
    assert worst.scores["mine"] == {"image": "20.0 dB"}
    assert list(worst.given) == ["input"]
    inside = worst.mask[..., 0] == 1
    ratio = worst.predictions["mine"]["image"][inside].mean() / worst.truth["image"][inside].mean()
    assert 0.65 < ratio < 0.8  # half the light: 0.5^(1/2.4) = 0.75 of the display value
    half = np.abs(worst.predictions["mine"]["image"] * 255 - np.round(worst.predictions["mine"]["image"] * 255))
    assert half.max() < 1e-3  # stored with 8 bits


def test_maps_and_lights_come_with_what_was_given(suite: Suite, tmp_path: Path) -> None:
    pictures = Pictures(tmp_path, suite, list(suite.scenes))
    shown = {}
    for table, protocol in (("inverse", "single-image"), ("rendering", "given-light"), ("relighting", "from-image-sd")):
        task = first_task(suite, table, protocol)
        pictures.keep(task, "mine", "key", Prediction(task.truth_image, task.truth_maps))
        quantity = {"inverse": "albedo", "relighting": "relit"}.get(table, task.quantity)
        values = {metric_key(quantity, "psnr"): 30.0}
        (item,) = pictures.items([Record(table, protocol, "mine", task.sample, "o", values)], "mine")
        shown[protocol] = (list(item.given), list(item.predictions["mine"]))
        for name, picture in item.predictions["mine"].items():
            np.testing.assert_allclose(picture, np.clip(item.truth[name], 0, 1), rtol=0, atol=0.5 / 255 + 1e-6)
    materials = ["albedo", "normal", "roughness", "metallic"]
    assert shown == {
        "single-image": (["input"], materials),
        "given-light": ([*materials, "HDRI"], ["image"]),
        "from-image-sd": (["input", "target specular", "target diffuse"], ["image", "specular", "diffuse"]),
    }


def test_lights_are_shown_as_balls_and_ranked_by_their_error(suite: Suite, tmp_path: Path) -> None:
    pictures = Pictures(tmp_path, suite, list(suite.scenes))
    asked = list(tasks(suite, "light", "light-from-image", list(suite.scenes)))
    key = metric_key("ball_matte", "rmse_relative")
    records = []
    for i, task in enumerate(asked):
        assert task.truth_maps is not None
        pictures.keep(task, "mine", "key", Prediction(maps=task.truth_maps))
        values = {key: 0.1 + 0.2 * i}
        records.append(Record("light", "light-from-image", "mine", task.sample, task.scene.object, values))
    items = pictures.items(records, "mine")
    assert (items[0].rank, items[0].sample) == ("worst", asked[-1].sample)  # the largest error
    assert items[0].figure == f"matte ball error {0.1 + 0.2 * (len(asked) - 1):.2f}"
    worst = items[0]
    assert list(worst.truth) == ["matte ball", "glossy ball", "mirror ball"]
    for name, picture in worst.truth.items():
        np.testing.assert_allclose(worst.predictions["mine"][name], picture, rtol=0, atol=0.5 / 255 + 1e-6)
    assert worst.scores["mine"]["matte ball"].startswith("error ")
    assert worst.given_mask is not None
    assert np.array_equal(worst.given_mask, asked[-1].mask)
    assert worst.mask.sum() == pytest.approx(np.pi / 4 * worst.mask.size, rel=0.05)  # a disc
    sheet = make_sheets([worst])["light", "light-from-image", worst.sample]
    assert sheet.names == ("input", *worst.truth)
    assert sheet.width == 4 * sheet.height // 2


def test_the_mirror_ball_shows_the_right_light_on_the_right(suite: Suite, tmp_path: Path) -> None:
    """+x of the contract is the viewer's right, +y up; what stands behind the ball is at its rim."""
    pictures = Pictures(tmp_path, suite, list(suite.scenes))
    task = next(tasks(suite, "light", "light-from-image", list(suite.scenes)))
    directions = environment_directions(16, 32)
    for axis, sign, rows, columns in ((0, 1, ..., slice(20, None)), (1, 1, slice(None, 12), ...)):
        light = (0.5 * (sign * directions[..., axis] > 0.8)[..., None]).repeat(3, axis=-1).astype(np.float32)
        pictures.keep(task, "mine", "key", Prediction(maps=Intrinsics(environment=light)))
        record = Record(
            "light", "light-from-image", "mine", task.sample, "o", {metric_key("ball_matte", "rmse_relative"): 1.0}
        )
        shown = pictures.items([record], "mine")[0].predictions["mine"]["mirror ball"].sum(axis=-1)
        part = np.zeros_like(shown)
        part[rows, columns] = shown[rows, columns]
        assert part.sum() > 0.9 * shown.sum() > 0
