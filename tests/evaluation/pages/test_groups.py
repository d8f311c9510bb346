"""Parts of a suite beside one another: by material, by object, by alignment, by kind of object."""

import math

import numpy as np
import pytest
import scipy.stats
from small_results import RUN, small_results

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import SCALES, Variant, metric_key
from unirender_evaluation.pages.findings import NOT_RUN, Question
from unirender_evaluation.pages.groups import by_kind, by_material, by_object, by_scale, contrast, material_of
from unirender_evaluation.records import Record
from unirender_evaluation.results.data import Results, definitions

ALBEDO = ("albedo", "psnr")


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
    assert found["metallic: 0.7 to 1 less 0 to 0.3"] == ["3", "+25.00"]
    assert found["roughness: 0.7 to 1 less 0 to 0.3"] == ["0", "-"]


@pytest.mark.parametrize(("number", "worst"), [(ALBEDO, "ball-0"), (("roughness", "mse"), "ball-0")])
def test_the_worst_object_is_the_one_with_the_worst_mean(number: tuple[str, str], worst: str) -> None:
    found = lines(by_object(small_results(), "ours-mean", [number], 1))
    assert [line[0] for line in found] == [worst]
    assert len(lines(by_object(small_results(), "ours-mean", [number], 9))) == 3


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


def test_of_a_part_for_each_half_of_the_objects_the_contrast_is_that_of_two_independent_means() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(3, 1, 12), rng.normal(1, 2, 12)
    found = contrast(list(a), list(b), range(12), range(12, 24))
    half = scipy.stats.t.ppf(0.975, 11) * math.sqrt(a.var(ddof=1) / 12 + b.var(ddof=1) / 12)
    assert (found.mean, found.half_width) == (pytest.approx(a.mean() - b.mean()), pytest.approx(half))
    assert (found.n, found.clusters) == (24, 24)


def test_of_objects_that_have_samples_in_both_parts_it_is_the_paired_one() -> None:
    """What an object adds to both of its samples is in no difference; taken as independent, it would be."""
    rng = np.random.default_rng(1)
    own, noise = rng.normal(0, 10, 12), rng.normal(0, 0.1, 12)
    found = contrast(list(own + 1 + noise), list(own), range(12), range(12))
    low, high = scipy.stats.ttest_1samp(1 + noise, 0).confidence_interval()
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))
    assert contrast(list(own + 1 + noise), list(own), range(12), range(12, 24)).half_width > 20 * found.half_width


def test_a_part_of_one_object_has_no_contrast_and_an_empty_one_is_refused() -> None:
    assert math.isnan(contrast([1.0, 2.0], [3.0, 4.0], "xx", "yz").low)
    for wrong in ([], [math.inf, 1.0], [1.0]):
        with pytest.raises(UnirenderError, match="expected as many"):
            contrast(wrong, [3.0, 4.0], "xx", "yz")


def test_gains_on_two_kinds_of_objects_and_their_difference() -> None:
    records = tuple(
        Record("inverse", "single-image", method, name, name, {metric_key("albedo", "psnr"): level + gain * (i < 3)})
        for method, level, gain in (("ours-mean", 20.0, 5.0), ("input-as-albedo", 12.0, 0.0))
        for i, name in enumerate("abcdef")
    )
    results = Results(RUN, records, definitions(records), "a")
    asked = [Question("albedo", "inverse", "single-image", *ALBEDO, "ours-mean", "input-as-albedo")]
    kinds = {name: "round" if name < "d" else "flat" for name in "abcdef"}
    found = lines(by_kind(results, asked, kinds))
    own = ["25.00", "+13.00 [+13.00, +13.00]", "20.00", "+8.00 [+8.00, +8.00]"]
    assert found == [["albedo", "Ours (mean)", "input as albedo", *own, "**+5.00 [+5.00, +5.00]**"]]
    with pytest.raises(UnirenderError, match="expected two"):
        by_kind(results, asked, dict.fromkeys("abcdef", "round"))
