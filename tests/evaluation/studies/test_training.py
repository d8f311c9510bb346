"""`unirender bench training`: rows that differ in one thing, trained once, scored in pairs, continued."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from rich.console import Console
from synthetic_shards import write_dataset
from tiny_models import SIZE, TRAIN

from unirender.errors import UnirenderError
from unirender.models.config import ModelConfig
from unirender.training.presets import PRESETS
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record
from unirender_evaluation.rows import evenly
from unirender_evaluation.studies.training import run as training_run
from unirender_evaluation.studies.training.choices import BASE_PRESET, PLAIN, Choice, training_choices
from unirender_evaluation.studies.training.command import BenchTraining
from unirender_evaluation.studies.training.run import TrainingStudy, run
from unirender_evaluation.studies.training.tables import COLUMNS, cells, table, to_json
from unirender_evaluation.suites.suite import Suite

ROWS = (
    Choice(PLAIN, "", "Plain model", TRAIN),
    Choice("seed", "chance", "another seed", replace(TRAIN, seed=1)),
)


def silent(folder: Path) -> Console:
    return Console(file=(folder / "console.txt").open("w"), width=200)


@pytest.fixture(scope="module")
def study(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> TrainingStudy:
    """Two balls of 32 pixels, groups of the same size, two steps."""
    data = write_dataset(tmp_path_factory.mktemp("data"), shards=1, size=SIZE)
    return TrainingStudy(suite, data, tmp_path_factory.mktemp("out"), steps=2, device="cpu", parallel=1)


@pytest.fixture(scope="module")
def records(study: TrainingStudy, tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    return run(study, ROWS, study.suite.scenes, silent(tmp_path_factory.mktemp("console")))


def test_rows_differ_from_the_plain_model_in_what_they_say() -> None:
    """Each in one part of its configuration, and no two are the same."""
    plain, *others = training_choices()
    assert plain.name == PLAIN
    assert not plain.group
    assert plain.config.model.physics_prior == "none"
    assert plain.config.seed == BenchTraining(data=Path()).seed == 0
    assert len({str(row.config) for row in (plain, *others)}) == len(others) + 1
    for row in others:
        own, base = asdict(row.config), asdict(plain.config)
        assert len([name for name in base if own[name] != base[name]]) == 1, row.name
    for row in others:
        if row.name != "without-unified":
            own, base = asdict(row.config.model), asdict(plain.config.model)
            assert len([name for name in base if own[name] != base[name]]) <= 1, row.name
    assert isinstance(plain.config.model, ModelConfig)


def test_rows_may_be_changes_of_another_preset() -> None:
    """And those that would change nothing of it, or what another row changes, are left out."""
    first, *others = training_choices(preset="tiny_muon")
    assert (first.name, first.label) == (PLAIN, "`tiny_muon`")
    names = {row.name for row in others}
    assert not names & {"muon", "muon-fast", "split-sum-prior", "composite-loss"}
    assert {"seed", "no-cycle", "without-unified", "fast"} <= names
    assert len({str(row.config) for row in (first, *others)}) == len(others) + 1
    assert BenchTraining(data=Path()).preset == BASE_PRESET
    split = next(row.config.model for row in others if row.name == "without-unified")
    assert (split.unified, split.physics_prior) == (False, first.config.model.physics_prior)
    with pytest.raises(UnirenderError, match="no-such"):
        training_choices(preset="no-such")


def test_every_option_reaches_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with a value that is not its default."""
    seen = list[tuple]()
    monkeypatch.setattr(training_run, "run", lambda *given: seen.append(given))
    asked = BenchTraining(
        tmp_path, "standard", tmp_path / "out", 1, 7, "tiny_muon", ("seed", PLAIN), 6, 2, device="cpu", seed=5
    )
    assert asked.run() == 0
    ((study, rows, scenes, _),) = seen
    assert (study.data, study.out, study.steps) == (tmp_path, tmp_path / "out", 7)
    assert (study.device, study.parallel, study.preset) == ("cpu", 2, "tiny_muon")
    assert study.suite.spec.name == "standard"
    assert scenes == evenly(study.suite.scenes, 1)
    assert [(row.name, row.config.seed, row.config.batch_size) for row in rows] == [(PLAIN, 5, 6), ("seed", 6, 6)]
    assert rows[0].config.optimizer == PRESETS["tiny_muon"].optimizer


@pytest.mark.long
def test_every_row_is_scored_on_every_scene(records: list[Record]) -> None:
    """With all columns of the table."""
    assert [(r.method, r.sample) for r in records] == [
        (row.name, sample) for row in ROWS for sample in ("ball-0_l0", "ball-0_l1", "ball-1_l0", "ball-1_l1")
    ]
    for row in ROWS:
        assert [cell.n for cell in cells(records, row.name)] == [4] * len(COLUMNS)
    assert cells(records, PLAIN)[0].mean != cells(records, "seed")[0].mean


@pytest.mark.long
def test_a_second_run_trains_nothing(
    study: TrainingStudy, records: list[Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stored records stand; with other steps they do not."""

    def refuse(*_: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr("unirender.training.run.train", refuse)
    again = run(study, ROWS, study.suite.scenes, silent(tmp_path))
    assert again == records
    with pytest.raises(AssertionError, match="trained again"):
        run(replace(study, steps=3, out=tmp_path / "other"), ROWS, study.suite.scenes, silent(tmp_path))
    assert replace(study, steps=3).folder(ROWS[0]) != study.folder(ROWS[0])


def test_differences_are_paired_by_scene() -> None:
    """Scenes differ by 10 dB, the rows by 1 dB in each: the interval has no width, and 0 lies outside."""

    def record(method: str, sample: str, value: float) -> Record:
        return Record("t", "p", method, sample, sample, {key: value for key in keys})

    keys = [column.key(DEFAULT_VARIANT) for column in COLUMNS]
    made = [record(PLAIN, s, 10.0 * i) for i, s in enumerate("abc")]
    made += [record("seed", s, 10.0 * i + 1) for i, s in enumerate("abc")]
    cell = cells(made, "seed")[0]
    assert cell.difference is not None
    assert cell.difference.mean == pytest.approx(1.0)
    assert (cell.mean, cell.n) == (pytest.approx(11.0), 3)
    assert cell.decided
    shifted = [record("seed", s, 10.0 * i + d) for (i, s), d in zip(enumerate("abc"), (1.0, -1.0, 0.5), strict=True)]
    assert not cells(made[:3] + shifted, "seed")[0].decided, "a row that wins and loses"
    text = table(ROWS, made).markdown()
    assert "Chance: another seed" in text
    assert "**+1.00" in text


def test_the_file_of_one_object_is_strict_json() -> None:
    """Two scenes of it have a difference without an interval, which is null; it was NaN, which is no JSON."""
    keys = [column.key(DEFAULT_VARIANT) for column in COLUMNS]
    rows = (Choice(PLAIN, "", "Plain", TRAIN), Choice("seed", "seed", "Another seed", TRAIN))
    made = [
        Record("t", "validation", row.name, scene, "object", dict.fromkeys(keys, 1.0), f"{row.name}{scene}")
        for row in rows
        for scene in "ab"
    ]
    content = json.loads(to_json(rows, made, {}), parse_constant=pytest.fail)
    cell = content["rows"]["seed"]["cells"][keys[0]]
    assert cell["difference"] == {"mean": 0.0, "low": None, "high": None, "n": 2, "objects": 1}


def test_missing_data_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="no such data folder"):
        BenchTraining(data=tmp_path / "none").run()


@pytest.mark.long
def test_rows_that_the_data_cannot_train_are_left_out_at_the_start(
    study: TrainingStudy, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not after hours, when their turn has come; asked for by name they are refused."""
    trained: list[str] = []
    monkeypatch.setattr(training_run, "run", lambda _study, rows, *_: trained.extend(row.name for row in rows))
    BenchTraining(data=study.data, out=study.out).run()
    assert trained == [row.name for row in training_choices() if row.name != "one-at-a-time"]
    assert "one-at-a-time: left out" in capsys.readouterr().out
    trained.clear()
    with pytest.raises(UnirenderError, match="expected one-at-a-time"):
        BenchTraining(data=study.data, out=study.out, choices=("batches",)).run()
    assert not trained
