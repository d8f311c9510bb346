"""`unirender bench unknown-mesh`: measured once, stored, continued; tables with the aims; refused options."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from tiny_suites import make_suite

from unirender_evaluation.metrics import DEFAULT_VARIANT, metric_key
from unirender_evaluation.multiview.scenes import multiview_scenes
from unirender_evaluation.multiview.settings import STANDARD, MultiviewSettings
from unirender_evaluation.multiview.tables import SECONDS
from unirender_evaluation.records import Record
from unirender_evaluation.studies.unknown_mesh import run as run_module
from unirender_evaluation.studies.unknown_mesh.command import LEAST_VIEWS, BenchUnknownMesh
from unirender_evaluation.studies.unknown_mesh.measure import STRIP, UnknownMesh, measure
from unirender_evaluation.studies.unknown_mesh.run import run
from unirender_evaluation.studies.unknown_mesh.tables import AIMS, aim_notes
from unirender_evaluation.versions import MULTIVIEW, OPTIMIZER, REFERENCE, Versions
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.transport.config import TransportConfig

SETTINGS = MultiviewSettings(seen=4, held_out=1, spp=16, truth_spp=16, buffer_spp=16)
CONFIG = OptimizeConfig(
    transport=TransportConfig(materials="one", pixels=150, iterations=1, rounds=0),
    refine=RefineConfig(iterations=2, spp=2, spp_gradient=2, depth=2),
    shape=ShapeConfig(cells=16, mask_steps=2, image_steps=2, spp=2, depth=2),
    shape_rounds=1,
    texture_size=16,
    light_rows=8,
)
VERSIONS = Versions("test", {MULTIVIEW: "1", OPTIMIZER: "1", REFERENCE: "1"})
STAGES = ("shape", "transport", "reshape-1", "transport-1", "refine")


@pytest.fixture(scope="module")
def what(tmp_path_factory: pytest.TempPathFactory) -> UnknownMesh:
    """One object of 32 pixels; nothing is measured yet."""
    suite = make_suite(tmp_path_factory.mktemp("suite"), objects=1)
    return UnknownMesh(suite, tmp_path_factory.mktemp("unknown"), SETTINGS, CONFIG, VERSIONS)


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Console:
    return Console(file=(tmp_path_factory.mktemp("console") / "out.txt").open("w+"), width=200)


@pytest.fixture(scope="module")
def record(what: UnknownMesh, console: Console) -> Record:
    return run(what, what.suite.scenes[:1], console)[0]


@pytest.mark.long
def test_everything_is_measured(what: UnknownMesh, record: Record) -> None:
    scene = what.suite.scenes[0]
    assert (record.sample, record.object, record.key) == (scene.key, scene.object, what.key(scene))
    assert 0.3 < record.values["shape.mask_iou"] < 1
    assert 0 < record.values["shape.chamfer"] < 0.5
    for key in ("albedo.psnr@masked-srgb-raw", "environment.peak_deg", "relit.ssim@masked-srgb-raw"):
        assert key in record.values
    parts = [record.values[metric_key(f"time_{stage}", SECONDS)] for stage in STAGES]
    assert min(parts) > 0
    assert sum(parts) <= record.values["time.seconds"] == record.seconds
    assert {"mesh.glb", "environment.exr", "solution.json", STRIP} <= {p.name for p in what.folder(scene).iterdir()}


@pytest.mark.long
def test_a_second_run_measures_nothing(what: UnknownMesh, record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr("unirender_evaluation.studies.unknown_mesh.measure.measured", refuse)
    assert list(measure(what, what.suite.scenes[:1])) == [(record, False)]
    changed = replace(what, versions=Versions("test", {**VERSIONS.parts, OPTIMIZER: "2"}))
    assert changed.folder(what.suite.scenes[0]) != what.folder(what.suite.scenes[0])
    with pytest.raises(AssertionError, match="measured again"):
        next(measure(changed, what.suite.scenes[:1]))


@pytest.mark.long
def test_a_lost_record_is_scored_again_from_the_finished_result(
    what: UnknownMesh, record: Record, tmp_path: Path
) -> None:
    """As after a kill between the last stage and the record: nothing is optimised twice, and the seconds stay."""
    scene = what.suite.scenes[0]
    again = replace(what, out=tmp_path)
    shutil.copytree(what.folder(scene), again.folder(scene))
    steps = []
    found, new = next(measure(again, [scene], lambda scene: steps.append))
    assert new
    assert not steps
    assert found.values == record.values


@pytest.mark.long
def test_tables_show_objects_their_mean_and_the_aims(what: UnknownMesh, record: Record, console: Console) -> None:
    text = (what.out / "unknown_mesh.md").read_text()
    assert text.count("### ") == 3
    assert f"{record.values['shape.mask_iou']:.4f}" in text
    assert "mean (n = 1)" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert "reshape-1 time (s)" in text
    content = json.loads((what.out / "unknown_mesh.json").read_text())
    assert content["objects"][0]["values"]["shape.mask_iou"] == record.values["shape.mask_iou"]
    assert content["mean"]["shape.chamfer"] == {
        "mean": record.values["shape.chamfer"],
        "low": None,
        "high": None,
        "n": 1,
        "objects": 1,
    }
    assert [aim["bound"] for aim in content["aims"]] == [0.97, 0.93, 600]


def test_every_option_reaches_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with a value that is not its default."""
    seen = list[tuple]()
    monkeypatch.setattr(run_module, "run", lambda *given: seen.append(given))
    assert BenchUnknownMesh("standard", tmp_path, 1, LEAST_VIEWS, progress=False, config=CONFIG).run() == 0
    ((study, scenes, _, progress),) = seen
    assert (study.suite.spec.name, study.out, study.config, progress) == ("standard", tmp_path, CONFIG, False)
    assert study.settings == replace(STANDARD, seen=LEAST_VIEWS)
    assert scenes == multiview_scenes(list(study.suite.scenes), 1)


def test_aims_are_counted_by_object() -> None:
    def made(sample: str, iou: float, seconds: float) -> Record:
        values = {
            AIMS[0].column.key(DEFAULT_VARIANT): iou,
            AIMS[1].column.key(DEFAULT_VARIANT): 0.95,
            "time.seconds": seconds,
        }
        return Record("unknown-mesh", "unknown-mesh", "m", sample, sample, values)

    notes = aim_notes([made("a", 0.99, 100.0), made("b", 0.95, 601.0)])
    assert notes[0] == "Aim: mask IoU >= 0.97: 1 of 2 objects, mean 0.9700."
    assert "2 of 2" in notes[1]
    assert notes[2] == "Aim: seconds <= 600: 1 of 2 objects, mean 350.5."
