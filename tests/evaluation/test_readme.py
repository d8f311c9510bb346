"""Result tables reach the README and the documentation from a run's records, never by hand."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from unirender.errors import UnirenderError
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender_evaluation.claims import OPTIMISED
from unirender_evaluation.records import MethodInfo, Record, RunInfo, append_record, write_records, write_run
from unirender_evaluation.results import readme
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.task import LIGHT

STORED = Path(__file__).resolve().parents[2] / "evaluation" / "results"
SLOT = "<!-- {0}:begin -->\nwhat was here\n<!-- {0}:end -->\n"
README = f"# title\n\n{SLOT.format('results')}\n{SLOT.format('checkpoint')}\nend\n"


def write_example(folder: Path, limit: int | None = None, suite: str = "tiny") -> Path:
    """A run of one method on two samples of the inverse table."""
    folder.mkdir()
    values = ({"albedo.psnr@masked-srgb-raw": 20.0}, {"albedo.psnr@masked-srgb-raw": 23.0})
    records = [
        Record("inverse", "single-image", "mine", f"s{i}", f"object{i}", value, key=f"k{i}")
        for i, value in enumerate(values)
    ]
    write_records(folder / "records.jsonl", records)
    methods = (MethodInfo("mine", "Mine", "external"),)
    write_run(folder / "run.json", RunInfo(suite, "0" * 64, 64, methods, date="2026-11-21", limit=limit))
    return folder


def write_checkpoint(folder: Path) -> Path:
    """A folder with the facts of a training run and weights of 2,500,000 numbers."""
    folder.mkdir()
    facts = {"minutes": 61.4, "device": "cpu", "autocast": "bfloat16", "steps": 4000, "samples": 48000}
    (folder / "training.json").write_text(json.dumps(facts | {"train": {"model": {"resolution": 64}}}))
    save_file({"a": np.zeros((5, 400_000), np.float16), "b": np.zeros(500_000, np.float16)}, folder / "w.safetensors")
    return folder


def test_the_readme_and_the_stored_tables_show_the_measured_mean(tmp_path: Path) -> None:
    run = write_example(tmp_path / "run")
    target = tmp_path / "README.md"
    target.write_text(README)
    checkpoint = write_checkpoint(tmp_path / "checkpoint")
    folder = tmp_path / "stored" / "tiny"
    folder.mkdir(parents=True)
    for name in ("98-a-table-of-before.md", "notes.md"):
        (folder / name).write_text("of an earlier run")

    for _ in range(2):  # filling a filled README changes nothing
        options = ["--readme", str(target), "--stored", str(tmp_path / "stored"), "--checkpoint", str(checkpoint)]
        assert readme.main([str(run), *options]) == 0

    text = target.read_text()
    assert text.startswith("# title\n\n<!-- results:begin -->\n\nPrinted by `make bench` (tiny, 2026-11-21)")
    assert text.endswith("<!-- checkpoint:end -->\n\nend\n")
    assert "2.5 million parameters" in text
    assert "61 minutes on cpu (bfloat16): 4,000 steps, 48,000 samples" in text
    assert "21.50" in text
    assert "what was here" not in text
    assert "Protocol:" in text
    stored = [path.read_text() for path in folder.glob("*.md")]
    assert any("21.50" in table for table in stored)
    assert not (folder / "98-a-table-of-before.md").exists()
    assert (folder / "notes.md").exists()


def test_what_is_said_below_several_tables_is_said_once() -> None:
    methods = (MethodInfo("mine", "Mine", "external", note="said of a row"), MethodInfo("b", "B", "external"))
    records = [
        Record("inverse", "single-image", method, "s", "object", {"albedo.psnr@masked-srgb-raw": 20.0}, key=method)
        for method in ("mine", "b")
    ]
    records.append(
        Record("relighting", "from-image-hdri", "mine", "s", "object", {"relit.psnr@masked-srgb-raw": 9.0}, key="k")
    )
    text = readme.selection(build_tables(records, RunInfo("tiny", "0" * 64, 64, methods), ALL_TABLES))
    assert text.count("Mine: said of a row") == 1
    assert text.index("### Relighting") < text.index("### Notes") < text.index("- Mine: said of a row")

    alone = readme.selection(build_tables(records[:2], RunInfo("tiny", "0" * 64, 64, methods), ALL_TABLES))
    assert "Mine: said of a row" in alone
    assert "### Notes" not in alone


def test_what_is_stored_gives_the_same_again(tmp_path: Path) -> None:
    assert readme.main([str(write_example(tmp_path / "run")), "--stored", str(tmp_path / "a")]) == 0
    assert readme.main([str(tmp_path / "a" / "tiny"), "--stored", str(tmp_path / "b")]) == 0
    first, second = ({path.name: path.read_bytes() for path in (tmp_path / x / "tiny").iterdir()} for x in "ab")
    assert first == second
    assert "results.json.gz" in first


def test_another_suite_has_its_own_place_and_fewer_tables(tmp_path: Path) -> None:
    run = write_example(tmp_path / "run", suite="large")
    target = tmp_path / "README.md"
    target.write_text(README + SLOT.format("results-large"))
    options = ["--readme", str(target), "--checkpoint", str(write_checkpoint(tmp_path / "checkpoint"))]
    assert readme.main([str(run), *options]) == 0
    before, after = target.read_text().split("<!-- results-large:begin -->")
    assert "what was here" in before
    assert "Printed by `unirender bench run --suite large`" in after
    assert "21.50" in after


def test_the_readme_says_where_our_row_stands_on_the_suite_that_strangers_read(tmp_path: Path) -> None:
    run = write_example(tmp_path / "run", suite="standard")
    for i in range(2):
        values = {"albedo.psnr@masked-srgb-raw": 24.0}
        record = Record("inverse", "single-image", "ours-mean", f"s{i}", f"object{i}", values, key=f"o{i}")
        append_record(run / "records.jsonl", record)
    weights = {"weights": checkpoint_sha256(checkpoint_folder("tiny"))}
    methods = (MethodInfo("mine", "Mine", "trivial"), MethodInfo("ours-mean", "Ours (mean)", "ours", config=weights))
    write_run(run / "run.json", RunInfo("standard", "0" * 64, 64, methods, date="2026-11-21"))
    target = tmp_path / "README.md"
    target.write_text(README + SLOT.format("results-standard") + SLOT.format("standing"))
    assert readme.main([str(run), "--readme", str(target)]) == 0
    standing = target.read_text().split("<!-- standing:begin -->")[1]
    assert "| albedo, PSNR (dB) ↑ | 24.00 | 21.50 (Mine) |" in standing
    assert "`tiny` on `standard`: 2 objects" in standing


@pytest.mark.parametrize(
    ("optimised", "sampled", "options"),
    [(4, 4, ""), (0, 0, ""), (24, 4, " --optimise-scenes 24"), (24, 12, " --optimise-scenes 24 --sample-scenes 12")],
)
def test_the_command_says_how_many_scenes_the_dear_rows_saw(optimised: int, sampled: int, options: str) -> None:
    counts = {OPTIMISED: optimised, readme.SAMPLED: sampled}
    records = [
        Record(*LIGHT, method, f"s{i}", f"o{i}", {"light.log_rmse": 1.0})
        for method, n in counts.items()
        for i in range(n)
    ]
    assert readme.run_command("large", records) == f"unirender bench run --suite large{options}"


def test_the_results_of_another_shipped_checkpoint_have_a_place_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, stored = write_example(tmp_path / "run", suite="large"), tmp_path / "stored"
    options = [str(run), "--stored", str(stored), "--of", "small"]
    for weights, code in (("0" * 64, 1), (checkpoint_sha256(checkpoint_folder("small")), 0)):
        methods = (MethodInfo("mine", "Mine", "ours", config={"weights": weights}),)
        write_run(run / "run.json", RunInfo("large", "0" * 64, 64, methods, date="2026-11-21"))
        assert readme.main(options) == code
        assert stored.exists() == (code == 0)
    assert "weights: got 000000000000, expected " in capsys.readouterr().err
    assert (stored / "large-small" / "results.json.gz").is_file()
    with pytest.raises(SystemExit):
        readme.main([*options, "--readme", "README.md"])


def test_another_checkpoint_does_not_take_the_place_of_that_which_the_suite_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, stored = write_example(tmp_path / "run", suite="large"), tmp_path / "stored"
    for name, code in (("small", 1), ("tiny", 0)):
        methods = (MethodInfo("mine", "Mine", "ours", config={"weights": checkpoint_sha256(checkpoint_folder(name))}),)
        write_run(run / "run.json", RunInfo("large", "0" * 64, 64, methods, date="2026-11-21"))
        assert readme.main([str(run), "--stored", str(stored)]) == code
        assert stored.exists() == (code == 0)
    assert "those of tiny; run the benchmark without --checkpoint, or name the run's" in capsys.readouterr().err
    assert (stored / "large" / "results.json.gz").is_file()


@pytest.mark.long
@pytest.mark.parametrize("suite", sorted(path.name for path in STORED.iterdir()))
def test_the_projects_tables_and_readme_are_those_of_its_stored_values(suite: str, tmp_path: Path) -> None:
    own = (STORED.parents[1] / "README.md").read_text()
    target = tmp_path / "README.md"
    target.write_text(own)
    _, _, checkpoint = suite.partition("-")
    # In a process of its own: the checks of every call that tests run under take ten times as long as the work.
    options = ["--stored", str(tmp_path), *(["--of", checkpoint] if checkpoint else ["--readme", str(target)])]
    subprocess.run(
        [sys.executable, "-m", "unirender_evaluation.results.readme", str(STORED / suite), *options], check=True
    )
    folders = STORED / suite, tmp_path / suite
    committed, made = ({path.name: path.read_text() for path in folder.glob("*.md")} for folder in folders)
    again = (
        "make them again: python -m unirender_evaluation.results.readme evaluation/results/SUITE --readme README.md "
        "--stored evaluation/results (SUITE-CHECKPOINT: --of CHECKPOINT instead of --readme)"
    )
    assert committed == made, again
    assert target.read_text() == own, again


def test_a_method_without_values_gets_no_row(tmp_path: Path) -> None:
    run = write_example(tmp_path / "run")
    append_record(run / "records.jsonl", Record("inverse", "single-image", "silent", "s0", "object0", {}, key="k"))
    _, tables = readme.whole_run(run)
    rows = [row.key for table in tables for row in table.rows]
    assert "mine" in rows
    assert "silent" not in rows


def test_a_partial_run_is_refused_and_the_readme_untouched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_example(tmp_path / "run", limit=1)
    target = tmp_path / "README.md"
    target.write_text(README)

    assert readme.main([str(run), "--readme", str(target)]) == 1

    assert target.read_text() == README
    assert "partial run" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "<!-- a:begin -->", "<!-- a:end --> <!-- a:begin -->", 2 * SLOT.format("a")])
def test_a_readme_without_one_place_for_a_text_is_refused(text: str) -> None:
    with pytest.raises(UnirenderError, match="README"):
        readme.fill(text, "a", "table")


def test_the_figures_of_a_continued_checkpoint_are_those_of_all_its_runs(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path / "checkpoint")
    facts = json.loads((folder / "training.json").read_text())
    earlier = {"minutes": 20.0, "steps": 1000, "samples": 6000}
    (folder / "training.json").write_text(json.dumps(facts | {"continues": [earlier, earlier]}))
    text = readme.checkpoint_text(folder)
    assert "101 minutes on cpu (bfloat16): 6,000 steps, 60,000 samples in 3 runs" in text
    assert text.startswith("- `checkpoint`, 64 pixels: 2.5 million parameters")
    assert text.count("pixels") == 1
    elsewhere = {"continues": [earlier | {"device": "cuda"}, earlier]}
    (folder / "training.json").write_text(json.dumps(facts | elsewhere))
    assert "trained for 20 minutes on cuda and 81 minutes on cpu (bfloat16)" in readme.checkpoint_text(folder)
    larger = {"train": {"model": {"resolution": 128}}, "continues": [earlier | {"train": facts["train"]}]}
    (folder / "training.json").write_text(json.dumps(facts | larger))
    text = readme.checkpoint_text(folder)
    assert "- `checkpoint`, 128 pixels" in text
    assert (
        "in 2 runs, each from the weights of the one before, 61 minutes of them at 128 pixels, those before at 64"
        in text
    )
