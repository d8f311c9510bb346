"""What the findings page shows follows from the records: means, paired differences, and what of them is sure."""

from dataclasses import replace

import pytest
from small_results import METHODS, RUN, small_records, small_results

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.pages.findings import (
    NOT_RUN,
    Question,
    against_trivial,
    answers,
    published_against_constant,
    run_line,
    seconds,
    sure_of,
    together,
)
from unirender_evaluation.records import Record
from unirender_evaluation.results.data import Results, definitions
from unirender_evaluation.tables.published import published_tables


def question(a: str, b: str) -> Question:
    return Question("albedo", "inverse", "single-image", "albedo", "psnr", a, b)


def lines(table: str) -> list[list[str]]:
    """The cells of a Markdown table's lines, without its head."""
    plain = table.replace("\N{NO-BREAK SPACE}", " ")
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in plain.splitlines()[2:]]


def test_an_answer_is_both_means_over_shared_samples_and_the_paired_difference() -> None:
    asked = question("ours-mean", "input-as-albedo")
    found = lines(answers(small_results(), [asked], {asked}))
    rows, means = ["Ours (mean)", "input as albedo"], ["20.75", "12.75"]
    assert found == [["albedo", *rows, *means, "+8.00 [+8.00, +8.00]", "**A is better**", "3 of 3 (4)"]]
    backwards = lines(answers(small_results(), [question("input-as-albedo", "ours-mean")], ()))
    assert backwards[0][5:] == ["-8.00 [-8.00, -8.00]", "B is better", "0 of 3 (4)"]


def test_objects_are_counted_by_their_means_and_less_of_an_error_is_better() -> None:
    """Of ball-0 one picture of two is better, by less than the other is worse."""
    key, changes = (
        metric_key("albedo", "psnr"),
        {"ball-0_l0": 1.0, "ball-0_l1": -9.0, "ball-1_l0": 1.0, "ball-2_l0": 1.0},
    )
    one = small_results()
    changed = [
        replace(r, method="other", values={key: r.values[key] + changes[r.sample], metric_key("roughness", "mse"): 9.0})
        for r in one.records
        if r.method == "ours-mean" and r.table == "inverse"
    ]
    both = replace(one, records=(*one.records, *changed))
    rough = Question("roughness", "inverse", "single-image", "roughness", "mse", "ours-mean", "other")
    found = lines(answers(both, [question("other", "ours-mean"), rough], ()))
    assert [line[-1] for line in found] == ["2 of 3 (4)", "3 of 3 (4)"]


def test_what_is_sure_is_so_for_all_lines_together() -> None:
    """p of `near` is 0.022: below 0.05 / 2, above 0.05 / 3. A line that did not run counts for nothing."""
    key = metric_key("albedo", "psnr")
    base = [r for r in small_records() if r.method == "ours-mean" and r.table == "inverse" and r.sample.endswith("l0")]

    def row(method: str, gains: tuple[float, ...]) -> list[Record]:
        found = [replace(base[0], method=method, values={key: gain}) for gain in gains]
        return [replace(record, sample=f"ball-{i}", object=f"ball-{i}") for i, record in enumerate(found)]

    level = (0.0,) * 4
    records = (*row("ours-mean", level), *row("near", (-1.0, -2.0, -3.4, -2.4)), *row("far", (-8.0, -8.1, -8.2, -8.1)))
    results = Results(RUN, records, definitions(records), "a")
    near, far, none = (question("ours-mean", name) for name in ("near", "far", "dreamt"))
    assert sure_of([(results, near), (results, none)]) == {near}
    assert sure_of([(results, near), (results, far)]) == {near, far}
    assert sure_of([(results, replace(near, text=text)) for text in "abc"]) == set()


def test_our_row_stands_against_the_best_trivial_one_and_what_is_possible() -> None:
    one = small_results()
    worse = [replace(r, method="mean-albedo", values={metric_key("albedo", "psnr"): 9.0}) for r in small_records()]
    worse = [r for r in worse if r.table == "inverse"][:4]
    run = replace(RUN, methods=(replace(METHODS[1], key="mean-albedo", label="mean albedo"), *METHODS))
    asked = [
        Question("albedo", "inverse", "single-image", "albedo", "psnr", "ours-mean"),
        Question("roughness", "inverse", "single-image", "roughness", "mse", "ours-mean"),
        Question("relit", "relighting", "from-image-hdri", "relit", "psnr", "ours-mean"),
        Question("normals", "inverse", "single-image", "normal", "cosine", "ours-mean"),  # nobody's
    ]
    both = replace(one, run=run, records=(*one.records, *worse))
    shown = lines(against_trivial(both, asked))
    assert shown[0] == ["albedo, PSNR (dB) ↑", "20.75", "12.75 (input as albedo)", "+8.00 [+8.00, +8.00]", "46.75"]
    assert shown[1][:3] == ["roughness, MSE ↓", "0.0482", "0.0786 (input as albedo)"]
    assert shown[2][0::4] == ["relit, PSNR (dB) ↑", "∞"]
    assert len(shown) == 3
    with pytest.raises(UnirenderError, match="run both"):
        against_trivial(small_results(methods=("ours-mean",)), asked)


def test_rows_of_two_runs_of_a_suite_are_paired_by_sample() -> None:
    one = small_results()
    key = metric_key("albedo", "psnr")
    lower = [r for r in one.records if r.method == "ours-mean" and key in r.values]
    lower = [replace(r, values={key: r.values[key] - 3}) for r in lower]
    other = replace(one, records=tuple(lower))
    both = together({"small": one, "tiny": other})
    found = lines(answers(both, [question("ours-mean@small", "ours-mean@tiny")], ()))
    rows = ["Ours (mean), small", "Ours (mean), tiny"]
    assert found == [["albedo", *rows, "20.75", "17.75", "+3.00 [+3.00, +3.00]", "A is better", "3 of 3 (4)"]]
    larger = replace(other, run=replace(other.run, resolution=2 * other.run.resolution))
    for wrong in ({}, {"small": one, "tiny": larger}):
        with pytest.raises(UnirenderError, match="expected the same one"):
            together(wrong)


def test_samples_that_only_one_row_has_do_not_count() -> None:
    records = tuple(r for r in small_records() if r.method == "ours-mean" or r.sample.endswith("l0"))
    results = Results(RUN, records, definitions(records), "a")
    found = lines(answers(results, [question("ours-mean", "input-as-albedo")], ()))
    assert found[0][3:5] == ["20.83", "12.83"]
    assert found[0][-1] == "3 of 3 (3)"


def test_level_rows_and_single_objects_are_not_called_better() -> None:
    level = tuple(replace(r, method="other") for r in small_records() if r.method == "ours-mean")
    records = (*small_records(), *level)
    run = replace(RUN, methods=(*METHODS, replace(METHODS[0], key="other", label="Other", published=None)))
    found = lines(answers(Results(run, records, definitions(records), "a"), [question("ours-mean", "other")], ()))
    assert found[0][6] == "no difference shown"
    one = tuple(r for r in small_records() if r.object == "ball-0")
    found = lines(answers(Results(RUN, one, definitions(one), "a"), [question("ours-mean", "input-as-albedo")], ()))
    assert found[0][5:7] == ["+8.00", "fewer than 3 objects: no interval"]


def test_a_row_that_did_not_run_says_so() -> None:
    found = lines(answers(small_results(), [question("ours-mean", "ours-dreamt")], ()))
    assert found[0][1:5] == ["Ours (mean)", "ours-dreamt", NOT_RUN, NOT_RUN]


def test_published_errors_stand_beside_measured_ones() -> None:
    found = lines(published_against_constant(small_results()))
    paper = next(row for row in published_tables()["inverse"] if row.name == "Ours").values
    assert ["Uni-Renderer (*published*)", f"{paper['metallic.mse']:.4f}", f"{paper['roughness.mse']:.4f}"] in found
    assert found[-1] == ["Ours (mean) (measured here)", NOT_RUN, "0.0482"]
    assert found[-2][1:] == [NOT_RUN, NOT_RUN]


def test_seconds_are_the_median_of_what_was_recorded() -> None:
    records = tuple(
        replace(r, seconds=float(i)) for i, r in enumerate(r for r in small_records() if r.method == "ours-mean")
    )
    results = Results(RUN, records, definitions(records), "a")
    rows = [("inverse", "single-image", "ours-mean"), ("inverse", "single-image", "noise-ceiling")]
    assert lines(seconds(results, rows)) == [
        ["Ours (mean)", "inverse, single-image", "3.00", "4"],
        ["Noise ceiling", "inverse, single-image", NOT_RUN, "0"],
    ]


def test_the_run_is_named() -> None:
    line = run_line(small_results())
    assert line.startswith("`ball`: 3 objects at 32 x 32 pixels, 20 answers; truth `0123456789ab`")
