"""The truth check of a run folder: when it is rendered again, when reused, and which of its records a run gets.

Mitsuba renders 32 x 32 pixels of this suite's made-up objects: the check itself fails, which is not the question here.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

import unirender_reference.render
from unirender.intrinsics import Intrinsics
from unirender_evaluation.bounds import REFERENCE_KEY
from unirender_evaluation.methods.mitsuba import MITSUBA
from unirender_evaluation.metrics import Variant
from unirender_evaluation.records import RunInfo
from unirender_evaluation.runs.truth_check import CheckRequest, draw_seed, read_check, reference_row, run_check
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.store import Store
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.tables.protocol import protocol_line
from unirender_evaluation.tables.specs import PROTOCOLS
from unirender_evaluation.truth.check import chosen_scenes
from unirender_evaluation.truth.renders import TruthRenders
from unirender_evaluation.verdict import verdict_text
from unirender_evaluation.versions import LPIPS, MODEL, REFERENCE, Versions
from unirender_reference.passes import Estimate

VERSIONS = Versions("test", {LPIPS: "none", MODEL: "1", REFERENCE: "1"})


class Folder:
    """A run folder whose checks are counted."""

    def __init__(self, suite: Suite, path: Path, scenes: int | None = None, count: int = 1) -> None:
        self.path, self.count = path, count
        self.run = Run(suite, (), list(suite.scenes)[:scenes], VERSIONS, (), path / "pictures")
        self.said: list[str] = []

    def request(self, seed: int | None = None, again: bool = False) -> CheckRequest:
        return CheckRequest(self.path / "truth_check.json", self.count, seed, again)

    def check(
        self, versions: Versions = VERSIONS, seed: int | None = None, again: bool = False, close: bool = True
    ) -> dict:
        """One run's check; its records are in `records`. A run that is killed does not `close` its store."""
        store = Store.open(self.path / "records.jsonl")
        with Progress(console=Console(quiet=True)) as progress:
            found = run_check(
                self.request(seed, again), replace(self.run, versions=versions), store, progress, self.said.append
            )
        self.records = store.close() if close else list(store.used.values())
        return found


@pytest.mark.long
def test_a_check_is_reused_only_for_the_same_truth_code_and_seed(suite: Suite, tmp_path: Path) -> None:
    folder = Folder(suite, tmp_path)
    first = folder.check(seed=3)
    values = [(r.sample, r.values) for r in folder.records]
    assert first["seed"] == 3
    assert values
    assert not folder.said
    for seed in (3, None):  # the same seed, and whatever is there
        assert folder.check(seed=seed)["date"] == first["date"]
        assert [(r.sample, r.values) for r in folder.records] == values
    assert len(folder.said) == 2
    assert f"Truth check of {first['date']} reused: same truth, same code, check seed 3" in folder.said[0]
    path = tmp_path / "truth_check.json"
    path.write_text(json.dumps(read_check(path) | {"date": "earlier"}))
    folder.check(VERSIONS, seed=None)
    assert "Truth check of earlier reused" in folder.said[2]
    assert folder.check(seed=3, again=True)["date"] != "earlier"  # --recheck
    assert [(r.sample, r.values) for r in folder.records] == values  # on one machine: equal seeds, equal renders
    assert folder.check(seed=4)["seed"] == 4
    assert [(r.sample, r.values) for r in folder.records] != values
    other = Versions("test", {**VERSIONS.parts, REFERENCE: "2"})
    assert folder.check(other, seed=4)["identity"] != first["identity"]
    assert len(folder.said) == 3, "a changed reference is rendered again"
    network = Versions("test", {**other.parts, MODEL: "2"})
    folder.check(network, seed=4)
    assert len(folder.said) == 4, "a changed network is nothing to the truth"


class Drawing:
    """Grey pictures in place of Mitsuba's; every one is counted, and the one at `stop` never ends."""

    made: ClassVar[list[str]] = []
    stop: ClassVar[int | None] = None

    def __init__(self, obj: object, camera: object, resolution: int) -> None:
        self.size = resolution

    def _next(self, *what: object) -> None:
        if len(self.made) == self.stop:
            raise KeyboardInterrupt
        self.made.append(" ".join(map(str, what)))

    def _estimate(self, channels: int) -> Estimate:
        shape = (self.size, self.size, channels)
        level = float(len(self.made))
        return Estimate(np.full(shape, level, np.float32), np.full(shape, 0.1, np.float64))

    def geometry(self, spp: int, seed: int) -> Intrinsics:
        self._next("geometry", spp, seed)
        ones = np.ones((self.size, self.size, 3), np.float32)
        return Intrinsics(albedo=0.5 * ones, normal=ones / np.sqrt(np.float32(3)), mask=ones[..., :1])

    def image(self, light: np.ndarray, roughness: float, metallic: float, spp: int, seed: int) -> Estimate:
        self._next("image", roughness, metallic, spp, seed)
        return self._estimate(4)

    def specular(self, light: np.ndarray, roughness: float, spp: int, seed: int) -> Estimate:
        self._next("specular", roughness, spp, seed)
        return self._estimate(3)

    def diffuse(self, light: np.ndarray, spp: int, seed: int) -> Estimate:
        self._next("diffuse", spp, seed)
        return self._estimate(3)


@pytest.fixture
def drawing(monkeypatch: pytest.MonkeyPatch) -> type[Drawing]:
    monkeypatch.setattr(Drawing, "made", [])
    monkeypatch.setattr(Drawing, "stop", None)
    monkeypatch.setattr("unirender_evaluation.truth.check.scene_object", lambda suite, scene: None)
    monkeypatch.setattr("unirender_evaluation.truth.check.object_hash", lambda obj: "none")
    monkeypatch.setattr(unirender_reference.render, "Renderer", Drawing)
    return Drawing


def test_a_limited_run_gets_the_records_of_its_scenes(suite: Suite, tmp_path: Path, drawing: type[Drawing]) -> None:
    """The others wait for the whole run, which renders nothing again."""
    seed = next(s for s in range(100) if suite.scenes[0] in chosen_scenes(suite, 2, s))
    few, whole = Folder(suite, tmp_path, scenes=1, count=2), Folder(suite, tmp_path, count=2)
    check = few.check(seed=seed)
    inside = {suite.scenes[0].key}
    assert {record.sample.split("_m")[0].split("_to")[0] for record in few.records} == inside
    assert reference_row(check, few.run.scenes).note == "Mitsuba again, on the scene of the truth check"
    whole.check(seed=seed)
    assert len(whole.said) == 1
    assert {r.key for r in whole.records} == set(check["records"])
    assert len(whole.records) == 2 * len(few.records)
    assert {record.method for record in whole.records} == {REFERENCE_KEY}


def test_a_check_that_is_killed_goes_on(suite: Suite, tmp_path: Path, drawing: type[Drawing]) -> None:
    """Minutes of renders are no loss; what ends is the check that was begun, under its seed, with the same numbers."""
    folder = Folder(suite, tmp_path / "killed", count=2)
    drawing.stop = 5
    with pytest.raises(KeyboardInterrupt):
        folder.check()
    begun = folder.request().renders
    assert begun.count() == 5
    assert not folder.request().path.exists()
    drawing.stop = None
    check = folder.check()
    assert folder.said == [f"Truth check: goes on from 5 renders of check seed {check['seed']}."]
    made = list(drawing.made)
    assert len(set(made)) == len(made), "each once"
    assert not begun.folder or not begun.folder.exists()

    drawing.made.clear()
    whole = Folder(suite, tmp_path / "whole", count=2)
    other = whole.check(seed=check["seed"])
    assert drawing.made == made
    assert {**other, "date": ""} == {**check, "date": ""}
    assert [r.values for r in whole.records] == [r.values for r in folder.records]


@pytest.mark.parametrize("left", [0, 50, 200])
def test_a_damaged_render_is_made_again(tmp_path: Path, left: int) -> None:
    """A disk that lost a part of it ended this run and every one after it."""
    renders = TruthRenders(tmp_path)
    renders.of("image", lambda: {"mean": np.ones(100)})
    (path,) = tmp_path.glob("*.npz")
    path.write_bytes(path.read_bytes()[:left])
    assert renders.of("image", lambda: {"mean": np.zeros(100)})["mean"].max() == 0
    assert renders.of("image", dict)["mean"].max() == 0, "it is kept"


def test_another_check_begins_anew(suite: Suite, tmp_path: Path, drawing: type[Drawing]) -> None:
    """Of another seed, truth, code or number of scenes nothing counts."""
    folder = Folder(suite, tmp_path)
    drawing.stop = 3
    for versions, seed in ((VERSIONS, 3), (VERSIONS, 4), (Versions("test", {**VERSIONS.parts, REFERENCE: "2"}), 4)):
        drawing.made.clear()
        with pytest.raises(KeyboardInterrupt):
            folder.check(versions, seed=seed)
        assert len(drawing.made) == 3
    assert not folder.said


def test_a_stopped_run_keeps_the_records_of_other_scenes(suite: Suite, tmp_path: Path, drawing: type[Drawing]) -> None:
    """A limited run may be killed long after its check, before it has laid by what it did not ask for."""
    folder = Folder(suite, tmp_path, scenes=1, count=2)
    check = folder.check(seed=3, close=False)
    assert len(check["records"]) > len(folder.records)
    drawing.made.clear()
    folder.check(seed=3)
    assert not drawing.made
    assert "reused" in folder.said[0]


def test_a_truth_may_stay_unchecked_and_every_table_says_so(suite: Suite, tmp_path: Path) -> None:
    folder = Folder(suite, tmp_path, count=0)
    check = folder.check()
    assert (check["passed"], folder.records, folder.said) == (None, [], [])
    assert verdict_text([], RunInfo("t", "h", 64, ()), check).splitlines()[-1] == (
        "  open   truth: not rendered again, --check-scenes 0"
    )
    run = RunInfo("t", "h", 64, (), unchecked=check["unchecked"], mitsuba="3.9.1", truth_spp=64)
    line = dict(protocol_line(PROTOCOLS["from-image"], Variant(), run, [], [], (), None))
    assert line["truth"] == "Mitsuba 3.9.1, 64 spp, unchecked (--check-scenes 0)"


def test_a_drawn_seed_meets_the_scenes_of_a_limited_run(suite: Suite) -> None:
    for _ in range(20):
        assert chosen_scenes(suite, 1, draw_seed(suite, 1, [suite.scenes[2]]))[0] == suite.scenes[2]
    assert len({draw_seed(suite, 1, list(suite.scenes)) for _ in range(5)}) == 5


def test_a_suite_without_its_meshes_is_not_rendered_again(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was passed on without them: what needs none runs, and the verdict says what is open and where to get them."""
    meshes = {name: {"file": "a.obj", "file_sha256": "none"} for name in suite.provenance["objects"]}
    monkeypatch.setattr(suite, "provenance", suite.provenance | {"objects": meshes})
    folder = Folder(suite, tmp_path)
    check = folder.check()
    assert (check["passed"], folder.records) == (None, [])
    assert not (tmp_path / "truth_check.json").exists(), "a run with the meshes makes it"
    (said,) = folder.said
    assert re.match(r"No truth check: its meshes are not in any folder \(name their folder as .objects. under", said)
    assert reference_row(check, folder.run.scenes).key == REFERENCE_KEY
    assert check["unchecked"] == "its meshes are not here", "no path of this machine"
    text = verdict_text([], RunInfo("t", "h", 64, ()), check)
    assert f"  open   truth: not rendered again, {check['reason']}" in text
    jobs = list(folder.run.jobs(suite.scenes[0]))
    assert {job.label for job in jobs if job.is_done(lambda key: False)} == {MITSUBA.label, f"physics: {MITSUBA.label}"}
    assert {job.label for job in jobs} > {MITSUBA.label, f"physics: {MITSUBA.label}"}


def test_half_a_file_is_no_check(tmp_path: Path) -> None:
    path = tmp_path / "truth_check.json"
    assert read_check(path) == {}
    path.write_text('{"seed": 3, "ident')
    assert read_check(path) == {}
    path.write_text(json.dumps(np.arange(3).tolist()))
    assert read_check(path) == {}
