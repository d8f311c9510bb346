"""Merging: halves of a run give the whole run's tables, rivals keep apart, and what cannot be compared is refused."""

import re
from dataclasses import replace

import pytest
from small_results import METHODS, small_results

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import OWN_MASK, metric_key
from unirender_evaluation.results.data import Results
from unirender_evaluation.results.merge import check_comparable, differences, merge, obstacles
from unirender_evaluation.tables.build import Table, build_tables
from unirender_evaluation.tables.formats import to_markdown
from unirender_evaluation.tables.protocol import doubts


def tables(*files: Results) -> list[Table]:
    run, records = merge(files)
    return build_tables(records, run)


def without_origin(made: list[Table]) -> list[str]:
    """The tables' text with the rows and notes as if they had been measured in one run."""
    texts = []
    for table in made:
        rows = tuple(replace(row, stored=None) for row in table.rows)
        notes = tuple(note for note in table.notes if "stored, not measured" not in note)
        texts.append(to_markdown(replace(table, rows=rows, notes=notes)))
    return texts


def changed(results: Results, by: float, source: str) -> Results:
    """The same run, with other values of its first row, as a rival would have them."""
    records = tuple(
        replace(r, values={k: v + by for k, v in r.values.items()}) if r.method == "ours-mean" else r
        for r in results.records
    )
    return replace(results, records=records, source=source)


def test_one_file_is_as_it_was() -> None:
    results = small_results()
    assert merge([results]) == (results.run, list(results.records))
    assert "(stored)" not in to_markdown(tables(results)[0])


def test_halves_by_row_and_halves_by_sample_give_the_whole_runs_tables() -> None:
    whole = without_origin(tables(small_results()))
    rows = [small_results("a.json", ("ours-mean",)), small_results("b.json", ("input-as-albedo", "noise-ceiling"))]
    assert without_origin(tables(*rows)) == whole
    full = small_results()
    samples = [
        replace(full, source=f"{name}.json", records=tuple(r for r in full.records if r.object == name))
        for name in ("ball-0", "ball-1", "ball-2")
    ]
    assert without_origin(tables(*samples)) == whole
    assert without_origin(tables(samples[0])) != whole
    assert without_origin(tables(full, replace(full, source="copy.json"))) == whole  # nothing counts twice


def test_a_merged_row_says_where_it_is_from() -> None:
    text = to_markdown(tables(small_results("mine.json"), small_results("theirs.json", ("ours-mean",)))[1])
    assert "| Ours (mean) (stored) |" in text
    origin = "mine, 2026-01-31, suite 0123456789ab, code abc"
    assert f"Ours (mean); input as albedo; Noise ceiling: stored, not measured in this run ({origin})" in text


@pytest.mark.parametrize("by", [0.01, 3.0])
def test_rivals_of_one_name_stand_side_by_side(by: float) -> None:
    mine, theirs = small_results("mine.json"), changed(small_results(), by, "theirs.json")
    run, records = merge([mine, theirs])
    assert [info.key for info in run.methods] == [*(info.key for info in METHODS), "ours-mean-from-theirs"]
    labels = [info.label for info in run.methods]
    assert (labels[0], labels[3]) == ("Ours (mean) (mine)", "Ours (mean) (theirs)")
    counts = {info.key: sum(r.method == info.key for r in records) for info in run.methods}
    assert counts == {"ours-mean": 8, "input-as-albedo": 8, "noise-ceiling": 4, "ours-mean-from-theirs": 8}
    rows = [row for row in tables(mine, theirs)[1].rows if row.label.startswith("Ours")]
    means = [row.cells[0].measured.mean for row in rows if row.cells[0].measured]
    assert means[1] - means[0] == pytest.approx(by)
    assert [row.cells[0].measured_rank for row in rows] == [2, 1]


def noted(note: str, objects: tuple[str, ...], source: str) -> Results:
    """A file whose first row has this note, and records of these objects alone."""
    full = small_results(source)
    infos = (replace(METHODS[0], note=note), *METHODS[1:])
    records = tuple(r for r in full.records if r.method != "ours-mean" or r.object in objects)
    return replace(full, run=replace(full.run, methods=infos), records=records)


EVERY = ("ball-0", "ball-1", "ball-2")


@pytest.mark.parametrize(
    ("first", "second", "note"),
    [
        (("fast; 1 scenes only", EVERY[:1]), ("fast; 4 scenes only", EVERY), "fast; 4 scenes only"),
        (("fast; 4 scenes only", EVERY), ("fast; 1 scene only", EVERY[:1]), "fast; 4 scenes only"),
        (("fast; 1 scene only", EVERY[:1]), ("fast", EVERY), "fast"),
        (("fast; 2 scenes only", EVERY[:1]), ("fast; 3 scenes only", EVERY[1:]), "fast"),
        (("1 scene only", EVERY[:1]), ("1 scene only", EVERY[1:]), ""),
        (("fast; 1 scene only", EVERY[:1]), ("", ()), "fast; 1 scene only"),
    ],
)
def test_a_row_from_two_files_says_no_count_of_one_of_them(
    first: tuple[str, tuple[str, ...]], second: tuple[str, tuple[str, ...]], note: str
) -> None:
    run, _ = merge([noted(*first, "a.json"), noted(*second, "b.json")])
    assert run.method("ours-mean").note == note


def test_what_both_files_say_of_each_scenes_pictures_stays() -> None:
    said = "inverse: 2 pictures of each scene only"
    halves = [noted(f"3 scenes only; {said}", (name,), f"{name}.json") for name in EVERY]
    assert merge(halves)[0].method("ours-mean").note == said
    assert merge([*halves, noted("", (), "c.json")])[0].method("ours-mean").note == said  # c.json has no record of it
    other = noted(f"3 scenes only; {said.replace('2', '1')}", EVERY[1:], "b.json")
    assert merge([halves[0], other])[0].method("ours-mean").note == ""


def test_doubts_are_counted_over_all_files() -> None:
    """A file's note counts its own pictures alone."""

    def half(name: str, missed: int) -> Results:
        file = noted("", (name,), f"{name}.json")
        records, masks = [], iter([0.0] * missed + [1.0] * 9)
        for r in file.records:
            asked = (r.method, r.table) == ("ours-mean", "inverse")
            records.append(replace(r, values={**r.values, OWN_MASK: next(masks)}) if asked else r)
        infos = (replace(METHODS[0], note="; ".join(["fast", *doubts("ours-mean", records)])), *METHODS[1:])
        return replace(file, run=replace(file.run, methods=infos), records=tuple(records))

    one, two = half("ball-0", 2), half("ball-1", 1)
    counts = [sum(OWN_MASK in r.values for r in file.records) for file in (one, two)]
    said = "fast; its own mask misses the object on {} of {} pictures (is it 0?)"
    assert one.run.method("ours-mean").note == said.format(2, counts[0])
    assert merge([one, two])[0].method("ours-mean").note == said.format(3, sum(counts))
    infos = (replace(two.run.methods[0], config={"checkpoint": "b"}), *two.run.methods[1:])
    rivals, _ = merge([one, replace(two, run=replace(two.run, methods=infos))])
    for key, missed, count in (("ours-mean", 2, counts[0]), ("ours-mean-from-ball-1", 1, counts[1])):
        assert rivals.method(key).note == said.format(missed, count)


def test_a_value_that_only_one_file_has_is_kept() -> None:
    """One run had the weights of LPIPS, the other had not: merged either way, the number is there."""
    lpips = metric_key("albedo", "lpips_alex")
    plain = small_results("plain.json")
    more = tuple(replace(r, values={**r.values, lpips: 0.25}) if r.table == "inverse" else r for r in plain.records)
    rich = changed(replace(plain, records=more, run=replace(plain.run, lpips=("alex",))), 1e-7, "rich.json")
    for first, second in ((plain, rich), (rich, plain)):
        run, records = merge([first, second])
        assert [info.key for info in run.methods] == [info.key for info in METHODS]
        assert all(lpips in r.values for r in records if r.table == "inverse")
        first_values = {(r.table, r.method, r.sample): r.values for r in first.records}
        assert all(r.values.items() >= first_values[r.table, r.method, r.sample].items() for r in records)


def test_another_configuration_is_another_row_and_another_cpus_rounding_is_not() -> None:
    mine, theirs = small_results("mine.json"), changed(small_results(), 1e-7, "theirs.json")
    assert len(merge([mine, theirs])[0].methods) == 3
    infos = (replace(METHODS[0], config={"checkpoint": "b"}), *METHODS[1:])
    other = replace(theirs, run=replace(theirs.run, methods=infos))
    assert len(merge([mine, other])[0].methods) == 4


def test_files_of_one_name_are_told_apart_by_their_paths() -> None:
    a, b = small_results("x/out.json"), changed(small_results(), 1.0, "y/out.json")
    labels = [info.label for info in merge([a, b])[0].methods]
    assert "Ours (mean) (x/out.json)" in labels
    assert "Ours (mean) (y/out.json)" in labels


def test_every_row_has_a_key_of_its_own() -> None:
    """Also where the names of two files differ in what a key has not."""
    sources = ("z.json", "x/a.json", "x-a.json", "a.json")
    run, records = merge([changed(small_results(), i, source) for i, source in enumerate(sources)])
    keys = [info.key for info in run.methods if info.key.startswith("ours-mean")]
    assert len(set(keys)) == len(keys) == len(sources)
    assert {sum(r.method == key for r in records) for key in keys} == {8}


def test_merged_records_are_a_runs_own_in_its_order() -> None:
    """Two populations of a sample are two records. (The draws of intervals follow the order.)"""
    full = small_results("b.json")
    more = (*full.records, replace(full.records[0], subset="textured"))
    _, records = merge([small_results("a.json", ("noise-ceiling",)), replace(full, records=more)])
    assert records == sorted(more, key=lambda r: (r.table, r.protocol, r.method, r.sample))


def test_a_stored_row_keeps_where_it_is_from() -> None:
    once, records = merge([small_results("a.json", ("ours-mean",)), small_results("b.json", ("noise-ceiling",))])
    again, _ = merge([replace(small_results("ab.json"), run=once, records=tuple(records)), small_results("c.json")])
    assert again.method("ours-mean").stored == once.method("ours-mean").stored
    assert (again.method("input-as-albedo").stored or "").startswith("c, ")


def test_a_partial_run_watermarks_all() -> None:
    made = tables(small_results("a.json", ("ours-mean",)), small_results("b.json", ("input-as-albedo",), limit=2))
    assert all(table.watermark == "--limit 2: a partial run, not a result" for table in made)


def test_the_protocol_line_has_what_both_say() -> None:
    other = small_results("b.json", ("input-as-albedo",), code="def", date="2026-02-01", seeds=(3, 0), lpips=("alex",))
    run, _ = merge([small_results("a.json", ("ours-mean",)), other])
    found = (run.code, run.date, run.seeds, run.lpips, run.limit)
    assert found == ("abc and def", "2026-01-31 and 2026-02-01", (0, 3), ("alex",), None)


def test_of_partial_runs_the_widest_describes_the_scenes_and_the_smallest_is_the_mark() -> None:
    """What is not so of all runs is not said of them together."""
    said = ((3, 0.1, "1", ""), (None, 0.3, "2", "old"), (2, 0.2, "1", ""))
    runs = [
        small_results(
            f"{i}.json", limit=limit, coverage=share, environment={"cpu": "x", "mitsuba": version}, carried=old
        )
        for i, (limit, share, version, old) in enumerate(said)
    ]
    run, _ = merge(runs)
    assert (run.limit, run.coverage, run.environment, run.carried) == (2, 0.3, {"cpu": "x"}, "old")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"suite_hash": "f" * 64}, "the suites' truth differs: 0123456789ab in a.json, ffffffffffff in b.json"),
        ({"resolution": 64}, "the suites' resolution differs: 32 in a.json, 64 in b.json"),
        ({"mitsuba": "3.8.0"}, "the Mitsuba that rendered the truth differs: 3.9.1 in a.json, 3.8.0 in b.json"),
        ({"exposure": "per image"}, "the exposure differs"),
    ],
)
def test_what_cannot_be_compared_is_refused_with_the_reason(changes: dict, said: str) -> None:
    a, b = small_results(), small_results("b.json")
    assert obstacles(a, b) == differences(a, b) == []
    with pytest.raises(UnirenderError, match=re.escape(said)):
        merge([a, small_results("b.json", **changes)])


def test_other_definitions_and_other_code() -> None:
    a, b = small_results(), small_results("b.json", code="def", limit=1, environment={"mitsuba": "3.9.2"})
    protocols = {**b.definitions.protocols, "single-image": "two images"}
    other = replace(b, definitions=replace(b.definitions, protocols=protocols))
    assert obstacles(a, other) == ["the protocol 'single-image' is defined otherwise in the two files"]
    metrics = {**b.definitions.metrics, "psnr": b.definitions.metrics["mse"]}
    other = replace(b, definitions=replace(b.definitions, metrics=metrics))
    assert obstacles(a, other) == ["the metric 'psnr' is defined otherwise in the two files"]
    assert obstacles(a, b) == []
    assert differences(a, b) == [
        "code: abc in a.json, def in b.json",
        "scenes: all in a.json, --limit 1 in b.json",
        "Mitsuba of the run: - in a.json, 3.9.2 in b.json",
    ]


def test_nothing_and_the_same_file_twice_are_refused() -> None:
    with pytest.raises(UnirenderError, match="got no results"):
        merge([])
    files = [small_results(name) for name in ("a.json", "b.json", "c.json")]
    for twice in (0, 1):
        with pytest.raises(UnirenderError, match=rf"{'ab'[twice]}\.json: given twice"):
            check_comparable([*files, files[twice]])
    with pytest.raises(UnirenderError, match=r"a\.json and d\.json cannot be compared"):
        check_comparable([*files, small_results("d.json", resolution=64)])
