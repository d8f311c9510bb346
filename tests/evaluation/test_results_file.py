"""Results files: round trip, what they are mistaken for, and every contradiction that a reader must hear of."""

import gzip
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from small_results import RUN, small_document, small_lights, small_records, small_results, written

from unirender.errors import UnirenderError
from unirender_evaluation.methods.mistakes import GAINS
from unirender_evaluation.records import write_records, write_run
from unirender_evaluation.results.check import content_problems, remarks
from unirender_evaluation.results.data import Results, definitions
from unirender_evaluation.results.file import from_document, read_results, write_results
from unirender_evaluation.results.lights import sample_lights
from unirender_evaluation.suites.suite import Scene, load_suite, material_key
from unirender_evaluation.table_list import ALL_METRICS, ALL_TABLES

PSNR = "albedo.psnr@masked-srgb-raw"


def test_every_metric_says_which_way_is_better() -> None:
    """Ranks, intervals and verdicts follow it: of what the light and the physics are measured by, as well."""
    higher = {name for name, metric in ALL_METRICS.items() if metric.higher_is_better}
    assert higher == {"psnr", "ssim", "cosine", "iou", "correlation"}
    assert {metric.perfect for name, metric in ALL_METRICS.items() if name not in {*higher, *GAINS, "bias"}} == {0}


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "run" / "results.json"
    path.parent.mkdir()
    records = small_records()
    records[0] = replace(records[0], values={PSNR: float("inf")}, seconds=0.25)
    write_results(path, RUN, records, {**small_lights(), "another": ("y",)})
    found = read_results(path)
    assert (found.run, list(found.records), found.lights) == (RUN, records, small_lights())
    assert found.label == "run"
    assert read_results(str(path)) == found
    assert read_results(path.parent) == replace(found, source=str(path.parent))
    assert found.definitions.metrics["psnr"]["higher_is_better"] is True
    assert found.definitions.protocols["single-image"] == "one image and its mask"
    lines = path.read_text().splitlines()
    assert sum('"sample"' in line for line in lines) == len(records)  # one a line
    assert '  "ball-0_l0_to_x": ["ball-0_l0", "x"],' in lines
    assert "Infinity" not in path.read_text()


def test_a_packed_file_is_the_same_results_in_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.json", "a.json.gz", "b/results.json.gz", "c/results.json.gz"):
        write_results(tmp_path / name, RUN, small_records())
    assert gzip.decompress((tmp_path / "a.json.gz").read_bytes()) == (tmp_path / "a.json").read_bytes()
    assert (tmp_path / "b/results.json.gz").read_bytes() == (tmp_path / "c/results.json.gz").read_bytes()
    assert read_results(tmp_path / "a.json.gz").records == read_results(tmp_path / "a.json").records
    labels = [read_results(tmp_path / name).label for name in ("a.json.gz", "b/results.json.gz", "c")]
    assert labels == ["a", "b", "c"]


def test_the_folder_of_a_run_needs_no_file_of_results(tmp_path: Path) -> None:
    write_run(tmp_path / "run.json", RUN)
    write_records(tmp_path / "records.jsonl", small_records())
    assert list(read_results(tmp_path).records) == small_records()


def test_a_file_that_names_no_lights_is_read_and_a_reader_told() -> None:
    older = small_document()
    del older["lights"]
    found = from_document(older, "a.json")
    assert found.lights == {}
    assert remarks(found) == [
        "the lights of its samples are not named: those of the suite count, where the very suite is installed"
    ]


def test_nothing_invalid_is_written(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="no row 'ours-mean'"):
        write_results(tmp_path / "results.json", replace(RUN, methods=RUN.methods[1:]), small_records())
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("missing.json", None, "no such file, expected the results.json that"),
        ("tables.json", b"[]", "has the tables' means, from which no interval and no paired test can be made"),
        ("records.jsonl", b"{}\n", "has the values without the run's description; expected results.json or the folder"),
        ("run.json", b"{}", "describes a run without its values"),
        ("a.json", b"", r"is no JSON: .* \(the file ends too early: was it copied whole\?\)"),
        ("a.json", b'{"format": "unirender-results", "schema"', "the file ends too early"),
        ("a.json", b"suite,psnr\ntiny,20\n", "is no JSON: Expecting value"),
        ("a.json", b"\x1f\x8b\x08\x00\xff", "is no text in UTF-8, expected JSON, or JSON packed by gzip in a file"),
        ("a.json.gz", b"\x1f\x8b\x08\x00\xff", "cannot be unpacked"),
        ("b.json.gz", b"{}", "cannot be unpacked"),
        ("a.json", b'{"format": NaN}', "has the number NaN, which JSON does not know"),
        ("a.json", b'{"format": 1, "format": 2}', "an object has the field 'format' twice"),
        ("a.json", b"[" * 100_000, "nested too deeply"),
        ("a.json", b"9" * 5000, "a.json: holds a number that cannot be read"),
        ("a.json", b"[1]", "format: got a list, expected 'unirender-results': is this the results.json of"),
        ("a.json", b'{"runs": []}', "format: got None"),
        (
            "a.json",
            b'{"format": "unirender-results", "schema": 99}',
            "schema: got version 99, expected 1: read it with",
        ),
    ],
)
def test_what_is_not_a_results_file_is_called_what_it_is(
    name: str, content: bytes | None, said: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UnirenderError, match=said):
        read_results(tmp_path / name)


def test_a_folder_without_a_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=r"has no results\.json and no run\.json"):
        read_results(tmp_path)


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(small_document()).encode())
    assert read_results(tmp_path / "a.json").run == RUN


def record(index: int, **fields: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["records"][index].update(fields)


def run_field(**fields: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["run"].update(fields)


def values(numbers: dict[str, float]) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["records"][0]["values"].update(numbers)


def value(key: str, number: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["records"][0]["values"].update({key: number})


def definition(kind: str, name: str, what: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["definitions"][kind].update({name: what})


CONTRADICTIONS = {
    "row": (record(0, method="ours-men"), r"records\[0\].method: no row 'ours-men'; did you mean ours-mean\?"),
    "table": (record(0, table="invers"), r"records\[0\].table: no table 'invers'; did you mean inverse\?"),
    "protocol": (record(0, protocol="given"), "table 'inverse' has no protocol 'given'; expected one of single-image"),
    "no value": (record(0, values={}), r"records\[0\].values: is empty"),
    "metric": (value("albedo.psnrr@masked-srgb-raw", 1), "no metric 'psnrr'; did you mean psnr"),
    "no variant": (value("albedo.psnr", 1), r"got the key 'albedo.psnr', expected albedo.psnr@\(masked\|whole\)-"),
    "too many": (value("normal.cosine@masked", 1), "expected normal.cosine without a variant"),
    "order": (value("albedo.psnr@srgb-masked-raw", 1), "expected albedo.psnr@"),
    "backbone": (value("albedo.lpips_vgg@masked-raw", 0.1), "LPIPS-vgg, but `run.lpips` does not list 'vgg'"),
    "above": (value("normal.cosine", 1.01), r"a cos is better than a perfect one \(1\)"),
    "below": (value("roughness.mse@masked", -0.1), r"a MSE is better than a perfect one \(0\)"),
    "jensen": (values({"roughness.mse@masked": 0.1, "roughness.mse_object": 0.2}), "square of a mean error is above"),
    "cosine": (values({"normal.cosine": 0.9, "normal.angle_deg": 26.0}), "mean cosine is above the cosine of the mean"),
    "pasted": (
        values({"albedo.lpips_alex@masked-raw": 0.2, "albedo.lpips_alex@whole-raw": 0.1}),
        r"lpips_alex@whole-raw'\]: differs from that of the masked picture, though",
    ),
    "infinite": (value("roughness.mse@masked", "inf"), "is infinitely bad"),
    "owner": (record(0, object="ball-9"), "sample 'ball-0_l0' is of"),
    "published": (lambda d: d["run"]["methods"][0].update(published="Mine"), r"run.methods\[0\].published: .*Mine"),
    "twice": (lambda d: d["records"].append(d["records"][0]), r"records\[20\]: the same measurement as records\[0\]"),
    "rows twice": (lambda d: d["run"]["methods"].append(d["run"]["methods"][0]), "'ours-mean' occurs 2 times"),
    "changed": (definition("protocols", "single-image", "all"), "'single-image' is 'all' in the file, and 'one image"),
    "unlit": (lambda d: d["lights"].pop("ball-0_l0"), "lights: names no light of the sample 'ball-0_l0'"),
    "dark": (lambda d: d["lights"].update({"ball-0_l0": []}), "lights: names no light of the sample 'ball-0_l0'"),
    "nameless": (lambda d: d["lights"].update({"ball-0_l0": [""]}), r"lights\['ball-0_l0'\]\[0\]: got ''"),
    "gone": (lambda d: d["definitions"]["metrics"].pop("psnr"), "definitions.metrics: 'psnr' is missing, but records"),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_what_contradicts_itself_is_refused(name: str) -> None:
    change, said = CONTRADICTIONS[name]
    document = small_document()
    from_document(document, "a.json")
    change(document)
    with pytest.raises(UnirenderError, match=f"a.json: no valid results: .*{said}"):
        from_document(document, "a.json")


def test_a_loss_against_another_row_may_be_negative() -> None:
    results = small_results()
    lucky = replace(results.records[0], table="physics", protocol="physics", values={"loop.loss": -0.01})
    records = (lucky,)
    assert content_problems(replace(results, records=records, definitions=definitions(records))) == []


def test_a_problem_of_many_records_has_one_line() -> None:
    results = small_results()
    records = tuple(replace(r, protocol="single-picture") if r.table == "inverse" else r for r in results.records)
    problems = [str(problem) for problem in content_problems(replace(results, records=records))]
    assert len(problems) == 1
    assert problems[0].endswith("(11 more like it)")


def test_a_reader_hears_of_a_partial_run_and_of_values_that_no_table_shows() -> None:
    results = small_results()
    assert remarks(results) == []
    odd = replace(results.records[0], values={"albdo.psnr@masked-srgb-raw": 20.0, "relit_3.psnr@masked-srgb-raw": 20.0})
    ceiling = [r for r in results.records if r.method != "noise-ceiling"]
    told = remarks(replace(results, run=replace(RUN, limit=2), records=(*ceiling, odd)))
    assert told == [
        "a partial run (--limit 2): its tables carry a watermark",
        "described, but without a value: noise-ceiling",
        "quantity 'albdo' stands in no table (1 values); did you mean albedo?",
    ]


def test_a_metrics_name_means_one_thing_in_all_tables() -> None:
    """Definitions in a file are by name."""
    for spec in ALL_TABLES.values():
        for column in spec.columns:
            assert column.metric == ALL_METRICS[column.metric.name], column


def inverse_sample(scene: Scene) -> str:
    return f"{scene.key}_{material_key(scene.materials[0])}"


def test_samples_are_looked_up_in_the_suite_that_is_installed() -> None:
    suite = load_suite("tiny")
    scene, other = suite.scenes[0], suite.scenes[-1]
    base = replace(small_results(suite="tiny", suite_hash=suite.sha256, resolution=suite.spec.resolution), lights={})

    def at(sample: str, owner: str, **lights: tuple[str, ...]) -> list[str]:
        records = (replace(base.records[0], sample=sample, object=owner),)
        return [str(problem) for problem in content_problems(replace(base, records=records, lights=lights))]

    assert at(inverse_sample(scene), scene.object) == []
    assert at(inverse_sample(scene), scene.object, **{inverse_sample(scene): (scene.light,)}) == []
    (wrong,) = at(inverse_sample(scene), scene.object, **{inverse_sample(scene): ("sun",)})
    assert wrong.endswith(f"got ('sun',), expected ('{scene.light}',), those of the suite")
    several = replace(base.records[0], table="multi-view", protocol="8-views", sample=scene.object, object=scene.object)
    assert not any("sample" in str(problem) for problem in content_problems(replace(base, records=(several,))))
    assert "suite 'tiny' has no sample" in at(f"{scene.key}_m010_r031", scene.object)[0], "not asked of that scene"
    assert "suite 'tiny' has no scene of the sample 'ball-0_l0'" in at("ball-0_l0", "ball-0")[0]
    assert "is of another object than" in at(inverse_sample(scene), other.object)[0]
    elsewhere = remarks(small_results(suite="tiny"))
    assert "is not the one installed here" in elsewhere[0]


def of_tiny(scenes: Mapping[str, Sequence[Scene]], **changes: Any) -> Results:
    """Results of suite tiny: for each row the scenes that it has a record of; `changes` are fields of the run."""
    suite = load_suite("tiny")
    facts = {"suite": "tiny", "suite_hash": suite.sha256, "resolution": suite.spec.resolution} | changes
    base = small_results(methods=tuple(scenes), **facts)
    records = tuple(
        replace(base.records[0], method=method, sample=inverse_sample(scene), object=scene.object)
        for method, shown in scenes.items()
        for scene in shown
    )
    return replace(base, records=records, definitions=definitions(records), lights=sample_lights(suite))


def test_pictures_of_another_size_than_the_suites_are_refused() -> None:
    scenes = {"ours-mean": load_suite("tiny").scenes}
    assert content_problems(of_tiny(scenes)) == []
    problems = [str(problem) for problem in content_problems(of_tiny(scenes, resolution=128))]
    assert problems == ["run.resolution: got 128, expected 64: suite 'tiny' has pictures of that size"]
    assert content_problems(of_tiny(scenes, resolution=128, suite_hash="f" * 64)) == [], "somebody's own suite"


def test_a_reader_hears_of_a_partial_run_that_does_not_say_so() -> None:
    scenes = load_suite("tiny").scenes
    two = {"ours-mean": scenes[:2], "input-as-albedo": scenes[1:2]}
    assert remarks(of_tiny(two)) == ["records of 2 of 48 scenes, though the run says that it is whole"]
    assert remarks(of_tiny(two, limit=2)) == ["a partial run (--limit 2): its tables carry a watermark"]
    assert not any("though" in line for line in remarks(of_tiny(two, suite_hash="f" * 64)))
    assert remarks(of_tiny({**two, "input-as-albedo": scenes})) == [], "a folder may have predictions of a part"
    objects = of_tiny({"ours-mean": scenes[:1]})
    objects = replace(objects, records=tuple(replace(r, sample=r.object) for r in objects.records))
    assert remarks(objects) == [], "records of objects say nothing of scenes"


def test_the_file_is_named_as_it_was_given(tmp_path: Path) -> None:
    path = written(tmp_path / "mine.json", small_document())
    assert read_results(path).label == "mine"
