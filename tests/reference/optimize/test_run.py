"""Runs: killed and resumed to the same bytes, stopped by held-out views, refused where they do not fit."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import optimizer_runs
import pytest
from optimizer_runs import CONFIG, REFINE, flat_start, rendered_views, run, truth

from unirender.errors import UnirenderError, UsageError
from unirender_reference.optimize.files.solution import read_solution_file, write_solution_file
from unirender_reference.optimize.files.state import HISTORY, PROGRESS, open_run
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.multiview.run import _plan, _Run, optimize
from unirender_reference.optimize.refine.watch import Watch
from unirender_reference.optimize.shape.placement import placed
from unirender_reference.optimize.show.report import Report
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.transport.config import TransportConfig
from unirender_reference.optimize.views import Step
from unirender_reference.shapes import Sphere

FILES = ("mesh.glb", "environment.exr", "mitsuba/roughness.png", "mitsuba/mesh.ply")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing interrupted."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    run(out)
    return out


def lines(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / HISTORY).read_text().splitlines()]


def values(out: Path) -> list[tuple]:
    return [(line["stage"], line["iteration"], line["values"]) for line in lines(out)]


def killed(out: Path, at: int) -> None:
    """Begins the run in a process of its own, and kills it once its history has `at` lines."""
    helper = Path(optimizer_runs.__file__)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(helper.parent), *sys.path])}
    process = subprocess.Popen([sys.executable, str(helper), str(out)], env=environment)
    history, deadline = out / HISTORY, time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if history.exists() and history.read_text().count("\n") >= at:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


@pytest.mark.long
def test_a_killed_run_goes_on_to_the_same_bytes(whole: Path, tmp_path: Path):
    out = tmp_path / "run"
    killed(out, 3)
    assert not (out / "solution.json").exists()
    assert not (out / "mesh.glb").exists()
    assert json.loads((out / "state" / PROGRESS).read_text())["lines"] >= 2
    run(out)
    for name in FILES:
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    assert values(out) == values(whole)
    records = [json.loads((folder / "solution.json").read_text()) for folder in (out, whole)]
    for record in records:
        del record["stages"], record["seconds"]
    assert records[0] == records[1]
    assert [line["seconds"] for line in lines(out)] == sorted(line["seconds"] for line in lines(out))


@pytest.mark.long
@pytest.mark.slow
def test_a_run_that_loses_what_it_saved_ends_elsewhere(whole: Path, tmp_path: Path):
    """The twin: the saved state is what the run goes on from."""
    out = tmp_path / "run"

    def stop(report: Report) -> None:
        if report.step.iteration == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(out, progress=stop)
    (path,) = [path for path in (out / "state").glob("refine-*.npz") if "best" not in path.name]
    with np.load(path) as file:
        arrays = dict(file)
    arrays["parameter.environment"] = arrays["parameter.environment"] + np.float32(0.1)
    np.savez(path, **arrays)
    run(out)
    assert (out / "environment.exr").read_bytes() != (whole / "environment.exr").read_bytes()


def test_the_same_command_again_changes_nothing(whole: Path):
    before = {path: path.stat().st_mtime_ns for path in whole.rglob("*") if path.is_file()}
    found = run(whole)
    after = {path: path.stat().st_mtime_ns for path in whole.rglob("*") if path.is_file()}
    stored = read_solution_file(whole / "state/refine.npz")
    assert isinstance(stored, Solution)
    np.testing.assert_array_equal(found.environment, stored.environment)
    assert {path.name for path in before if before[path] != after.get(path)} <= {".lock"}


def test_a_result_that_was_not_finished_is_written_again(whole: Path, tmp_path: Path):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    (out / "solution.json").unlink()
    (out / "mitsuba/mesh.ply").unlink()
    (out / ".result.part").mkdir()
    (out / ".result.part/mesh.glb").write_bytes(b"half")
    run(out)
    for path in whole.rglob("*.*"):
        if path.is_file() and path.parent.name != "state" and path.name != "solution.json":  # which tells seconds
            assert (out / path.relative_to(whole)).read_bytes() == path.read_bytes(), path.name
    assert not (out / ".result.part").exists()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"config": dataclasses.replace(CONFIG, seed=1)}, "config.seed"),
        (
            {"config": dataclasses.replace(CONFIG, refine=dataclasses.replace(REFINE, spp=8))},
            r"config\.refine\.spp \(4, now 8\);",
        ),
        ({"init": flat_start(truth().obj, 17)}, "inputs.start"),
    ],
)
def test_another_run_is_refused(whole: Path, change: dict, named: str):
    with pytest.raises(UnirenderError, match=f"holds a run with other {named}"):
        run(whole, **change)


def test_a_run_with_an_option_that_is_gone_is_refused(tmp_path: Path):
    """As one that an earlier version began; the option is named, not its whole group."""
    now = {"config": {"refine": {"spp": 4}}, "inputs": {}, "versions": {}}
    with open_run(tmp_path, {**now, "config": {"refine": {"spp": 4, "demodulated": 0.0}}}):
        pass
    named = r"holds a run with other config\.refine\.demodulated \(0\.0, now None\); a run goes"
    with pytest.raises(UnirenderError, match=named), open_run(tmp_path, now):
        pass


def test_a_run_that_stood_elsewhere_is_refused(whole: Path, tmp_path: Path):
    """Pictures and mesh of four times the size are the same in the unit sphere, and not in the mesh file."""
    with pytest.raises(UnirenderError, match=r"holds a run with other inputs\.place"):
        run(whole, place=Sphere(np.zeros(3), 4.0))


def test_a_file_that_was_deleted_comes_back(whole: Path, tmp_path: Path):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    (out / "loss.png").unlink()
    run(out)
    assert (out / "loss.png").read_bytes() == (whole / "loss.png").read_bytes()


@pytest.mark.parametrize(("damaged", "left"), [("mitsuba/mesh.ply", 0), ("solution.json", 40)])
def test_a_file_that_was_damaged_comes_back(whole: Path, tmp_path: Path, damaged: str, left: int):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    (out / damaged).write_bytes((whole / damaged).read_bytes()[:left])
    run(out)
    if damaged == "solution.json":  # tells the seconds of its own writing
        assert (
            json.loads((out / damaged).read_text())["figures"] == json.loads((whole / damaged).read_text())["figures"]
        )
    else:
        assert (out / damaged).read_bytes() == (whole / damaged).read_bytes()
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.*") if path.is_file()}
    run(out)
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*.*") if path.is_file()}


def test_no_steps_at_all_are_a_run():
    """The held-out views are looked at once, at the start, which is returned."""
    reports: list[Report] = []
    config = dataclasses.replace(CONFIG, refine=dataclasses.replace(REFINE, iterations=0))
    start = flat_start(truth().obj)
    found = run(None, config=config, init=start, progress=reports.append)
    assert [report.step.iteration for report in reports] == [0]
    assert reports[0].remaining is None
    np.testing.assert_allclose(found.environment, start.environment, rtol=1e-3)


@pytest.mark.long
def test_pictures_may_be_drawn_later(whole: Path, tmp_path: Path):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    assert not (out / "views.png").exists()
    run(out, pictures=True)
    assert (out / "turntable.png").exists()
    drawn = (out / "views.png").stat().st_mtime_ns
    run(out)
    run(out, pictures=True)
    assert (out / "views.png").stat().st_mtime_ns == drawn


def test_the_record_tells_the_masks_and_the_whole_time(whole: Path):
    record = json.loads((whole / "solution.json").read_text())
    assert 0.95 < record["mask_iou"] <= 1
    assert record["seconds"] > record["stages"][-1]["seconds"]


def test_how_often_states_are_saved_is_no_other_run(whole: Path):
    run(whole, config=dataclasses.replace(CONFIG, save_seconds=99.0))


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path: Path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UnirenderError, match="is not empty and holds no run"):
        run(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_mesh_and_a_start_with_its_own_are_one_too_many(tmp_path: Path):
    start = truth()
    with pytest.raises(UnirenderError, match="got a mesh and a start with a mesh of its own, expected one of them"):
        optimize(rendered_views(start), start.obj, CONFIG, tmp_path / "run", start)
    assert not (tmp_path / "run").exists()


def test_two_processes_on_one_folder(tmp_path: Path):
    header = {"config": {}, "inputs": {}, "versions": {}}
    with open_run(tmp_path / "run", header), pytest.raises(UnirenderError, match="another run is writing"):
        open_run(tmp_path / "run", header).__enter__()


def test_history_is_cut_to_what_was_saved(tmp_path: Path):
    header = {"config": {}, "inputs": {}, "versions": {}}
    with open_run(tmp_path, header) as folder:
        folder.record(Step("refine", 1, 0.5, {"loss": 1 / 3}))
        folder.save(0.5, {})
        folder.record(Step("refine", 2, 0.7, {}))  # never saved
        (folder.state / "refine-2.npz").write_bytes(b"orphan")
        (folder.state / ".refine-2.npz.part").write_bytes(b"orphan")
    with open_run(tmp_path, header) as folder:
        assert [line["iteration"] for line in folder.history()] == [1]
        assert folder.history()[0]["values"] == {"loss": 0.3333333}
        folder.save(0.5, {})
        assert sorted(path.name for path in folder.state.iterdir()) == ["progress.json", "run.json"]


@pytest.mark.parametrize("damage", ["{", "[]", b"\xff"])
def test_a_broken_record_is_one_sentence(whole: Path, tmp_path: Path, damage: str | bytes):
    header = {"config": {}, "inputs": {}, "versions": {}}
    with open_run(tmp_path, header):
        pass
    path = tmp_path / "state/run.json"
    path.write_bytes(damage if isinstance(damage, bytes) else damage.encode())
    with pytest.raises(UnirenderError, match=r"run\.json: .*delete the folder"), open_run(tmp_path, header):
        pass


def test_a_broken_state_is_one_sentence(tmp_path: Path):
    path = tmp_path / "start.npz"
    write_solution_file(path, truth())
    back = read_solution_file(path)
    assert isinstance(back, Solution)
    for name in ("vertices", "faces", "normals", "uv", "albedo", "roughness", "metallic"):
        np.testing.assert_array_equal(getattr(back.obj, name), getattr(truth().obj, name))
    whole = path.read_bytes()
    long_name = whole[:26] + b"\xff\x7f" + whole[28:]  # of the first array, which zipfile quotes
    for damaged in (whole[:500], whole.replace(b"{'descr", b"('descr"), long_name, whole[128 : whole.index(b"PK", 1)]):
        path.write_bytes(damaged)  # the last is an array, and no archive
        with pytest.raises(UnirenderError, match="no readable state") as told:
            read_solution_file(path)
        assert len(str(told.value)) < 300 + len(str(path)), "zipfile quotes what it takes for a name"


def test_the_best_look_counts_and_patience_ends():
    watch = Watch(patience=2)
    assert [watch.look(k, db) for k, db in enumerate((20.0, 21.0, 21.01, 20.5))] == [True, True, False, False]
    assert watch.enough
    assert (watch.best_db, watch.best_iteration) == (21.0, 1)
    endless = Watch(patience=0)
    for k in range(9):
        endless.look(k, 20.0)
    assert not endless.enough


def test_a_run_that_gets_worse_is_stopped_and_its_best_state_kept():
    """A light that moves by a factor of e each step ruins the fit; the best state is not the last."""
    config = dataclasses.replace(CONFIG, patience=2, refine=dataclasses.replace(REFINE, light_rate=1.0, iterations=40))
    steps: list[Step] = []
    found = run(None, config=config, progress=lambda report: steps.append(report.step))
    assert steps[-1].iteration < 40
    looks = {step.iteration: step.values["held_out_psnr"] for step in steps if "held_out_psnr" in step.values}
    best = max(looks, key=lambda iteration: looks[iteration])
    assert steps[-1].iteration > best
    again = dataclasses.replace(
        config, patience=0, refine=dataclasses.replace(config.refine, iterations=steps[-1].iteration)
    )
    last = run(None, config=again)
    assert np.abs(np.log(found.environment) - np.log(last.environment)).max() > 0.1  # not the last state


def test_a_start_that_only_gets_worse_is_returned():
    """From the truth, with a light that moves far: the first look is at the start, and it stays the best."""
    config = dataclasses.replace(CONFIG, patience=2, refine=dataclasses.replace(REFINE, light_rate=1.0))
    looks, true = [], truth()

    def note(report: Report) -> None:
        looks.extend([report.step.values["held_out_psnr"]] if "held_out_psnr" in report.step.values else [])

    found = run(None, config=config, init=true, progress=note)
    assert max(looks[1:]) < looks[0] - 5
    assert len(looks) == 3
    np.testing.assert_allclose(found.environment, true.environment, rtol=1e-3, atol=1e-3)


def test_reports_count_down():
    reports: list[Report] = []
    run(None, progress=reports.append)
    assert [report.step.iteration for report in reports] == list(range(9))  # the first look is at the start
    assert {(report.stage, report.stages, report.total) for report in reports} == {(1, 1, 8)}
    assert reports[-1].remaining == 0
    assert reports[0].remaining is None
    assert all(report.remaining is not None and report.remaining >= 0 for report in reports[1:])


@pytest.mark.parametrize(
    ("given", "transport", "rounds", "stages"),
    [
        ("nothing", True, 0, ["shape", "transport", "carve", "refine"]),
        (
            "nothing",
            True,
            2,
            ["shape", "transport", "carve", "reshape-1", "transport-1", "reshape-2", "transport-2", "refine"],
        ),
        ("nothing", False, 1, ["shape", "transport", "refine", "reshape-1", "refine-1"]),
        ("mesh", True, 1, ["transport", "refine"]),
        ("start", True, 1, ["refine"]),
    ],
)
def test_the_stages_follow_what_is_given(given: str, transport: bool, rounds: int, stages: list[str]):
    config = OptimizeConfig(transport=TransportConfig(enabled=transport), shape_rounds=rounds)
    solution = truth()
    obj, init = (solution.obj if given == "mesh" else None), (solution if given == "start" else None)
    assert _plan(obj, init, config) == stages


def test_refinement_off_returns_the_start():
    config = dataclasses.replace(CONFIG, refine=dataclasses.replace(REFINE, enabled=False))
    start = flat_start(truth().obj)
    assert run(None, config=config, init=start) is start


def test_values_out_of_range():
    for change in ({"texture_size": 2}, {"patience": -1}, {"seed": -1}, {"save_seconds": float("nan")}):
        with pytest.raises(UsageError, match="expected"):
            run(None, config=dataclasses.replace(CONFIG, **change))
    start = flat_start(truth().obj)
    with pytest.raises(UnirenderError, match="expected one of them"):
        optimize(rendered_views(truth()), start.obj, CONFIG, init=start)


def test_a_mesh_in_no_covered_pixel_is_one_sentence():
    away = placed(rendered_views(truth(), side=8), Sphere(np.array([50.0, 0, 0]), 1.0))
    with pytest.raises(UnirenderError, match="the mesh is in no covered pixel"):
        optimize(away, truth().obj, CONFIG)


def test_what_remains_goes_by_the_work_that_is_done(monkeypatch: pytest.MonkeyPatch):
    """A stage says what its steps take; half of the work takes as long as the other half."""
    reports, now = [], [100.0]
    views = rendered_views(truth(), side=8)
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    on_step = _Run(views, CONFIG, None, reports.append, ["transport"])._on_step("transport", 3, shares=[0.5, 0.9, 1])
    now[0] += 18
    for iteration in (1, 2, 3):
        on_step(Step("transport", iteration, 0.0, {}))
    assert [report.total for report in reports] == [3, 3, 3]
    assert [report.remaining for report in reports] == pytest.approx([18, 2, 0])
