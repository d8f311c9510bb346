"""`unirender bench ...` with arguments that cannot be right: one line and status 2, before anything is done."""

from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
import tyro
from rich.console import Console
from small_results import RUN, small_records
from tiny_suites import write_suite

from unirender.cli import main
from unirender.errors import UnirenderError
from unirender.models.precision import resolve_device
from unirender_evaluation.commands import BenchExport
from unirender_evaluation.metrics import chosen_variants
from unirender_evaluation.records import Record
from unirender_evaluation.runs.benchmark import run
from unirender_evaluation.runs.command import BenchRun, print_verdict, shown_tables
from unirender_evaluation.runs.config import BenchConfig, build_rows
from unirender_evaluation.subsets import STANDARD
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.truth.make import make_truth
from unirender_reference.folder_lock import LOCK, locked, made_folder


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    """(exit status, what was printed to stderr)."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    return stopped.value.code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "option", "value", "expected"),
    [
        ("run", "--limit", "0", "at least 1"),
        ("run", "--check-scenes", "-1", "at least 0"),
        ("run", "--check-seed", "-1", "at least 0"),
        ("run", "--sample-scenes", "-1", "at least 0"),
        ("run", "--jobs", "-1", "at least 0"),
        ("run", "--seed", str(2**64), "an integer of 64 bits"),
        ("check", "--seed", "-1", "at least 0"),
        ("check", "--scenes", "0", "at least 1"),
        ("truth", "--workers", "0", "at least 1"),
        ("export", "--limit", "-1", "at least 1"),
    ],
)
def test_values_outside_their_range(
    command: str, option: str, value: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = {"truth": ["tiny"], "check": []}.get(command, ["--out", str(tmp_path / "out")])
    status, printed = refused(["bench", command, option, value, *more], capsys)
    assert (status, printed) == (2, f"unirender: error: {option} {value}: expected {expected}\n")
    assert not any(tmp_path.iterdir())


def test_an_output_that_cannot_be_written_is_told_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    for command, out in (
        (["figures"], tmp_path / "file"),
        (["bench", "physics"], tmp_path / "file"),
        (["bench", "shards", "--data", str(tmp_path)], tmp_path),
    ):
        status, printed = refused([*command, "--out", str(out)], capsys)
        assert status == 1
        assert printed.startswith(f"unirender: error: {'--out ' if out == tmp_path else ''}{out}: ")
        assert "is no folder" in printed or "is a folder, expected the name of a file" in printed


@pytest.mark.parametrize("command", [["run"], ["report", "run"], ["tables", "results.json"]])
def test_a_word_that_no_axis_of_a_variant_has(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--variant", "masked-linear", "--variant", "whole-shiny"]
    status, printed = refused(["bench", *command, *words], capsys)
    assert status == 2
    assert "--variant 'whole-shiny': got 'shiny', expected one word" in printed


def test_a_run_of_no_rows_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, printed = refused(["bench", "run", "--out", str(tmp_path / "out"), "--methods"], capsys)
    assert status == 2
    assert "--methods: got no group, expected some of ours, optimisation, trivial and plugins" in printed
    status, printed = refused(["bench", "run", "--out", str(tmp_path / "out"), "--methods", "plugins"], capsys)
    assert (status, printed.count("\n")) == (2, 1)
    assert "no plug-in is installed; name a method by --method FILE.py:CLASS" in printed
    assert not (tmp_path / "out").exists()


def test_an_unknown_device_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, printed = refused(["bench", "run", "--device", "foo", "--out", str(tmp_path / "out")], capsys)
    assert status == 2
    assert "internal error" not in printed


def test_the_device_of_our_rows_is_resolved_before_anything_runs() -> None:
    rows = build_rows(BenchConfig(methods=("ours",), device="auto"))
    assert {row.config["device"] for row in rows if "device" in row.config} == {str(resolve_device("auto"))}
    here = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    absent = next(name for name, available in here.items() if not available)
    with pytest.raises(UnirenderError, match=f"device: {absent} is not available here"):
        build_rows(BenchConfig(methods=("ours",), device=absent))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("我们",), "got the name '我们', expected a letter from a to z or a digit"),
        (("mine\x1b[2J",), "got the name 'mine\\x1b[2J', expected a letter from a to z or a digit"),
        (("Noise ceiling",), "rows: noise-ceiling occur twice or are taken"),
        (("Reference (other seed)",), "rows: reference-other-seed occur twice or are taken"),
        (("true maps",), "rows: true-maps occur twice or are taken"),
        (("shade(true maps)",), "rows: shade-true-maps occur twice or are taken"),
        (("Composite",), "rows: composite occur twice or are taken"),
        (("Ours (mean)",), "rows: ours-mean occur twice or are taken"),
        (("Mine A", "mine-a"), "rows: mine-a occur twice or are taken"),
    ],
)
def test_predictions_need_a_name_that_makes_a_key_of_its_own(
    names: tuple[str, ...], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine" / "picture").mkdir(parents=True)
    given = [word for name in names for word in ("--predictions", f"{name}={tmp_path / 'mine'}")]
    command = ["bench", "run", "--methods", "plugins", *given, "--out", str(tmp_path / "out")]
    status, printed = refused(command, capsys)
    assert status == 2
    assert expected in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_plugin_may_not_take_the_name_of_a_bound(tmp_path: Path) -> None:
    text = (
        "class Method:\n    name, config = {name!r}, {{}}\n    def render(self, intrinsics): return intrinsics.albedo\n"
    )
    for name in ("Noise ceiling", "Quiet ceiling"):
        (tmp_path / f"{name[0]}.py").write_text(text.format(name=name))
    with pytest.raises(UnirenderError, match="noise-ceiling occur twice or are taken, expected unique names"):
        build_rows(BenchConfig(methods=(), method=(f"{tmp_path / 'N.py'}:Method",)))
    rows = build_rows(BenchConfig(methods=(), method=(f"{tmp_path / 'Q.py'}:Method",)))
    assert "quiet-ceiling" in {row.info.key for row in rows}


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path: Path) -> None:
    suite, file = write_suite(tmp_path / "suite", objects=1), tmp_path / "file"
    file.write_text("kept")
    with pytest.raises(UnirenderError, match=r"file: cannot be made \(File exists\); choose another --out"):
        run(BenchConfig(suite=str(suite), out=file, methods=()), Console(quiet=True))
    with pytest.raises(UnirenderError, match=r"cannot be made \(Not a directory\); choose another --work"):
        next(make_truth(suite, file))
    assert file.read_text() == "kept"


def test_a_second_run_in_the_same_folder_waits_for_the_first(tmp_path: Path) -> None:
    """It would cut off the line that the first is writing, and rewrite the records without those that come later."""
    out = tmp_path / "out"
    with made_folder(out), locked(out):
        (out / "records.jsonl").write_text('{"half a line')
        with pytest.raises(UnirenderError, match="another run is writing here; wait for it, or choose another --out"):
            run(BenchConfig(suite=str(write_suite(tmp_path / "suite", objects=1)), out=out), Console(quiet=True))
        assert {path.name: path.read_text() for path in out.iterdir()} == {"records.jsonl": '{"half a line', LOCK: ""}
    assert not (out / LOCK).exists()


def test_every_option_of_a_run_reaches_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with another value than its default; the run itself does not begin."""
    found: list[BenchConfig] = []

    def stop(config: BenchConfig, console: Console) -> None:
        found.append(config)
        raise UnirenderError("far enough")

    monkeypatch.setattr("unirender_evaluation.runs.benchmark.run", stop)
    given: dict[str, Any] = {"suite": "standard", "out": tmp_path, "checkpoint": tmp_path / "c", "methods": ("ours",)}
    given |= {"method": ("m:A",), "limit": 3, "seed": 5, "check_scenes": 2, "check_seed": 9, "recheck": True}
    given |= {"device": "mps"}
    words: dict[str, Any] = {"sample_scenes": 1, "optimise_scenes": 2, "view_objects": 3, "predictions": ("a=x",)}
    others: tuple[dict[str, Any], ...] = ({"jobs": 0}, {"cluster": "slurm:2"})
    for more in others:
        command = BenchRun(**given, **more, **words, variant=("masked-linear-raw",))
        with pytest.raises(UnirenderError, match="far enough"):
            command.run()
        options: dict[str, Any] = {"jobs": 2, **given, **more}
        expected = BenchConfig(
            **options,
            predictions={"a": Path("x")},
            subsets=replace(STANDARD, sample=1, optimise=2, views=3),
            variants=chosen_variants(("masked-linear-raw",)),
        )
        assert found.pop() == expected


def test_repeated_options_add_up(tmp_path: Path) -> None:
    words = ["--predictions", "a=x", "--method", "m:A", "--predictions", "b=y", "--method", "m:B"]
    command = tyro.cli(BenchRun, args=words)
    assert (command.predictions, command.method) == (("a=x", "b=y"), ("m:A", "m:B"))


def test_export_says_what_is_asked_and_the_command_that_scores_the_answers_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite, out = write_suite(tmp_path / "suite"), tmp_path / "inputs"
    BenchExport(out, str(suite), limit=1).run()
    said = capsys.readouterr().out
    asked = "edit 3, relight 2, environment 1, render 6, intrinsics 2"
    assert said.startswith(f"14 questions about the pictures in {out} ({asked}); `unirender bench run ")
    command = tyro.cli(BenchRun, args=said.split("`")[1].split()[3:])
    expected = BenchRun(suite=str(suite), limit=1, methods=("plugins",), predictions=("NAME=FOLDER",))
    assert command == expected


@pytest.mark.parametrize(
    ("kind", "variants", "shown"),
    [
        ("trivial", (), ["inverse whole", "inverse masked"]),
        ("external", (), ["inverse whole", "inverse masked", "relighting masked"]),
        ("trivial", ("masked", "masked-aligned"), ["inverse masked", "inverse masked"]),
    ],
)
def test_a_run_prints_the_papers_tables_and_those_that_a_row_of_yours_answers(
    kind: Literal["trivial", "external"], variants: tuple[str, ...], shown: list[str]
) -> None:
    """Relighting by an HDRI is none of the paper's protocols."""
    run_info = replace(RUN, methods=tuple(replace(info, kind=kind) for info in RUN.methods))
    tables = build_tables(small_records(), run_info, ALL_TABLES, chosen_variants(variants))
    assert [f"{table.name} {table.variant.mask}" for table in shown_tables(tables)] == shown


def test_a_run_of_your_row_alone_prints_what_it_answers() -> None:
    records = [record for record in small_records() if (record.method == "ours-mean") == (record.table == "relighting")]
    run_info = replace(RUN, methods=(replace(RUN.methods[0], kind="external"), *RUN.methods[1:]))
    tables = build_tables(records, run_info, ALL_TABLES)
    assert [table.name for table in tables] == ["inverse", "inverse", "relighting"]
    assert [table.name for table in shown_tables(tables)] == ["relighting"]


@pytest.mark.parametrize("kind", ["ours", "trivial", "external"])
def test_a_run_prints_the_physics_of_its_rows(kind: Literal["ours", "trivial", "external"]) -> None:
    """Of bounds alone beside a row of yours it says nothing of that row."""
    values = {"composite_input.psnr@masked-srgb-raw": 30.0}
    ours, *others = RUN.methods
    run_info = replace(RUN, methods=(replace(ours, kind=kind), *others))
    records = [*small_records(), Record("physics", "physics", "noise-ceiling", "s0", "o0", values)]
    tables = build_tables(records, run_info, ALL_TABLES)
    assert tables[-1].name == "physics"
    assert (tables[-1] in shown_tables(tables)) == (kind != "external")
    tables = build_tables([*records, Record("physics", "physics", ours.key, "s0", "o0", values)], run_info, ALL_TABLES)
    assert shown_tables(tables)[-1] == tables[-1]


@pytest.mark.parametrize(
    ("terminal", "expected"),
    [
        (False, ["verdict", "  HOLDS  a claim of many words beats another"]),
        (True, ["verdict", "  HOLDS  a claim of many", "         words beats", "         another"]),
    ],
)
def test_the_verdict_has_a_line_for_each_claim_or_is_set_below_its_beginning(
    terminal: bool, expected: list[str]
) -> None:
    out = StringIO()
    console = Console(file=out, width=24, force_terminal=terminal, color_system=None)
    print_verdict(console, "verdict\n  HOLDS  a claim of many words beats another", Path("run"))
    assert out.getvalue().splitlines() == expected


def test_lines_of_the_verdict_that_claim_nothing_are_counted() -> None:
    out = StringIO()
    lines = ["verdict", "  FAILS  a", "  open   b", "  HOLDS  c", "  stated d", "  not run e", "  infinite PSNR, not f"]
    print_verdict(Console(file=out, width=80), "\n".join(lines), Path("run"))
    folded = "  (2 more lines, which claim nothing: run/verdict.txt)"
    assert out.getvalue().splitlines() == [*lines[:4], lines[-1], folded]
