"""`bench race`: whose albedo is there first, on curves with known answers and in a race of a second."""

import json
import math
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from multiview_pieces import ball_scene, true_solution
from PIL import Image
from rich.console import Console
from study_pieces import FEW, SMALL, one_thread, small_study

from unirender.errors import UnirenderError
from unirender_evaluation.multiview.scoring import score_solution
from unirender_evaluation.studies.optimiser.curves import Curve, Point, finish, geometric_mean
from unirender_evaluation.studies.optimiser.race import (
    CURVES,
    ObjectRace,
    RaceSettings,
    StopWatch,
    albedo_psnr,
    plain_config,
    race_all,
    read_curves,
    run_ours,
)
from unirender_evaluation.studies.optimiser.race_report import draw, race_table, ratio_text, to_json
from unirender_reference.optimize.multiview.run import optimize
from unirender_reference.optimize.refine.run import refine
from unirender_reference.optimize.transport.solve import start_solution

SETTINGS = RaceSettings(SMALL, iterations=4, plain_every=2, our_every=2)


def curve(name: str, *points: tuple[float, float]) -> Curve:
    return Curve(name, tuple(Point(k, *point) for k, point in enumerate(points)))


OURS = curve("ours", (10.0, 18.0), (20.0, 26.0))
SLOW = curve("plain, srgb", (10.0, 15.0), (40.0, 19.0), (60.0, 18.5))


def test_seconds_to_the_best_of_the_plain_loop() -> None:
    end = finish(OURS, [SLOW])
    assert (end.target, end.plain_seconds, end.our_seconds, end.ratio) == (19.0, 40.0, 20.0, 0.5)
    assert (end.our_end, end.plain_then) == (Point(1, 20.0, 26.0), 15.0)


def test_the_faster_of_the_plain_loops_to_the_best_albedo_of_them_all_counts() -> None:
    quick = curve("plain, linear", (5.0, 17.0), (25.0, 19.0), (30.0, 14.0))
    assert (finish(OURS, [SLOW, quick]).plain, finish(OURS, [SLOW, quick]).ratio) == ("plain, linear", 20.0 / 25.0)
    worse = curve("plain, linear", (5.0, 18.9))  # there sooner, but not as good
    assert (finish(OURS, [SLOW, worse]).plain, finish(OURS, [SLOW, worse]).ratio) == ("plain, srgb", 0.5)
    assert finish(OURS, [SLOW, worse]).plain_then == 18.9


def test_ours_may_never_be_there() -> None:
    end = finish(curve("ours", (10.0, 18.0), (20.0, 18.9)), [SLOW])
    assert end.our_seconds is None
    assert end.ratio == math.inf
    assert geometric_mean([0.5, end.ratio]) == math.inf
    assert "none, since ours reaches the plain loop's best albedo on 1 of 2 objects" in ratio_text(
        [finish(OURS, [SLOW]), end]
    )


def test_what_was_measured_later_is_not_there_yet() -> None:
    assert OURS.at(19.9) == 18.0
    assert OURS.at(9.9) is None
    assert finish(OURS, [curve("plain, srgb", (30.0, 20.0))]).plain_then is None


def test_a_value_as_good_is_there_and_the_first_of_equals_is_best() -> None:
    assert OURS.reaches(26.0) == 20.0
    assert OURS.reaches(26.001) is None
    assert curve("flat", (1.0, 5.0), (2.0, 5.0)).best.seconds == 1.0
    with pytest.raises(UnirenderError, match="ours has no point"):
        Curve("ours", ())


def test_the_mean_of_ratios_is_geometric() -> None:
    assert geometric_mean([0.25, 4.0]) == pytest.approx(1.0)
    assert geometric_mean([0.5]) == pytest.approx(0.5)


def test_the_watch_stands_while_something_is_measured() -> None:
    watch = StopWatch()
    with watch.stands():
        time.sleep(0.2)
    assert watch.seconds < 0.1
    time.sleep(0.05)
    assert watch.seconds >= 0.05


def test_the_albedo_is_that_of_the_multi_view_table() -> None:
    scene = ball_scene(16, FEW)
    truth = true_solution(scene)
    wrong = replace(truth, obj=replace(truth.obj, albedo=truth.obj.albedo ** np.float32(1.2)))
    assert albedo_psnr(scene, wrong) == score_solution(scene, wrong)["albedo.psnr@masked-srgb-aligned"]
    assert albedo_psnr(scene, truth) > albedo_psnr(scene, wrong) + 3


@pytest.mark.long
def test_watching_changes_nothing() -> None:
    """What is watched finds what the method finds by itself."""
    scene = ball_scene(16, FEW)
    with one_thread():
        found, solution = run_ours(scene, SETTINGS)
        alone = optimize(scene.views, scene.mesh, SMALL)
    assert np.array_equal(solution.obj.albedo, alone.obj.albedo)
    assert np.array_equal(solution.environment, alone.environment)
    assert [point.iteration for point in found.points] == [0, 2, 4]
    assert found.points[-1].psnr == albedo_psnr(scene, alone)
    seconds = [point.seconds for point in found.points]
    assert 0 < seconds[0] < seconds[1] < seconds[2]


@pytest.fixture(scope="module")
def raced(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[ObjectRace]]:
    folder = tmp_path_factory.mktemp("race")
    with one_thread():
        return folder, race_all(small_study(folder, "studies/optimiser/race"), SETTINGS, folder, Console(quiet=True))


@pytest.mark.long
def test_the_plain_loops_are_those_of_the_tutorials(raced: tuple[Path, list[ObjectRace]]) -> None:
    folder, (race,) = raced
    study = small_study(folder, "studies/optimiser/race")
    assert race.object == study.scenes[0].object
    assert [loop.name for loop in race.loops] == ["plain, srgb", "plain, linear"]
    scene = study.scene(study.scenes[0])
    with one_thread():
        start = start_solution(scene.views, scene.mesh, 128, 16)
        found = refine(scene.views, start, plain_config(SETTINGS, "linear"))
        assert [point.iteration for point in race.loops[1].points] == [2, 4]
        assert race.start == albedo_psnr(scene, start)
        assert race.loops[1].points[-1].psnr == albedo_psnr(scene, found)


@pytest.mark.long
def test_no_object_races_twice(raced: tuple[Path, list[ObjectRace]]) -> None:
    """Seconds are a wall clock's: equal ones were read, not measured."""
    folder, before = raced
    path = folder / CURVES
    path.write_text(path.read_text() + '{"key": "0')  # a killed run's half line
    study = small_study(folder, "studies/optimiser/race")
    assert race_all(study, SETTINGS, folder, Console(quiet=True)) == before
    assert len(path.read_text().splitlines()) == 1
    keys = [
        study.key(study.scenes[0], "race", asdict(settings)) for settings in (SETTINGS, replace(SETTINGS, iterations=5))
    ]
    assert keys[0] == before[0].key
    assert keys[1] != before[0].key


def test_a_line_that_is_no_race_is_named(tmp_path: Path) -> None:
    (tmp_path / CURVES).write_text('{"key": "0"}\n')
    with pytest.raises(UnirenderError, match="no race"):
        read_curves(tmp_path / CURVES)


def test_the_report_says_what_was_measured(tmp_path: Path) -> None:
    never = curve("ours", (10.0, 16.0))
    races = [ObjectRace("0", "first", 14.0, OURS, (SLOW,)), ObjectRace("1", "second", 14.0, never, (SLOW,))]
    table = race_table(races, (("seed", "0"),))
    first = "| first | 19.00 | srgb | 40.0 | 20.0 | 0.50 | 26.00 | 20.0 | 15.00 |"
    second = "| second | 19.00 | srgb | 40.0 | never | - | 16.00 | 10.0 | 15.00 |"
    text = table.markdown()
    assert first in text
    assert second in text
    assert "Geometric mean of the ratios: none" in text
    assert "Geometric mean of the ratios: 0.50 (n = 1)" in race_table(races[:1], ()).markdown()
    content = json.loads(to_json(races, (("seed", "0"),)), parse_constant=pytest.fail)
    assert content["geometric_mean_ratio"] is None
    assert [one["ratio"] for one in content["objects"]] == [0.5, None]
    assert content["objects"][0]["curves"][1]["points"][1] == {"iteration": 1, "seconds": 40.0, "psnr": 19.0}
    (tmp_path / "race.png").write_bytes(draw(races))
    picture = np.asarray(Image.open(tmp_path / "race.png").convert("RGB"))
    assert (picture == (0xD5, 0x5E, 0x00)).all(axis=-1).any()  # our curve's colour
    (tmp_path / "one.png").write_bytes(draw(races[:1]))
    assert Image.open(tmp_path / "one.png").width < picture.shape[1]
