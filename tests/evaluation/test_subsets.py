"""On how many scenes the slow rows run: one value for all of them, and notes that say what was run."""

from collections import Counter
from pathlib import Path

import pytest
from tiny_suites import make_suite

from unirender_evaluation.methods.optimized_rows import optimized_rows
from unirender_evaluation.physics.rows import physics_scenes
from unirender_evaluation.rows import Row
from unirender_evaluation.runs.command import BenchRun
from unirender_evaluation.runs.config import BenchConfig, build_rows
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.subsets import STANDARD, WHOLE, Subsets, partial
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.tasks import tasks
from unirender_evaluation.versions import LPIPS, MODEL, REFERENCE, Versions

VERSIONS = Versions("test", {LPIPS: "none", MODEL: "1", REFERENCE: "1"})
SLOW = ("ours-sample", "shade-true-maps")


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("subsets"), objects=4)


def rows_of(subsets: Subsets) -> dict[str, Row]:
    return {row.info.key: row for row in build_rows(BenchConfig(methods=("ours", "trivial"), subsets=subsets))}


def physics_labels(suite: Suite, subsets: Subsets, folder: Path) -> int:
    """Scenes of a run that have physics records."""
    run = Run(suite, (), list(suite.scenes), VERSIONS, (), folder, subsets)
    return sum(any(job.label.startswith("physics") for job in run.jobs(scene)) for scene in suite.scenes)


def test_a_limit_that_takes_all_scenes_makes_no_partial_run() -> None:
    assert [partial(limit, 48) for limit in (None, 1, 47, 48, 100)] == [None, 1, 47, None, None]


def test_a_default_run_keeps_to_the_stated_subsets(suite: Suite, tmp_path: Path) -> None:
    rows = rows_of(STANDARD)
    assert {key: row.scenes for key, row in rows.items() if row.scenes is not None} == dict(
        zip(SLOW, (4, 12), strict=True)
    )
    assert physics_labels(suite, Subsets(physics=3), tmp_path) == 3
    assert BenchRun().subsets == BenchConfig().subsets == STANDARD == Subsets(4, 12, 12, 4, 2, 4, 4)


def test_a_full_run_has_no_subset(suite: Suite, tmp_path: Path) -> None:
    assert BenchRun(full=True).subsets == WHOLE
    rows = rows_of(WHOLE)
    assert set(SLOW) <= set(rows)
    assert all(row.scenes is None for row in rows.values())
    assert physics_labels(suite, WHOLE, tmp_path) == len(suite.scenes) == 8


def test_the_slowest_rows_have_options_of_their_own() -> None:
    assert BenchRun(full=True, sample_scenes=3).subsets == Subsets(3, None, None, None, None, None, None)
    assert BenchRun(sample_scenes=0).subsets == Subsets(0, 12, 12, 4, 2, 4, 4)
    assert BenchRun(full=True, optimise_scenes=2, view_objects=0).subsets == Subsets(None, None, None, 2, None, 0, None)
    assert "ours-sample" not in rows_of(Subsets(sample=0))


def test_optimisation_rows_take_some_pictures_of_some_scenes(suite: Suite) -> None:
    """Four scenes of eight; of each all edits and relightings, which share a picture, and some of the materials."""
    rows = {row.info.key: row for row in optimized_rows(4, 1)}
    scenes = list(suite.scenes)
    for row in rows.values():
        asked = [task for table, protocol in PROTOCOLS for task in tasks(suite, table, protocol, scenes)]
        asked = [task for task in asked if row.answers(task, scenes)]
        assert {scenes.index(task.scene) for task in asked} == {0, 2, 5, 7}
        assert Counter(task.table for task in asked) == {"rendering": 12, "inverse": 4, "relighting": 8, "light": 4}
        assert not any(task.protocol in ("given", "given-light") for task in asked)
        assert row.described(8).note.endswith("; 4 scenes only; inverse: 1 picture of each scene only")
    whole = optimized_rows(None)[0]
    assert all(whole.answers(task, scenes) for task in tasks(suite, "inverse", "single-image", scenes))


def test_only_the_row_that_says_so_is_told_the_mesh(suite: Suite) -> None:
    """Its key is another one, its label says it, and no published value stands beside it."""
    plain, told = optimized_rows(4)
    assert (plain.told, told.told) == (frozenset(), {"geometry"})
    assert plain.info.config == told.info.config
    assert plain.config != told.config
    assert "true mesh" in told.info.label
    assert (plain.info.published, told.info.published) == ("NvDiffrec", None)


def test_physics_scenes_are_the_runs_own(suite: Suite) -> None:
    """A limited run has fewer than the subset: all of its own."""
    few = list(suite.scenes)[3:6]
    assert physics_scenes(suite, few, 12) == few
    chosen = physics_scenes(suite, list(suite.scenes), 4)
    assert [suite.scenes.index(scene) for scene in chosen] == [0, 2, 5, 7]


def test_notes_say_how_many_scenes_only_where_a_row_had_fewer() -> None:
    rows = rows_of(STANDARD)
    notes = {scenes: [rows[key].described(scenes).note for key in SLOW] for scenes in (48, 12, 2)}
    assert notes[48][0] == notes[12][0] == "4 scenes only"
    assert notes[48][1] == f"{notes[12][1]}; 12 scenes only"
    assert not any("scenes only" in note for note in (notes[12][1], *notes[2]))
    full = rows_of(WHOLE)
    assert not any("scenes only" in row.described(48).note for row in full.values())
    assert rows["composite"].described(48) == rows["composite"].info
