"""The truth check of a run folder: when it is rendered again, when reused, and which of its records a run gets.

Mitsuba renders 32 x 32 pixels of this suite's made-up objects: the check itself fails, which is not the question here.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress
from tiny_suites import make_suite

from unirender_evaluation.bounds import REFERENCE_KEY
from unirender_evaluation.methods.mitsuba import MITSUBA
from unirender_evaluation.records import RunInfo
from unirender_evaluation.runs.truth_check import CheckRequest, draw_seed, read_check, reference_row, run_check
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.store import Store
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.truth.check import chosen_scenes
from unirender_evaluation.verdict import verdict_text
from unirender_evaluation.versions import LPIPS, MODEL, REFERENCE, Versions

VERSIONS = Versions("test", {LPIPS: "none", MODEL: "1", REFERENCE: "1"})


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("run_check"))


class Folder:
    """A run folder whose checks are counted."""

    def __init__(self, suite: Suite, path: Path, scenes: int | None = None, count: int = 1) -> None:
        self.path, self.count = path, count
        self.run = Run(suite, (), list(suite.scenes)[:scenes], VERSIONS, (), path / "pictures")
        self.said: list[str] = []

    def check(self, versions: Versions = VERSIONS, seed: int | None = None, again: bool = False) -> dict:
        """One run's check; its records are in `records`."""
        store = Store.open(self.path / "records.jsonl")
        request = CheckRequest(self.path / "truth_check.json", self.count, seed, again)
        with Progress(console=Console(quiet=True)) as progress:
            found = run_check(request, replace(self.run, versions=versions), store, progress, self.said.append)
        self.records = store.close()
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


@pytest.mark.slow
def test_a_limited_run_gets_the_records_of_its_scenes(suite: Suite, tmp_path: Path) -> None:
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
