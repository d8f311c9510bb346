"""`unirender bench ls | validate | tables | compare` on the command line: what they print, and their exit statuses."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from small_results import HASH, METHODS, small_document, small_results, written

from unirender.cli import main
from unirender.errors import UnirenderError
from unirender_evaluation.comparisons import over_lights
from unirender_evaluation.metrics import DEFAULT_VARIANT, METRICS
from unirender_evaluation.records import Record
from unirender_evaluation.results.commands import rows_of
from unirender_evaluation.results.compare import Rank, chosen_pairs, compare_pair, rank
from unirender_evaluation.results.listing import LISTINGS, METHOD_GROUPS
from unirender_evaluation.runs.config import GROUPS
from unirender_evaluation.statistics import paired_difference
from unirender_evaluation.suites.home import found_spec
from unirender_evaluation.suites.spec import suite_path
from unirender_evaluation.table_list import ALL_TABLES

KEY = "albedo.psnr@masked-srgb-raw"


@pytest.fixture
def bench(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """Runs `unirender bench ...`; returns exit status, standard output and standard error."""
    monkeypatch.setenv("COLUMNS", "80")

    def run(*words: str | Path) -> tuple[object, str, str]:
        with pytest.raises(SystemExit) as stopped:
            main(["bench", *map(str, words)])
        printed = capsys.readouterr()
        return stopped.value.code, printed.out, printed.err

    return run


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Two valid files; in the second our row is 1 to 4 dB better, sample by sample."""
    better = small_document()
    for i, entry in enumerate(e for e in better["records"] if e["method"] == "ours-mean" and e["table"] == "inverse"):
        entry["values"][KEY] += 1 + i
    return written(tmp_path / "a.json", small_document()), written(tmp_path / "b.json", better)


def test_ls_names_everything(bench) -> None:
    status, out, _ = bench("ls")
    assert status == 0
    for name in ("tiny: ", "protocol from-image-hdri", "psnr: PSNR (dB), higher is better", "scale: raw, aligned"):
        assert name in out
    assert all(f"{name}\n" in out for name in LISTINGS)
    assert all(spec in out for spec in ALL_TABLES)
    tiny = found_spec(suite_path("tiny"))
    assert f"  truth {tiny.truth_sha256[:12]}: {tiny.truth_path}\n" in out
    status, out, _ = bench("ls", "variants")
    assert (status, out.splitlines()[0]) == (0, "variants")
    assert bench("ls", "suits")[0] == 2
    assert METHOD_GROUPS.keys() == set(GROUPS)


def test_validate_has_a_line_for_every_file_and_every_problem(bench, files: tuple[Path, Path], tmp_path: Path) -> None:
    status, out, _ = bench("validate", *files)
    assert (status, out.count(": valid, 3 rows, 20 records; suite ball 0123456789ab")) == (0, 2)
    bad = small_document()
    bad["run"]["coverage"], bad["records"][0]["method"] = 2, 7
    status, out, _ = bench("validate", files[0], written(tmp_path / "bad.json", bad), tmp_path / "gone.json")
    assert status == 1
    assert "bad.json: not valid, 2 problems\n  run.coverage: got 2" in out
    assert "not valid: " in out
    assert "gone.json: no such file" in out
    status, _, err = bench("validate")
    assert (status, err) == (
        2,
        "unirender: error: bench validate: got no file, expected a results.json, or the folder of a run\n",
    )


def test_tables_in_every_format(bench, files: tuple[Path, Path]) -> None:
    status, out, _ = bench("tables", files[0], "--table", "inverse", "--format", "markdown")
    assert status == 0
    assert out.count("### ") == 2  # whole beside the published values, and masked
    assert "| Ours (mean) |" in out
    assert "Relighting" not in out
    status, out, _ = bench("tables", *files, "--format", "json", "--variant", "masked-srgb-raw")
    made = json.loads(out)
    assert status == 0
    assert [table["name"] for table in made] == ["inverse", "relighting"]
    assert {row["label"] for row in made[0]["rows"]} >= {"Ours (mean) (a)", "Ours (mean) (b)", "Noise ceiling"}
    assert r"\begin{table*}" in bench("tables", files[0], "--format", "latex")[1]
    assert "Inverse rendering" in bench("tables", files[0])[1]


def test_a_table_may_have_some_rows_and_columns_alone(bench, files: tuple[Path, Path]) -> None:
    """What is left is ranked among itself; ours is no longer before."""
    asked = ("tables", files[0], "--variant", "masked-srgb-raw", "--format", "json")
    status, out, _ = bench(*asked, "--method", "input-as-albedo", "--metric", "mse")
    (made,) = json.loads(out)
    assert status == 0
    assert [row["label"] for row in made["rows"]] == ["input as albedo"]
    assert {column["metric"]["name"] for column in made["columns"]} == {"mse"}
    about = "One image in; maps out. Metallic, roughness and normal are always taken inside the mask."
    assert made["notes"][0] == about
    (made,) = json.loads(bench(*asked, "--table", "inverse", "--metric", "psnr")[1])
    assert made["notes"][0] == "One image in; maps out.", "of columns that are not there nothing is said"
    wrong = (
        (("--method", "Ours-Meen"), "did you mean ours-mean"),
        (("--metric", "PSNR"), "did you mean psnr"),
        (("--metric", "if_bgr"), "no column has that metric"),
    )
    for given, said in wrong:
        status, _, err = bench(*asked, *given)
        assert status == 2
        assert said in err
    status, _, err = bench(*asked, "--table", "relighting", "--metric", "cosine")
    assert status == 1
    assert "no values of relighting, cosine" in err
    status, out, err = bench(*asked, "--table", "inverse", "--method", "input-as-albedo", "--metric", "cosine")
    assert (status, out) == (1, "")  # the row is in the table, but has no value in the columns that are left
    assert "no values of inverse, input-as-albedo, cosine" in err


def test_a_row_that_two_files_do_not_agree_on_is_chosen_of_both_or_of_one(bench, files: tuple[Path, Path]) -> None:
    asked = ("tables", *files, "--variant", "masked-srgb-raw", "--table", "inverse", "--format", "json")
    for name, labels in (
        ("ours-mean", ["Ours (mean) (a)", "Ours (mean) (b)"]),
        ("ours-mean-from-b", ["Ours (mean) (b)"]),
        ("input-as-albedo", ["input as albedo"]),
    ):
        (made,) = json.loads(bench(*asked, "--method", name)[1])
        assert [row["label"] for row in made["rows"]] == labels


def test_a_row_whose_own_name_reads_like_a_merged_one_is_not_chosen_with_another() -> None:
    run = small_results().run
    keys = ("mine", "mine-from-scratch", "mine-from-b")
    run = replace(run, methods=tuple(replace(run.methods[0], key=key) for key in keys))
    kept, _ = rows_of(run, [], ["mine"], {"mine", "mine-from-scratch"})
    assert [info.key for info in kept.methods] == ["mine", "mine-from-b"]


def test_intervals_of_tables_may_be_over_lights_too(bench, files: tuple[Path, Path]) -> None:
    asked = ("tables", files[0], "--table", "relighting", "--format", "markdown")
    assert "interval: 95% over objects, under these lights: Student's t" in bench(*asked)[1]
    status, out, _ = bench(*asked, "--interval", "objects-and-lights")
    assert status == 0
    assert "interval: 95% over objects and lights, both as draws: two-way clusters, Student's t" in out
    assert "or under fewer than 5 lights, have no ±" in out
    unnamed = small_document()
    del unnamed["lights"]
    path = written(files[0].with_name("unnamed.json"), unnamed)
    status, out, err = bench("tables", path, "--interval", "objects-and-lights")
    assert (status, out) == (1, "")
    assert "samples are not named, and the very suite is not installed, which would tell them; leave it out" in err


def test_verdict_in_every_format(bench, files: tuple[Path, Path]) -> None:
    status, out, _ = bench("verdict", files[0])
    assert status == 0
    claim = "HOLDS  inverse/single-image albedo PSNR: ours-mean beats input-as-albedo, difference +8 [+8, +8] dB"
    assert f"{claim} (n 4, 3 objects); under other lights: not told by 4 lights" in out
    assert "open   truth: what its check found stands in the run's verdict.txt" in out
    made = json.loads(bench("verdict", files[0], "--format", "json")[1])
    found = next(
        c for c in made["claims"] if (c["quantity"], c["b"], c["scale"]) == ("albedo", "input-as-albedo", "raw")
    )
    assert found["other_lights"] == {"state": "not told", "lights": 4, "low": None, "high": None}
    assert (found["state"], found["difference"], found["objects"]) == ("holds", 8, 3)
    assert {c["state"] for c in made["claims"]} == {"holds", "not run"}
    said = (
        "| Inverse rendering, from the image: Albedo PSNR | Ours (mean) | input as albedo | +8 dB | holds [+8, +8] "
        "| not told | 4 (3, 4) |"
    )
    assert said in bench("verdict", files[0], "--format", "markdown")[1].replace("\N{NO-BREAK SPACE}", " ")
    latex = bench("verdict", files[0], "--format", "latex")[1]
    assert r"Albedo PSNR & Ours (mean) & input as albedo & +8 dB & holds [+8, +8] & not told & 4 (3, 4) \\" in latex
    assert r"\end{table*}" in latex


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--table", "invers"], 2, "--table invers: no such table; did you mean inverse?"),
        (["--variant", "mask"], 2, "--variant 'mask': got 'mask', expected one word per axis of masked"),
        (["--table", "physics"], 1, "the files have no values of physics"),
        (["nowhere.json"], 1, "nowhere.json: no such file"),
    ],
)
def test_what_tables_refuses(bench, files: tuple[Path, Path], words: list[str], status: int, said: str) -> None:
    found, out, err = bench("tables", files[0], *words)
    assert (found, out) == (status, "")
    assert said in err
    assert err.count("\n") == 1


def test_compare_prints_both_means_the_difference_and_the_ranks_in_80_columns(bench, files: tuple[Path, Path]) -> None:
    status, out, _ = bench("compare", *files, "--method", "ours-mean")
    assert status == 0
    assert "inverse/single-image: Ours (mean)" in out
    line, below = next(
        (a, b) for a, b in zip(out.splitlines(), out.splitlines()[1:], strict=False) if "Albedo PSNR" in a
    )
    assert [word for word in line.split() if "." in word] == ["20.75", "23.25", "-2.50"]
    assert "[-5.86, +0.86]" in below
    assert "A is not" in out  # told from B: of three objects little is decided
    assert "…" not in out
    assert max(map(len, out.splitlines()[3:])) <= 80
    status, out, _ = bench("compare", files[0], files[0], "--method", "ours-mean=input-as-albedo")
    assert "A: Ours (mean), B: input as albedo" in out
    assert "A beats B" in out


def test_compare_prints_what_is_asked_for_in_every_format(bench, files: tuple[Path, Path]) -> None:
    asked = ("compare", *files, "--method", "ours-mean", "--table", "inverse", "--metric", "psnr", "--format")
    status, out, _ = bench(*asked, "json")
    (number,) = (made := json.loads(out))["numbers"]
    assert (status, made["interval"]) == (0, "objects")
    assert (number["table"], number["metric"], number["difference"], number["n"]) == ("inverse", "psnr", -2.5, 4)
    assert number["verdict"] == "A is not told from B"
    line = "| Albedo PSNR (dB) ↑ | 20.75 (1 of 2) | 23.25 (1 of 2) | -2.50 [-5.86, +0.86] | 4 (3) |"
    assert line in bench(*asked, "markdown")[1].replace("\N{NO-BREAK SPACE}", " ")
    latex = bench(*asked, "latex")[1]
    assert r"Albedo PSNR (dB) $\uparrow$ & 20.75 (1 of 2) & 23.25 (1 of 2) & $-$2.50 [$-$5.86, +0.86] & 4 (3)" in latex
    assert "pdflatex has not" not in latex
    assert r"\begin{tabular}{lrrrrr}" in latex
    status, out, err = bench(*asked[:-3], "--metric", "cosine")
    assert (status, out) == (1, "")
    assert "the rows share no sample of any table that is asked for" in err
    status, _, err = bench(*asked[:-3], "--metric", "PSNR")
    assert status == 2
    assert "did you mean psnr" in err


def test_comparisons_may_count_lights_as_drawn() -> None:
    """The same means with the interval that tables print, and the verdict that follows from it."""
    ours = METHODS[0]
    objects = [f"o{i % 6}" for i in range(24)]
    lights = {f"s{i}": (f"l{i % 8}",) for i in range(24)}
    of_light = [4.0, 4.0, 4.0, 4.0, 4.0, -4.0, -4.0, -4.0]
    pair = [
        Record("inverse", "single-image", key, f"s{i}", objects[i], {KEY: 20 + (1 + of_light[i % 8]) * (key == "a")})
        for key in "ab"
        for i in range(24)
    ]
    a, b = (replace(ours, key=key, label=key) for key in "ab")
    results = replace(small_results(), run=replace(small_results().run, methods=(a, b)), records=tuple(pair))
    found = {}
    for name, asked in (("objects", None), ("lights", lights), ("few", dict.fromkeys(lights, ("one",)))):
        ((made,),) = (pair.columns for pair in compare_pair(results, results, a, b, DEFAULT_VARIANT, lights=asked))
        assert made.comparison is not None
        found[name] = made.comparison
    assert found["objects"].difference.mean == found["lights"].difference.mean == 2
    assert found["objects"].verdict == "beats"
    assert found["lights"].verdict == "is not told from"
    expected = over_lights({f"s{i}": 1 + of_light[i % 8] for i in range(24)}, pair, lights)
    assert found["lights"].difference.low == pytest.approx(expected.low, rel=1e-9)
    assert found["few"].verdict == "cannot be compared (so few lights) with"


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--method", "ours-men"], 1, "compare: A has no row 'ours-men'; did you mean ours-mean?"),
        (["--method", "ours-mean=mine"], 1, "compare: B has no row 'mine'; it has ours-mean, input-as-albedo"),
        (["--method", "=ours-mean"], 2, "--method =ours-mean: expected KEY, a row of both files, or KEY=KEY"),
        (["--method", "ours-mean="], 2, "--method ours-mean=: expected KEY"),
        (["--variant", "best"], 2, "--variant 'best': "),
        (["--method", "noise-ceiling", "--variant", "masked-linear-raw", "x"], 2, "x"),
    ],
)
def test_what_compare_refuses(bench, files: tuple[Path, Path], words: list[str], status: int, said: str) -> None:
    found, _, err = bench("compare", *files, *words)
    assert found == status
    assert said in err


def test_compare_says_why_two_results_cannot_be_compared(bench, files: tuple[Path, Path], tmp_path: Path) -> None:
    other = json.loads(json.dumps(small_document()).replace(HASH, "f" * 64))
    status, out, err = bench("compare", files[0], written(tmp_path / "c.json", other))
    assert (status, out) == (1, "")
    assert "cannot be compared: the suites' truth differs: 0123456789ab in " in err


def test_the_comparison_is_the_paired_one_on_shared_samples() -> None:
    a = small_results("a.json")
    b = small_results("b.json")
    b = replace(b, records=tuple(replace(r, values={k: v - 1 for k, v in r.values.items()}) for r in b.records[1:]))
    (pair,) = chosen_pairs(a.run, b.run, ["ours-mean"])
    albedo = next(iter(compare_pair(a, b, *pair, DEFAULT_VARIANT))).columns[0]
    values = [
        {r.sample: r.values[KEY] for r in file.records if r.method == "ours-mean" and KEY in r.values}
        for file in (a, b)
    ]
    objects = {r.sample: r.object for r in a.records}
    assert albedo.comparison is not None
    assert albedo.comparison.difference == paired_difference(values[0], values[1], objects)
    assert (albedo.only_a, albedo.only_b) == (1, 0)
    assert albedo.mean_a - albedo.mean_b == pytest.approx(1)
    assert (albedo.verdict, albedo.rank_a) == ("A beats B", Rank(1, 2))
    turned = next(iter(compare_pair(b, a, *pair, DEFAULT_VARIANT))).columns[0]
    assert (turned.mean_a, turned.mean_b, turned.only_a, turned.only_b) == (albedo.mean_b, albedo.mean_a, 0, 1)
    assert turned.verdict == "A is beaten by B"


def test_each_row_is_ranked_in_its_own_run_and_populations_are_compared_apart() -> None:
    a, b = small_results("a.json"), small_results("b.json")
    worse = {"ours-mean": 5.0}  # there
    b = replace(
        b, records=tuple(replace(r, values={KEY: worse.get(r.method, 10.0)}) for r in b.records if KEY in r.values)
    )
    b = replace(b, records=(*b.records, *(replace(r, subset="textured") for r in b.records)))
    (pair,) = chosen_pairs(a.run, b.run, ["input-as-albedo=ours-mean"])
    (found,) = compare_pair(a, b, *pair, DEFAULT_VARIANT)  # A has no textured objects
    assert (found.columns[0].rank_a, found.columns[0].rank_b) == (Rank(2, 2), Rank(2, 2))
    assert found.heading == "inverse/single-image"
    (pair,) = chosen_pairs(b.run, b.run, ["ours-mean"])
    headings = [found.heading for found in compare_pair(b, b, *pair, DEFAULT_VARIANT)]
    assert headings == ["inverse/single-image", "inverse/single-image (textured)"]


def test_ranks_are_on_rounded_means_of_rows_on_all_samples() -> None:
    results = small_results()
    records = [r for r in results.records if r.table == "inverse"]
    ranked = {key: rank(records, results.run, METRICS["psnr"], KEY, key) for key in ("ours-mean", "input-as-albedo")}
    assert ranked == {"ours-mean": Rank(1, 2), "input-as-albedo": Rank(2, 2)}
    assert rank(records, results.run, METRICS["psnr"], KEY, "noise-ceiling") is None
    assert rank(records[1:], results.run, METRICS["psnr"], KEY, "ours-mean") is None  # fewer samples than another row
    lone = [r for r in records if r.method == "noise-ceiling" or r.sample == records[0].sample]
    assert (
        rank(lone, results.run, METRICS["psnr"], KEY, "ours-mean") is None
    )  # as in the tables, where bounds count too
    close = [replace(r, values={KEY: 20 + 0.001 * (r.method == "ours-mean")}) for r in records]
    assert rank(close, results.run, METRICS["psnr"], KEY, "input-as-albedo") == Rank(1, 2)


def test_an_exact_fit_has_no_rank() -> None:
    results = small_results()
    key = KEY.replace("raw", "aligned")
    inf = {"input-as-albedo": math.inf}
    fits = [
        replace(r, values={k: inf.get(r.method, 20.0) for k in (key, KEY)}) for r in results.records if KEY in r.values
    ]
    ranked = [rank(fits, results.run, METRICS["psnr"], k, m) for k in (key, KEY) for m in ("ours-mean", *inf)]
    assert ranked == [Rank(1, 1), None, Rank(2, 2), Rank(1, 2)]


def test_identical_pictures_are_not_compared_and_rows_without_a_common_name_are_named() -> None:
    a = small_results()
    exact = replace(a, records=tuple(replace(r, values={KEY: math.inf}) for r in a.records if r.table == "inverse"))
    (pair,) = chosen_pairs(a.run, a.run, ["ours-mean"])
    found = next(iter(compare_pair(exact, exact, *pair, DEFAULT_VARIANT))).columns[0]
    assert (found.comparison, found.verdict) == (None, "not compared: an identical picture has an infinite PSNR")
    with pytest.raises(
        UnirenderError, match="no row of the same name; name two with --method KEY=KEY: A has ours-mean;"
    ):
        chosen_pairs(small_results("a", ("ours-mean",)).run, small_results("b", ("noise-ceiling",)).run, ())
