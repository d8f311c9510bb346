"""What the findings page shows follows from the records: means, paired differences, groups by material and object."""

from dataclasses import replace

import pytest
from small_results import METHODS, RUN, small_records, small_results

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import SCALES, Variant, metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.results.data import Results, definitions
from unirender_evaluation.results.findings import (
    NOT_RUN,
    Question,
    against_trivial,
    answers,
    by_material,
    by_object,
    by_scale,
    material_of,
    published_against_constant,
    run_line,
    seconds,
    together,
)
from unirender_evaluation.tables.published import published_tables

ALBEDO = ("albedo", "psnr")


def question(a: str, b: str) -> Question:
    return Question("albedo", "inverse", "single-image", "albedo", "psnr", a, b)


def lines(table: str) -> list[list[str]]:
    """The cells of a Markdown table's lines, without its head."""
    plain = table.replace("\N{NO-BREAK SPACE}", " ")
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in plain.splitlines()[2:]]


def with_materials(metallic: tuple[int, ...], values: tuple[float, ...]) -> Results:
    """One object, a sample for each material and one whose material has maps."""
    names = [f"cup_l0_m{m:03d}_r050" for m in metallic] + ["cup_l0_textured"]
    records = tuple(
        Record("inverse", "single-image", "ours-mean", name, "cup", {metric_key("albedo", "psnr"): value})
        for name, value in zip(names, values, strict=True)
    )
    return Results(RUN, records, definitions(records), "a.json")


def test_an_answer_is_both_means_over_shared_samples_and_the_paired_difference() -> None:
    found = lines(answers(small_results(), [question("ours-mean", "input-as-albedo")]))
    rows, means = ["Ours (mean)", "input as albedo"], ["20.75", "12.75"]
    assert found == [["albedo", *rows, *means, "+8.00 [+8.00, +8.00]", "**A is better**", "4 (2)"]]
    backwards = lines(answers(small_results(), [question("input-as-albedo", "ours-mean")]))
    assert backwards[0][5:7] == ["-8.00 [-8.00, -8.00]", "**B is better**"]


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
    found = lines(answers(both, [question("ours-mean@small", "ours-mean@tiny")]))
    rows = ["Ours (mean), small", "Ours (mean), tiny"]
    assert found == [["albedo", *rows, "20.75", "17.75", "+3.00 [+3.00, +3.00]", "**A is better**", "4 (2)"]]
    larger = replace(other, run=replace(other.run, resolution=2 * other.run.resolution))
    for wrong in ({}, {"small": one, "tiny": larger}):
        with pytest.raises(UnirenderError, match="expected the same one"):
            together(wrong)


def test_samples_that_only_one_row_has_do_not_count() -> None:
    records = tuple(r for r in small_records() if r.method == "ours-mean" or r.sample.endswith("l0"))
    found = lines(answers(Results(RUN, records, definitions(records), "a"), [question("ours-mean", "input-as-albedo")]))
    assert found[0][3:5] == ["20.50", "12.50"]
    assert found[0][-1] == "2 (2)"


def test_level_rows_and_single_objects_are_not_called_better() -> None:
    level = tuple(replace(r, method="other") for r in small_records() if r.method == "ours-mean")
    records = (*small_records(), *level)
    run = replace(RUN, methods=(*METHODS, replace(METHODS[0], key="other", label="Other", published=None)))
    found = lines(answers(Results(run, records, definitions(records), "a"), [question("ours-mean", "other")]))
    assert found[0][6] == "no difference shown"
    one = tuple(r for r in small_records() if r.object == "ball-0")
    found = lines(answers(Results(RUN, one, definitions(one), "a"), [question("ours-mean", "input-as-albedo")]))
    assert found[0][6] == "one object: no interval"


def test_a_row_that_did_not_run_says_so() -> None:
    found = lines(answers(small_results(), [question("ours-mean", "ours-dreamt")]))
    assert found[0][1:5] == ["Ours (mean)", "ours-dreamt", NOT_RUN, NOT_RUN]


def test_materials_are_read_from_the_names_and_maps_stand_apart() -> None:
    results = with_materials((0, 30, 50, 100), (10.0, 20.0, 30.0, 40.0, 99.0))
    assert [material_of(record) for record in results.records] == [(0, 0.5), (0.3, 0.5), (0.5, 0.5), (1, 0.5), None]
    found = {line[0]: line[1:] for line in lines(by_material(results, "ours-mean", [ALBEDO]))}
    assert found["all with one number each"] == ["4", "25.00"]
    assert found["metallic 0 to 0.3"] == ["2", "15.00"]
    assert found["metallic 0.4 to 0.6"] == ["1", "30.00"]
    assert found["metallic 0.7 to 1"] == ["1", "40.00"]
    assert found["roughness 0.4 to 0.6"] == ["4", "25.00"]
    assert found["roughness 0 to 0.3"] == ["0", "-"]
    assert found["with maps of their own"] == ["1", "99.00"]


@pytest.mark.parametrize(("number", "worst"), [(ALBEDO, "ball-0"), (("roughness", "mse"), "ball-0")])
def test_the_worst_object_is_the_one_with_the_worst_mean(number: tuple[str, str], worst: str) -> None:
    found = lines(by_object(small_results(), "ours-mean", [number], 1))
    assert [line[0] for line in found] == [worst]
    assert len(lines(by_object(small_results(), "ours-mean", [number], 9))) == 2


def test_alignments_stand_side_by_side_over_the_pictures_of_all_rows() -> None:
    """A row on a part of the suite is not put beside the mean over all of it: easy pictures would look like skill."""

    def record(method: str, sample: str, first: float) -> Record:
        keys = [metric_key("albedo", "psnr", Variant("masked", "srgb", scale)) for scale in SCALES]
        values = {key: first + 10.0 * i for i, key in enumerate(keys)}
        return Record("inverse", "single-image", method, sample, sample, values)

    records = (record("ours-mean", "a", 0), record("ours-mean", "b", 50), record("input-as-albedo", "a", 1))
    rows = ["ours-mean", "input-as-albedo", "noise-ceiling"]
    found = lines(by_scale(Results(RUN, records, definitions(records), "a"), rows))
    assert found == [
        ["Ours (mean)", "0.00", "10.00", "20.00", "1"],
        ["input as albedo", "1.00", "11.00", "21.00", "1"],
        ["Noise ceiling", *[NOT_RUN] * 3, "0"],
    ]


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
    assert line.startswith("`ball`: 2 objects at 32 x 32 pixels, 20 answers; truth `0123456789ab`")
