"""`bench run --dry-run`: counts what is stored and what is missing by row, and neither computes nor writes anything."""

from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from tiny_suites import make_suite

from unirender.errors import UnirenderError
from unirender_evaluation.runs.benchmark import prepare
from unirender_evaluation.runs.command import BenchRun
from unirender_evaluation.runs.config import BenchConfig
from unirender_evaluation.runs.dry_run import PlannedRow, planned, print_plan
from unirender_evaluation.store import Job, Store

METHOD = """
from unirender import Intrinsics


class Guess:
    name, config = "{name}", {{}}

    def decompose(self, image_srgb, mask, camera):
        return Intrinsics(albedo=image_srgb, mask=mask, camera=camera)
"""


@pytest.fixture
def config(tmp_path: Path) -> BenchConfig:
    suite = make_suite(tmp_path / "suite", objects=1)
    (tmp_path / "guess.py").write_text(METHOD.format(name="guess"))
    return BenchConfig(
        suite=str(suite.spec.path), out=tmp_path / "run", methods=(), method=(f"{tmp_path / 'guess.py'}:Guess",)
    )


def jobs(config: BenchConfig) -> list[Job]:
    here = prepare(config)
    return [job for scene in here.scenes for job in here.jobs(scene)]


def store_some(config: BenchConfig, label: str, count: int) -> None:
    """The first records of a row, as a killed run leaves them, with half a line behind."""
    config.out.mkdir(exist_ok=True)
    store = Store.open(config.out / "records.jsonl")
    for job in [job for job in jobs(config) if job.label == label][:count]:
        store.add(job.make())
    with store.path.open("a") as stream:
        stream.write('{"table": "inv')


def row(config: BenchConfig, label: str) -> PlannedRow:
    return next(found for found in planned(config).rows if found.label == label)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_is_stored_and_what_is_missing(config: BenchConfig) -> None:
    total = sum(job.label == "guess" for job in jobs(config))
    assert row(config, "guess") == PlannedRow("guess", 0, total, None), "nothing was measured: no estimate"
    store_some(config, "guess", 2)
    found = row(config, "guess")
    assert (found.stored, found.missing) == (2, total - 2)
    assert found.seconds is not None
    assert found.seconds >= 0
    assert row(config, "input as albedo").stored == 0
    assert sum(found.stored + found.missing for found in planned(config).rows) == len(jobs(config))


def test_answers_of_two_versions_of_a_method_may_be_stored(
    config: BenchConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is continued keeps those of each."""
    file = tmp_path / "guess.py"

    def edit(text: str) -> None:
        """Before a process of its own begins, which has imported no other."""
        file.write_text(text)
        monkeypatch.setattr("unirender_evaluation.methods.plugins._READ", {})

    for _ in range(2):
        store_some(config, "guess", 2)
        Store.open(config.out / "records.jsonl").close()
        edit(f"{file.read_text()}# edited\n")
    assert row(config, "guess").stored == 0
    edit(file.read_text().removesuffix("# edited\n"))
    assert row(config, "guess").stored == 2


def test_nothing_is_computed_or_written(config: BenchConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    store_some(config, "guess", 1)
    before = contents(config.out)

    def never(*_: object) -> None:
        raise AssertionError("computed")

    for name in ("answer", "score"):
        monkeypatch.setattr(f"unirender_evaluation.engine.{name}", never)
    planned(config)
    assert contents(config.out) == before, "the half line of a run at work is left alone, too"
    with pytest.raises(AssertionError, match="computed"):
        jobs(config)[0].make()


@pytest.mark.long
def test_one_more_method_is_all_that_is_new(config: BenchConfig, tmp_path: Path) -> None:
    """A row of a stranger beside stored ones."""
    for label in dict.fromkeys(job.label for job in jobs(config)):
        if not label.startswith("physics"):
            store_some(config, label, 1000)
    (tmp_path / "other.py").write_text(METHOD.format(name="other"))
    both = replace(config, method=(*config.method, f"{tmp_path / 'other.py'}:Guess"))
    missing = {found.label: found.missing for found in planned(both).rows if found.missing}
    assert {label for label in missing if not label.startswith("physics")} == {"other"}


def test_the_command_prints_and_leaves_no_folder(config: BenchConfig, capsys: pytest.CaptureFixture[str]) -> None:
    command = BenchRun(suite=config.suite, out=config.out, methods=(), method=config.method, dry_run=True)
    assert command.run() == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "nothing was computed" in shown
    assert "Mitsuba renders 4 scenes" in shown
    assert not config.out.exists()
    store_some(config, "guess", 1)
    print_plan(planned(config), Console(width=120))
    assert "the mean of the answers that are stored" in capsys.readouterr().out


def test_what_would_stop_the_run_stops_its_plan(config: BenchConfig) -> None:
    with pytest.raises(UnirenderError, match="no file"):
        planned(replace(config, method=("absent.py:Guess",)))
