"""`bench physics`: the path tracer among the tests, the table, and what it says of a blind test."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_models import make_pipeline
from tiny_suites import make_suite

from unirender.errors import UnirenderError
from unirender.light.symmetries import turn_rotation
from unirender_evaluation.methods.composite import Composite
from unirender_evaluation.physics import formulas
from unirender_evaluation.physics import run as physics_run
from unirender_evaluation.physics.ambiguity import POSTERIOR
from unirender_evaluation.physics.run import (
    COMPOSITE,
    MITSUBA,
    OURS,
    ROWS,
    TWIN,
    Sampler,
    Value,
    findings,
    markdown,
    write,
)
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.physics.tests import TESTS
from unirender_evaluation.physics.tracer import MIRROR, PathTracer, moved
from unirender_evaluation.suites.suite import load_suite
from unirender_reference.shapes import MeshObject, make_object

SCENE = "test-000015_l1"  # its truth took the fewest samples


def values(twin_fails: bool) -> list[Value]:
    """Three objects' values: every row as good as Mitsuba, the twins broken by twice the margin or not at all."""
    made = []
    for test in TESTS.values():
        sign = -1 if test.metric.higher_is_better else 1
        for row in (MITSUBA, COMPOSITE, TWIN):
            bad = sign * 2 * test.margin if row == TWIN and twin_fails else 0.0
            made += [Value(test.name, row, f"o{i}_l0", f"o{i}", 0.5 + bad) for i in range(3)]
    return made


def test_a_blind_test_is_said_to_fail(tmp_path: Path) -> None:
    assert all(finding.refused for finding in write(tmp_path, values(twin_fails=True), {"suite": "none"}))
    stored = json.loads((tmp_path / "physics.json").read_text())
    assert {t["name"] for t in stored["tests"] if t["twin_refused"]} == set(TESTS)
    table = (tmp_path / "physics.md").read_text()
    assert table.count("PASS") == len(TESTS)
    assert "FAIL" not in table
    assert "± " not in table  # an interval stays with its sign where a column is narrow, as in all tables
    blind = findings(values(twin_fails=False))
    assert not any(finding.refused for finding in blind)
    assert markdown(blind, {}).count("FAIL") == len(TESTS)


def test_a_law_of_black_pictures_has_no_value(tmp_path: Path) -> None:
    """It was NaN, and so was the mean over all scenes."""
    suite = make_suite(tmp_path, objects=1)
    stage, roll = Stage(suite, suite.scenes[0]), TESTS["roll"]
    rows = {MITSUBA: Composite().render, TWIN: lambda maps: np.zeros((maps.height, maps.width, 3), np.float32)}
    made = physics_run.values_of(roll, stage, rows)
    assert [(value.row, value.value) for value in made] == [(MITSUBA, 0.0)]
    finding = next(finding for finding in findings(made) if finding.test is roll)
    assert not finding.refused


def test_rows_of_a_test(tmp_path: Path) -> None:
    """Composite has no decomposition; everybody else answers both kinds. Only who samples has a posterior."""
    suite = make_suite(tmp_path, objects=1)
    stage = Stage(suite, suite.scenes[0])
    tracer, ours = PathTracer.__new__(PathTracer), Composite()
    tracer.stage = stage
    render, decompose = TESTS["roll"], TESTS["loss_rough"]
    assert tuple(physics_run.subjects(render, tracer, ours)) == ROWS
    ours.decompose = lambda **_: None  # pyright: ignore[reportAttributeAccessIssue] - of methods that decompose
    assert set(ROWS) - set(physics_run.subjects(decompose, tracer, ours)) == {COMPOSITE}
    posterior = TESTS["ambiguity_share"]
    assert set(physics_run.subjects(posterior, tracer, ours)) == {MITSUBA, TWIN}
    sampled = physics_run.subjects(posterior, tracer, ours, lambda *_: np.zeros((POSTERIOR, 3)))
    assert set(sampled) == {MITSUBA, OURS, TWIN}


@pytest.mark.long
def test_our_samples_are_drawn_once_for_a_picture(tmp_path: Path) -> None:
    """Nineteen materials in the cube that differ; the second test that asks has the same, another picture its own."""
    suite = make_suite(tmp_path, objects=1)
    stage, sampler = Stage(suite, suite.scenes[0]), Sampler(make_pipeline())
    image = stage.image(stage.own_material)
    drawn = sampler(stage, stage.own_material, image)
    assert drawn.shape == (POSTERIOR, 3)
    assert 0 <= drawn.min() <= drawn.max() <= 1
    assert np.ptp(drawn, axis=0).min() > 1e-4
    assert sampler(stage, stage.own_material, image) is drawn
    assert (Sampler(make_pipeline())(stage, stage.own_material, image) == drawn).all(), "seeded by the picture"
    other = stage.suite.spec.edits[0]
    assert other != stage.own_material
    shown = stage.image(other)
    theirs = sampler(stage, other, shown)
    assert (theirs == Sampler(make_pipeline())(stage, other, shown)).all(), "not by what was asked before"
    assert np.abs(theirs - drawn).max() > 1e-4
    assert sampler(stage, stage.own_material, image) is drawn


def test_moved_meshes_stay_outside_out() -> None:
    """Face normals of a reflected or turned object still point along its shading normals; without the reversed faces
    a reflection's would not."""
    obj = make_object(0, "test")

    def agreement(of: MeshObject) -> float:
        corners = of.vertices[of.faces]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return float(np.mean((faces * of.normals[of.faces].mean(axis=1)).sum(axis=-1) > 0))

    assert agreement(obj) > 0.95
    assert agreement(moved(obj, turn_rotation(1))) == pytest.approx(agreement(obj), abs=0.01)
    reflected = moved(obj, MIRROR)
    assert agreement(reflected) == pytest.approx(agreement(obj), abs=0.01)
    assert agreement(replace(reflected, faces=np.ascontiguousarray(reflected.faces[:, ::-1]))) < 0.05


def test_path_tracer_passes_what_light_does(tmp_path: Path) -> None:
    """A mirror image of the object is the mirror image of its picture, to within noise; another mesh is not."""
    suite = load_suite("tiny")
    stage = Stage(suite, suite.scene(SCENE))
    tracer = PathTracer(stage, 256)
    assert TESTS["mirror_flip"].run(tracer.render, stage) < 0.06
    unflipped = formulas.relative_error(tracer.render(stage.base), tracer.render(stage.base)[:, ::-1])
    assert unflipped > 0.2, "twin: the scene is not its own mirror image"
    with pytest.raises(UnirenderError, match="normals"):
        tracer.render(stage.base.replace(normal=stage.base.require("normal")["normal"][::-1].copy()))
    with pytest.raises(UnirenderError, match="albedo"):
        tracer.render(stage.base.replace(albedo=0.5 * stage.base.require("albedo")["albedo"]))
