"""Tables and plots of studies reach the documentation from the folders that the studies wrote, never by hand."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from rich.console import Console

from unirender.errors import UnirenderError
from unirender_evaluation.docs_tables import HEADING, STUDIES, main, missing, study_of
from unirender_evaluation.studies.derived_light import run as derived_light_run
from unirender_evaluation.studies.optimiser.ingredients import ingredients
from unirender_evaluation.studies.rows import StudyRow
from unirender_evaluation.studies.sampling import run as sampling_run
from unirender_evaluation.studies.speed import run as speed_run
from unirender_evaluation.studies.speed.parts import PARTS, PartName
from unirender_evaluation.studies.speed.timing import Part
from unirender_evaluation.studies.training import run as training_run
from unirender_evaluation.studies.training.choices import training_choices
from unirender_evaluation.studies.unknown_mesh import run as unknown_mesh_run
from unirender_evaluation.studies.warm_start import run as warm_start_run
from unirender_evaluation.table_text import TextTable

DOCS = Path(__file__).resolve().parents[2] / "docs"
PIECES = [study.piece for study in STUDIES]
PENDING = "Not measured yet with this version: run `unirender bench "
TABLE = TextTable("Milliseconds", ("part", "ms"), ((("decompose", "12.5"),),))


def speed(folder: Path, parts: Sequence[PartName] = PARTS) -> Path:
    """A folder as `unirender bench speed` writes it, by default with all parts."""

    def measured(name: PartName) -> Callable[[], Part]:
        return lambda: Part(name, (TABLE,), {"ms": 12.5})

    with (folder.parent / "console.txt").open("w") as out:
        speed_run.run(folder, {name: measured(name) for name in parts}, (("cores", "2"),), Console(file=out))
    return folder


def sampling(folder: Path) -> Path:
    """A folder with the files of `unirender bench sampling`."""
    folder.mkdir()
    (folder / f"{sampling_run.NAME}.md").write_text(TABLE.markdown())
    for number, name in enumerate((sampling_run.STEPS_PLOT, sampling_run.RELIABILITY_PLOT)):
        (folder / name).write_bytes(bytes([137, number]))
    return folder


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    """Sources of a documentation that shows nothing yet."""
    (tmp_path / "docs" / "_static").mkdir(parents=True)
    return tmp_path / "docs"


def test_what_a_study_wrote_is_what_a_page_includes(tmp_path: Path, docs: Path) -> None:
    folders = [str(speed(tmp_path / "speed")), str(sampling(tmp_path / "sampling"))]
    assert main([*folders, "--docs", str(docs)]) == 0
    assert (docs / "_speed.md").read_text() == (tmp_path / "speed" / "speed.md").read_text()
    shown = (docs / "_sampling.md").read_text()
    assert shown.startswith(TABLE.markdown())
    assert re.findall(r"^```\{figure\} (\S+)$", shown, re.MULTILINE) == [
        "_static/sampling.png",
        "_static/calibration.png",
    ]
    assert (docs / "_static" / "calibration.png").read_bytes() == bytes([137, 1])
    assert main([*folders, "--docs", str(docs), "--check"]) == 0


@pytest.mark.parametrize("stale", ["_speed.md", "_sampling.md", "_static/sampling.png"])
def test_a_check_finds_what_is_not_what_the_study_wrote(
    tmp_path: Path, docs: Path, stale: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(speed(tmp_path / "speed")), str(sampling(tmp_path / "sampling")), "--docs", str(docs)]
    assert main(arguments) == 0
    (docs / stale).write_text("### A number that was typed\n")
    capsys.readouterr()
    assert main([*arguments, "--check"]) == 1
    assert capsys.readouterr().err == f"{docs / stale}: not what the study wrote\n"
    assert (docs / stale).read_text() == "### A number that was typed\n", "a check writes nothing"
    assert main(arguments) == 0
    assert capsys.readouterr().out == f"{docs / stale}\n", "and what was right is not written again"


def test_what_is_no_studys_folder_is_refused_and_nothing_is_written(
    tmp_path: Path, docs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, other = speed(tmp_path / "speed"), tmp_path / "other"
    other.mkdir()
    arguments = [str(good), str(other), "--docs", str(docs)]

    def refused() -> str:
        assert main(arguments) == 1
        assert not list(docs.glob("_*.md"))
        return capsys.readouterr().err

    assert "got none of them, expected a study's folder, with one of speed.md, " in refused()
    (other / "sampling.md").write_text(TABLE.markdown())
    assert "sampling.png: no such file" in refused()
    (other / "sampling.md").write_text("no table")
    assert "got 'no table', expected a table" in refused()
    (other / "race.md").write_text(TABLE.markdown())
    assert "got sampling.md and race.md, expected" in refused()


def test_a_part_of_a_study_is_refused_unless_it_is_asked_for(
    tmp_path: Path, docs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(speed(tmp_path / "speed", ("network", "start"))), "--docs", str(docs)]
    assert main(arguments) == 1
    assert "a part of the study, without mitsuba, training, overfit; run it" in capsys.readouterr().err
    assert not list(docs.glob("_*.md"))
    assert main([*arguments, "--partial"]) == 0
    assert "Not measured in this run: mitsuba, training, overfit." in (docs / "_speed.md").read_text()


def test_a_second_run_of_a_study_has_a_file_of_its_own(
    tmp_path: Path, docs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = speed(tmp_path / "speed")
    assert main([str(folder), "--docs", str(docs), "--piece", "_other.md"]) == 0
    assert [path.name for path in docs.glob("_*.md")] == ["_other.md"]
    assert main([str(folder), str(folder), "--docs", str(docs), "--piece", "_other.md"]) == 1
    assert "expected one" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "all_rows"), [("training", training_choices()), ("ingredients", ingredients())])
def test_the_rows_of_a_study_are_those_of_its_json(name: str, all_rows: Sequence[StudyRow], tmp_path: Path) -> None:
    """Training writes its rows by name, the ingredients as a list."""
    (tmp_path / f"{name}.md").write_text(TABLE.markdown())

    def without(count: int) -> list[str]:
        names = [row.name for row in all_rows[count:]]
        rows = dict.fromkeys(names, 0) if name == "training" else [{"name": row} for row in names]
        (tmp_path / f"{name}.json").write_text(json.dumps({"rows": rows}))
        return missing(tmp_path, study_of(tmp_path))

    assert without(0) == []
    assert without(2) == [row.name for row in all_rows[:2]]
    (tmp_path / f"{name}.json").write_text("[")
    with pytest.raises(UnirenderError, match=f"{name}.json: cannot be read as what the study wrote"):
        missing(tmp_path, study_of(tmp_path))


def test_a_row_that_another_preset_does_not_have_is_not_missing(tmp_path: Path) -> None:
    """`tiny_muon` steps by Muon as it is: the row `muon` would be its first."""
    (tmp_path / "training.md").write_text(TABLE.markdown())
    content = {"rows": {"plain": 0, "no-cycle": 0}, "run": {"preset": "tiny_muon"}}
    (tmp_path / "training.json").write_text(json.dumps(content))
    absent = missing(tmp_path, study_of(tmp_path))
    assert {"seed", "patch-1"} <= set(absent)
    assert not {"muon", "plain", "no-cycle"} & set(absent)


def test_the_names_are_those_that_the_studies_write() -> None:
    """Of those that keep their name in one place."""
    named = (derived_light_run, sampling_run, speed_run, training_run, unknown_mesh_run)
    assert {f"{module.NAME}.md" for module in (*named, warm_start_run)} < {study.tables for study in STUDIES}


@pytest.mark.parametrize("piece", PIECES)
def test_one_page_includes_each_study_and_shows_tables_or_says_that_there_are_none(piece: str) -> None:
    pages = [path for path in DOCS.glob("*.md") if f"```{{include}} {piece}\n" in path.read_text(encoding="utf-8")]
    assert len(pages) == 1
    text = (DOCS / piece).read_text(encoding="utf-8")
    assert text.startswith((HEADING, PENDING))


def test_every_figure_of_a_piece_is_there() -> None:
    """A plot is stored with its tables."""
    for piece in PIECES:
        for name in re.findall(r"^```\{figure\} (\S+)$", (DOCS / piece).read_text(encoding="utf-8"), re.MULTILINE):
            assert (DOCS / name).is_file(), f"{piece}: {name}"
