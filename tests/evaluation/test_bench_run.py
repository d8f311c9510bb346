"""`bench run`: which rows a configuration asks for, what stops it, and a whole run with Mitsuba, twice."""

import csv
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import diffusers
import numpy as np
import pytest
from rich.console import Console
from tiny_suites import make_suite

from unirender.camera import Camera
from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender_evaluation import engine
from unirender_evaluation.ceiling import ceiling_breaches
from unirender_evaluation.claims import OURS
from unirender_evaluation.metrics import ALL_VARIANTS
from unirender_evaluation.predictions.check import PredictionError
from unirender_evaluation.results.file import read_results
from unirender_evaluation.results.lights import sample_lights
from unirender_evaluation.rows import make_row, trivial_rows
from unirender_evaluation.runs.benchmark import run
from unirender_evaluation.runs.command import BenchRun
from unirender_evaluation.runs.config import BenchConfig, anywhere, build_rows, load_pipeline
from unirender_evaluation.runs.dry_run import planned
from unirender_evaluation.suites.suite import Suite, load_suite
from unirender_evaluation.tasks import scene_ids, tasks
from unirender_evaluation.truth.check import chosen_scenes


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("bench_run"), objects=1)


def test_row_groups_are_checked(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="expected some of ours, optimisation, trivial, plugins"):
        build_rows(BenchConfig(methods=("everything",)))
    with pytest.raises(UsageError, match=r"--methods plugins: got no row, .* by --method FILE.py:CLASS or --predict"):
        build_rows(BenchConfig(methods=("plugins",)))
    with pytest.raises(UnirenderError, match="no checkpoint in"):
        build_rows(BenchConfig(methods=("ours",), checkpoint=tmp_path))


@pytest.mark.parametrize(("suite", "name"), [("tiny", "tiny"), ("standard", "small")])
def test_without_a_checkpoint_ours_is_the_one_for_the_suites_pictures(suite: str, name: str) -> None:
    rows = build_rows(BenchConfig(suite=suite, methods=("ours",)))
    found = {row.info.config["weights"] for row in rows if row.info.key == OURS}
    assert found == {checkpoint_sha256(checkpoint_folder(name))}


def test_loading_our_model_draws_no_bar(capfd: pytest.CaptureFixture[str]) -> None:
    """One of each worker would be what a log begins with."""
    diffusers.utils.logging.enable_progress_bar()
    load_pipeline(checkpoint_folder("tiny"), "cpu")
    assert capfd.readouterr().err == ""


def test_a_strangers_row_brings_the_trivial_ones(tmp_path: Path) -> None:
    """A row without what it has to beat says nothing."""
    (tmp_path / "guess.py").write_text(GUESS)
    rows = build_rows(BenchConfig(methods=(), method=(f"{tmp_path / 'guess.py'}:Guess",)))
    assert {row.info.key for row in trivial_rows()} | {"guess"} == {row.info.key for row in rows}
    assert build_rows(BenchConfig(methods=())) == []


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("raise RuntimeError('out of memory')", r"method 'wild', render \(x\): RuntimeError: out of memory"),
        ("import sys; sys.exit(3)", r"method 'wild', render \(x\): SystemExit: 3"),
        ("return None", r"method 'wild', render \(x\): got None, expected a picture"),
        ("return intrinsics", r"got object of shape \(\), expected finite linear radiance"),
        ("return intrinsics.albedo[..., 0]", r"expected finite linear radiance, floats of shape"),
        ("return intrinsics.albedo[:1]", r"of shape \(1, 2, 3\), expected finite linear radiance"),
        ("return intrinsics.albedo / 0", r"render \(x\): 12 of 12 values are NaN or infinite, expected finite linear"),
        ("return 4e30 * intrinsics.albedo", r"got a picture with values up to 2e\+30, expected at most 1e\+30"),
        ("return [[0.5], [0.5, 0.5]]", r"render \(x\): got list, of which no array can be made .*, expected finite"),
        (
            "import torch; return torch.ones((2, 2, 3), requires_grad=True)",
            r"render \(x\): got Tensor, of which no array can be made .*requires grad.*, expected finite",
        ),
    ],
)
def test_what_a_strangers_method_does_wrong_is_named(body: str, message: str) -> None:
    scope: dict[str, Any] = {}
    exec(f"class Wild:\n    name, config = 'wild', {{}}\n    def render(self, intrinsics):\n        {body}", scope)
    maps = Intrinsics(albedo=np.full((2, 2, 3), 0.5, np.float32))
    with np.errstate(divide="ignore"), pytest.raises(UnirenderError, match=message):
        engine.ask(make_row(scope["Wild"](), "external"), "render", "x", intrinsics=maps)


def test_the_maps_of_a_stranger_have_the_size_of_the_picture_and_a_light_has_its_own() -> None:
    class Light:
        name, config = "light", MappingProxyType({})

        def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
            if mask.all():
                return Intrinsics(environment=np.ones((16, 32, 3), np.float32))
            return Intrinsics(albedo=np.ones((8, 8, 3), np.float32))

    row, picture = make_row(Light(), "external"), np.ones((4, 4, 3), np.float32)
    inputs = {"image_srgb": picture, "camera": Camera()}
    light = engine.ask(row, "decompose", "x", mask=np.ones((4, 4, 1), np.float32), **inputs)
    assert light.present == ("environment",)
    with pytest.raises(UnirenderError, match=r"decompose \(x\): got maps of size \(8, 8\), expected \(4, 4\)"):
        engine.ask(row, "decompose", "x", mask=np.zeros((4, 4, 1), np.float32), **inputs)


def test_maps_of_a_stranger_that_cannot_be_scored_are_named() -> None:
    """A batch of one, as networks return it; and arrays that the method wrote into after it had made maps of them."""

    class Net:
        name, config = "net", MappingProxyType({})
        maps: Intrinsics

        def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
            return self.maps

    net = Net()
    row, inputs = make_row(net, "external"), {"image_srgb": np.ones((4, 4, 3), np.float32), "camera": Camera()}
    mask, albedo = np.ones((4, 4, 1), np.float32), np.ones((4, 4, 3), np.float32)
    net.maps = Intrinsics(albedo=albedo[None])
    with pytest.raises(
        UnirenderError, match=r"decompose \(x\): got albedo of shape \(1, 4, 4, 3\), expected .* not a batch"
    ):
        engine.ask(row, "decompose", "x", mask=mask, **inputs)
    net.maps = Intrinsics(albedo=albedo)
    albedo[0] = np.nan
    with pytest.raises(UnirenderError, match=r"method 'net', decompose \(x\): albedo: 12 of 48 values are NaN"):
        engine.ask(row, "decompose", "x", mask=mask, **inputs)


def test_a_run_is_the_same_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cluster's workers may run in another."""
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    named = BenchConfig(
        suite="ball.toml",
        checkpoint=Path("mine"),
        method=("guess.py:Guess?folder=mine", "package:Guess"),
        predictions={"mine": Path("mine")},
    )
    config = anywhere(named)
    assert (config.suite, config.checkpoint) == (str(tmp_path / "ball.toml"), tmp_path / "mine")
    assert config.method == (f"{tmp_path / 'guess.py'}:Guess?folder=mine", "package:Guess")
    assert config.predictions == {"mine": tmp_path / "mine"}
    assert anywhere(BenchConfig(checkpoint=Path("tiny"))).checkpoint == Path("tiny"), "one that ships"


def test_nothing_runs_before_all_predictions_are_sound(suite: Suite, tmp_path: Path) -> None:
    task = next(tasks(suite, "rendering", "given", list(suite.scenes)))
    for name in ("good", "bad"):
        (tmp_path / name / task.folder).mkdir(parents=True)
        (tmp_path / name / task.folder / "render_given.png").write_text("no picture")
    out = tmp_path / "out"
    config = BenchConfig(
        suite=str(suite.spec.path), out=out, methods=(), predictions={n: tmp_path / n for n in ("good", "bad")}
    )
    with pytest.raises(PredictionError) as error:
        run(config, Console(quiet=True))
    assert len(error.value.problems) == 2
    assert not out.exists()
    command = BenchRun(suite=str(suite.spec.path), out=out, methods=(), predictions=(f"bad={tmp_path / 'bad'}",))
    assert command.run() == 1
    assert not out.exists()


GUESS = """
import os
import numpy as np
from unirender import Intrinsics


class Guess:
    name = "guess"
    config = {}

    def __init__(self):
        os.chdir("/")

    def decompose(self, image_srgb, mask, camera):
        grey = np.full_like(image_srgb, 0.5) * mask
        return Intrinsics(albedo=grey, roughness=grey[..., :1], metallic=grey[..., :1], mask=mask, camera=camera)

    def edit(self, image_srgb, mask, camera, roughness=None, metallic=None):
        return 0.5 * image_srgb * mask
"""


@pytest.mark.long
def test_run_end_to_end_and_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two scenes of the shipped suite, no row of ours, a stranger's, which leaves the folder; Mitsuba's truth check;
    the second run computes nothing."""
    (tmp_path / "guess.py").write_text(GUESS)
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "run"
    tiny = load_suite("tiny")
    scenes = scene_ids(tiny, 2)
    config = BenchConfig(
        out=Path("run"),
        methods=("trivial",),
        method=("guess.py:Guess",),
        limit=2,
        check_scenes=1,
        check_seed=next(seed for seed in range(1000) if chosen_scenes(tiny, 1, seed)[0] in scenes),
        jobs=0,
    )
    missing = sum(row.missing for row in planned(config).rows)
    monkeypatch.chdir(tmp_path)
    first = run(config, Console(quiet=True))
    assert first.truth_check["passed"], first.truth_check
    assert first.computed == first.asked == missing > 0, "as the dry run said, with the records of no value"
    names = {"records.jsonl", "run.json", "truth_check.json", "tables.md", "tables.tex", "tables.json", "verdict.txt"}
    assert names | {"report.html", "records.csv"} <= {path.name for path in out.iterdir()}
    assert "limit 2" in (out / "tables.md").read_text()
    assert all(table.watermark for table in first.tables)
    assert not ceiling_breaches(first.records)
    methods = {record.method for record in first.records}
    bounds = {"noise-ceiling", "reference-other-seed", "shade-true-maps", "true-maps"}
    assert bounds | {"composite", "composite-split-sum", "composite-split-sum-seen-shadows", "guess"} <= methods
    assert all(record.sample.startswith(tuple(scene.key for scene in scenes)) for record in first.records), (
        "every row keeps to the run's scenes"
    )
    assert "rendering/from-image edit_metallic PSNR: guess" in first.verdict
    assert "against noise-ceiling" not in first.verdict
    assert "noise-ceiling, difference" in first.verdict
    assert "ours" not in first.verdict
    assert "cannot be compared (fewer than 3 objects)" in first.verdict
    stored = read_results(out)
    assert stored.lights == {s: own for s, own in sample_lights(tiny).items() if s in {r.sample for r in first.records}}
    with (out / "records.csv").open(newline="") as file:
        lines = [(row["method"], row["sample"], row["metric"], float(row["value"])) for row in csv.DictReader(file)]
    assert lines == [(r.method, r.sample, *item) for r in first.records for item in sorted(r.values.items())]
    monkeypatch.chdir(tmp_path)
    second = run(replace(config, variants=ALL_VARIANTS), Console())
    assert f"check seed {first.truth_check['seed']}" in " ".join(capsys.readouterr().out.split())
    assert (second.asked, second.computed) == (missing, 0)
    assert [r.to_json() for r in second.records] == [r.to_json() for r in first.records]
    assert second.verdict == first.verdict
    inverse = [table for table in second.tables if table.name == "inverse"]
    assert [table.variant for table in inverse] == list(ALL_VARIANTS)
    assert all(row.cells[0].measured for table in inverse for row in table.rows if row.key == "guess")
    assert all(table.heading in (out / "tables.md").read_text() for table in inverse)
