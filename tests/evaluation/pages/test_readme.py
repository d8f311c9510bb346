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
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.pages import readme
from unirender_evaluation.records import MethodInfo, Record, RunInfo, append_record, write_records, write_run
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.task import LIGHT

STORED = Path(__file__).resolve().parents[3] / "evaluation" / "results"
SLOT = "<!-- {0}:begin -->\nwhat was here\n<!-- {0}:end -->\n"
README = "# title\n\n" + "\n".join(map(SLOT.format, ("standing", "results", "checkpoint"))) + "\nend\n"


def albedo(value: float) -> dict[str, float]:
    """The PSNR of an albedo, inside the mask and on the whole frame."""
    return {"albedo.psnr@masked-srgb-raw": value, "albedo.psnr@whole-srgb-raw": value + 5.0}


def write_example(folder: Path, limit: int | None = None, suite: str = "tiny") -> Path:
    """A run of one method on two samples of the inverse table."""
    folder.mkdir()
    records = [
        Record("inverse", "single-image", "mine", f"s{i}", f"object{i}", albedo(value), key=f"k{i}")
        for i, value in enumerate((20.0, 23.0))
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


def write_ours(run: Path) -> Path:
    """Gives a run a row of the shipped `tiny`, and makes the other one trivial."""
    for i in range(2):
        record = Record("inverse", "single-image", "ours-mean", f"s{i}", f"object{i}", albedo(24.0), key=f"o{i}")
        append_record(run / "records.jsonl", record)
    weights = {"weights": checkpoint_sha256(checkpoint_folder("tiny"))}
    methods = (MethodInfo("mine", "Mine", "trivial"), MethodInfo("ours-mean", "Ours (mean)", "ours", config=weights))
    write_run(run / "run.json", RunInfo("standard", "0" * 64, 64, methods, date="2026-11-21"))
    return run


def test_the_readme_and_the_stored_tables_show_the_measured_mean(tmp_path: Path) -> None:
    run = write_ours(write_example(tmp_path / "run", suite="standard"))
    target = tmp_path / "README.md"
    target.write_text(README)
    checkpoint = write_checkpoint(tmp_path / "checkpoint")
    folder = tmp_path / "stored" / "standard"
    folder.mkdir(parents=True)
    for name in ("98-a-table-of-before.md", "notes.md"):
        (folder / name).write_text("of an earlier run")

    for _ in range(2):  # filling a filled README changes nothing
        options = ["--readme", str(target), "--stored", str(tmp_path / "stored"), "--checkpoint", str(checkpoint)]
        assert readme.main([str(run), *options]) == 0

    text = target.read_text()
    assert text.startswith("# title\n\n<!-- standing:begin -->\n\n|  | Ours (mean) |")
    assert "| albedo, PSNR (dB) ↑ | 24.00 | 21.50 (Mine) |" in text
    assert "`tiny` on `standard`: 2 objects" in text
    assert "Rows and columns of what `unirender bench run --suite standard` prints (standard, 2026-11-21)" in text
    assert "| Uni-Renderer | **23.20** | - |" in text
    assert "| Ours (mean) | - | 29.00 |" in text  # the whole frame, beside what is published
    assert "Mine |" not in text  # a row that the README does not show
    assert text.endswith("<!-- checkpoint:end -->\n\nend\n")
    assert "2.5 million parameters" in text
    assert "61 minutes on cpu (bfloat16): 4,000 steps, 48,000 samples" in text
    assert "what was here" not in text
    assert "Protocol:" in text
    stored = [path.read_text() for path in folder.glob("*.md")]
    assert any("21.50" in table for table in stored)
    assert not (folder / "98-a-table-of-before.md").exists()
    assert (folder / "notes.md").exists()


def test_what_several_tables_have_is_said_once() -> None:
    methods = (MethodInfo("mine", "Mine", "external", note="said of a row"), MethodInfo("b", "B", "external"))
    records = [
        Record("inverse", "single-image", method, "s", "object", {"albedo.psnr@masked-srgb-raw": 20.0}, key=method)
        for method in ("mine", "b")
    ]
    records.append(
        Record("relighting", "from-image-hdri", "mine", "s", "object", {"relit.psnr@masked-srgb-raw": 9.0}, key="k")
    )
    run = RunInfo("tiny", "0" * 64, 64, methods)
    text = readme.together(build_tables(records, run, ALL_TABLES, [DEFAULT_VARIANT]))
    assert text.count("Mine: said of a row") == text.count("colour: sRGB") == 1
    assert text.count("given: one image and its mask") == text.count("Protocol: given") == 2
    assert text.index("### Relighting") < text.index(readme.COMMON) < text.index("- Mine: said of a row")

    alone = readme.together(build_tables(records[:2], run, ALL_TABLES, [DEFAULT_VARIANT]))
    assert "Mine: said of a row" in alone
    assert readme.COMMON not in alone


def test_a_table_says_where_it_is_not_as_most_are() -> None:
    rows, line = "ours-mean", {"albedo.psnr@masked-srgb-raw": 20.0, "albedo.psnr@whole-srgb-raw": 25.0}
    records = [Record("inverse", "single-image", rows, "s", "object", line, key="k")]
    run = RunInfo("tiny", "0" * 64, 64, (MethodInfo(rows, "Ours (mean)", "ours"),))
    whole, masked = build_tables(records, run, ALL_TABLES)
    *_, first, second, third, common = readme.together([whole, masked, whole]).split("Protocol")
    assert ["mask: whole frame" in part for part in (first, second, third, common)] == [False, False, False, True]
    assert "mask: inside the true mask" in second


def test_what_is_stored_gives_the_same_again(tmp_path: Path) -> None:
    assert readme.main([str(write_example(tmp_path / "run")), "--stored", str(tmp_path / "a")]) == 0
    assert readme.main([str(tmp_path / "a" / "tiny"), "--stored", str(tmp_path / "b")]) == 0
    first, second = ({path.name: path.read_bytes() for path in (tmp_path / x / "tiny").iterdir()} for x in "ab")
    assert first == second
    assert "results.json.gz" in first


def test_the_readme_shows_results_of_one_suite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "README.md"
    target.write_text(README)
    assert readme.main([str(write_example(tmp_path / "run", suite="large")), "--readme", str(target)]) == 1
    assert "--readme: got results of large, expected those of standard" in capsys.readouterr().err
    assert target.read_text() == README


def test_the_readme_counts_the_claims(tmp_path: Path) -> None:
    rows = {"ours-mean": (24.0, 25.0, 23.0), "input-as-albedo": (20.0, 21.0, 20.0), "mean-albedo": (20.0, 27.0, 9.0)}
    records = [
        Record("inverse", "single-image", key, f"s{i}", f"object{i}", albedo(value), key=f"{key}{i}")
        for key, values in rows.items()
        for i, value in enumerate(values)
    ]
    (tmp_path / "run").mkdir()
    write_records(tmp_path / "run" / "records.jsonl", records)
    methods = tuple(MethodInfo(key, key, "ours" if key == "ours-mean" else "trivial") for key in rows)
    write_run(tmp_path / "run" / "run.json", RunInfo("none", "0" * 64, 64, methods, date="2026-11-21"))
    lines = readme.verdict_counts(readme.whole_run(tmp_path / "run")[0]).splitlines()
    assert lines[0] == "- Of 2 claims 1 hold, 1 are open, 0 fail."
    assert lines[1].startswith("- Of 1 claims that hold 1 also do after Holm's correction for all 2")


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
    where = ["--readme", str(target)] if suite == readme.README_SUITE else []
    options = ["--stored", str(tmp_path), *(["--of", checkpoint] if checkpoint else where)]
    subprocess.run(
        [sys.executable, "-m", "unirender_evaluation.pages.readme", str(STORED / suite), *options], check=True
    )
    folders = STORED / suite, tmp_path / suite
    committed, made = ({path.name: path.read_text() for path in folder.glob("*.md")} for folder in folders)
    again = (
        "make them again: python -m unirender_evaluation.pages.readme evaluation/results/SUITE --stored "
        "evaluation/results (standard: --readme README.md; SUITE-CHECKPOINT: --of CHECKPOINT)"
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
