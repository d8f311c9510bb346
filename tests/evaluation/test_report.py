"""The report: one file, nothing from the network, failures first, both themes; and the gallery's pictures."""

import base64
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from report_pieces import LIGHTS, RUN, SIZE, VERDICT, item, light_records, mask, records
from tiny_suites import make_suite

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.engine import Prediction
from unirender_evaluation.metrics import METRICS, Variant, metric_key
from unirender_evaluation.records import MethodInfo, Record, write_records, write_run
from unirender_evaluation.report.gallery import (
    BYTES_PER_PIXEL,
    GALLERY_BYTES,
    data_uri,
    flip_map,
    image_picture,
    map_pictures,
    picture_rows,
    picture_size,
    shelves,
    shown_width,
    shrink_covered,
)
from unirender_evaluation.report.page import write_report
from unirender_evaluation.report.pictures import Pictures
from unirender_evaluation.report.plots import Scale, heading, strip_plots, tiles
from unirender_evaluation.report.samples import make_sheets
from unirender_evaluation.runs.report import leading_row, rebuild, report_run
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.tasks import tasks


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    made = records()
    write_report(path, build_tables(made, RUN), [item("good", 6, "best"), item("bad", 1, "worst")], RUN, made)
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


class Outline(HTMLParser):
    """Open tags that must be closed, in order."""

    VOID = frozenset({"meta", "link", "img", "input", "br"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value for name, value in attrs if name in ("src", "href") and value is not None]
        if tag not in self.VOID and tag not in ("path", "i"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("path", "i"):
            assert self.open.pop() == tag


def test_it_is_one_well_formed_file_without_a_network(page: str) -> None:
    outline = Outline()
    outline.feed(page)
    assert outline.open == []
    assert all(address.startswith(("data:", "#")) for address in outline.addresses)
    assert not re.search(r"https?://|@import|url\(", page)


def test_it_shows_the_protocol_the_watermark_and_both_values(page: str) -> None:
    assert "--limit 2: a partial run" in page
    assert "resolution</b> 24 x 24" in page
    assert "paper </span><b>23.20</b>" in page
    assert "22.50" in page  # measured whole-frame mean of ours
    assert "prefers-color-scheme: dark" in page
    assert "24 x 24 pixels, truth. Up to 6 samples a table" in page, "of no renderer that is known"
    assert "PSNR\xa0(dB)\xa0↑" in page, "a heading stays on one line"


def test_labels_are_escaped(page: str) -> None:
    assert "Ours &lt;mean&gt;" in page
    assert "Ours <mean>" not in page.split('id="tables-json"')[0]


def test_commands_in_notes_are_set_as_code(tmp_path: Path) -> None:
    tables = [replace(table, notes=("<x>: `make x` fetches it",)) for table in build_tables(records(), RUN)]
    page = write_report(tmp_path / "r.html", tables, [], RUN).read_text(encoding="utf-8")
    assert "<li>&lt;x&gt;: <code>make x</code> fetches it</li>" in page


def test_pictures_come_before_verdicts_and_the_contents_are_in_the_order_of_the_page(page: str) -> None:
    sections = re.findall(r'<section id="(\w+)">', page)
    assert sections == ["standing", "tables", "gallery", "distributions", "verdicts", "samples"]
    assert re.findall(r'<a href="#(\w+)">', page) == sections


def test_the_pictures_at_its_head_stand_in_rows_that_say_which_is_the_truth(page: str) -> None:
    (head,) = re.findall(r'<table class="hero".*?</table>', page, re.DOTALL)
    assert re.findall(r'<th scope="col">(\w+)</th>', head) == ["image", "albedo", "normal"]
    rows = re.findall(r'<th scope="row">(\w+)</th>(.*?)</tr>', head)
    pictures = [(name, re.findall(r'alt="([\w ]*)"', cells)) for name, cells in rows]
    assert pictures == [("found", ["image", "albedo", "normal"]), ("truth", ["true albedo", "true normal"])]


def test_failures_come_first_and_are_named_with_their_figures_and_questions(page: str) -> None:
    cards = re.findall(r'<h4><span class="rank">(.*?)</span>(.*?)</h4>', page)
    assert cards == [("worst of 6: PSNR 1 dB", "question bad"), ("best of 6: PSNR 6 dB", "question good")]
    assert "ranked by Ours &lt;mean&gt;" in page


def test_every_prediction_has_its_error_map_and_every_card_its_truth_and_input(page: str) -> None:
    predictions = sum(len(maps) for maps in item("x").predictions.values())
    assert page.count('alt="FLIP error"') == page.count('class="compare"') == 2 * predictions
    assert page.count('alt="truth"') == 2 * len(item("x").truth)
    assert page.count('<figure class="given"><figcaption>image</figcaption>') == 2


def test_trivial_rows_for_different_maps_share_a_picture_row() -> None:
    made = {"constant": {"normal": item("x").truth["normal"]}, **item("x").predictions}
    run = replace(RUN, methods=(*RUN.methods, MethodInfo("constant", "Constant", "trivial")))
    rows = picture_rows(replace(item("x"), predictions=made), run)
    assert rows == [
        ("Ours <mean>", {"albedo": "ours", "normal": "ours"}),
        ("Trivial", {"normal": "constant", "albedo": "input"}),
    ]


def test_verdicts_and_distributions_are_there(page: str) -> None:
    assert re.search(r"beats</span> Input as albedo</td><td>Albedo PSNR ↑</td><td>\+8\.00 dB", page)
    assert page.count('class="rug"') == 3


def test_a_light_alone_has_its_standing_distributions_and_verdicts(tmp_path: Path) -> None:
    """By what does not depend on the light's level: the raw balls, by which it loses, are in the table alone."""
    made, named = light_records(), ["Environment log-RMSE", "Environment angle"]
    named += ["Matte ball (aligned) error", "Glossy ball (aligned) error"]
    tables = build_tables(made, LIGHTS, ALL_TABLES)
    assert [tile["what"] for tile in tiles(tables)] == [f"{name} ↓" for name in named]
    assert {(tile["by"], tile["start_kind"], tile["end"]) for tile in tiles(tables)} == {
        ("Lamp finder", "trivial", "perfect: 0")
    }
    assert [strip["title"] for strip in strip_plots(ALL_TABLES, made, LIGHTS)] == named
    path = write_report(tmp_path / "r.html", tables, [], LIGHTS, made, specs=ALL_TABLES)
    page = path.read_text(encoding="utf-8")
    for name in named:
        assert f'<span class="best">beats</span> Uniform light</td><td>{name} ↓</td>' in page
    assert "is beaten by" not in page


def test_the_runs_own_verdict_is_in_its_report_where_the_folder_has_one(page: str, tmp_path: Path) -> None:
    suite = make_suite(tmp_path / "suite")
    run = replace(RUN, suite=suite.spec.name, suite_hash=suite.sha256)
    write_run(tmp_path / "run.json", run)
    write_records(tmp_path / "records.jsonl", records())
    (tmp_path / "verdict.txt").write_text(VERDICT, encoding="utf-8")
    found = rebuild(tmp_path, str(suite.spec.path)).read_text(encoding="utf-8")
    claims = re.findall(r'<li><b class="(\w*)">(\w*)</b> <span>(.*?)</span></li>', found)
    assert [claim[:2] for claim in claims] == [
        ("holds", "HOLDS"), ("fails", "FAILS"), ("stated", "stated"), ("", ""), ("", ""),
    ]  # fmt: skip
    assert claims[1][2] == "ours exceeds the noise ceiling on &lt;this&gt; by at least 0.10 dB"
    assert claims[3][2] == "not run inverse/single-image normal cos: ours against mean-normal"
    assert VERDICT.splitlines()[0] in found
    assert 'class="claims"' not in page


def test_a_verdict_without_anything_to_compare_has_a_section(tmp_path: Path) -> None:
    tables = build_tables(records(), RUN)
    page = write_report(tmp_path / "r.html", tables, [], RUN, verdict=VERDICT).read_text(encoding="utf-8")
    assert page.count('href="#verdicts"') == page.count('<section id="verdicts">') == 1
    assert "Row against row" not in page


class Cells(HTMLParser):
    """(tag, attributes) of what is in data tables and around them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def all(self, tag: str, **wanted: str) -> list[dict[str, str | None]]:
        """Attributes of these elements; `class_` names one of the classes."""
        kind = wanted.pop("class_", None)
        found = [attrs for name, attrs in self.found if name == tag and wanted.items() <= attrs.items()]
        return [attrs for attrs in found if kind is None or kind in (attrs.get("class") or "").split()]


def test_tables_say_what_they_and_their_headings_are(page: str) -> None:
    cells = Cells(page)
    assert {attrs.get("scope") for attrs in cells.all("th")} == {"col", "colgroup", "row", "rowgroup"}
    labels = [attrs.get("aria-label") for attrs in cells.all("table")]
    assert labels[:3] == ["What was found, and the truth", *(f"Inverse rendering: from the image, {tab}" for tab in
                          ("whole frame, beside the paper", "inside the mask"))]  # fmt: skip
    assert all(labels)
    scrolling = cells.all("div", class_="scroll")
    assert len(scrolling) == len(labels)
    assert all(attrs["tabindex"] == "0" and attrs["role"] == "region" and attrs["aria-label"] for attrs in scrolling)
    assert re.search(r'<th scope="row"[^>]*><span class="dot k-ours"></span>Ours &lt;mean&gt;', page)


def test_tabs_and_panels_name_each_other_and_panels_have_headings(page: str) -> None:
    cells = Cells(page)
    tabs, panels = cells.all("button", role="tab"), cells.all("div", role="tabpanel")
    assert [tab["aria-controls"] for tab in tabs] == [panel["id"] for panel in panels] == ["panel-1-1", "panel-1-2"]
    assert [tab["id"] for tab in tabs] == [panel["aria-labelledby"] for panel in panels]
    headings = re.findall(r'<h4 class="variant">(.*?)</h4>', page)
    assert headings == ["whole frame, beside the paper", "inside the mask"]
    assert "@media screen { .tabbed .variant { display: none; } }" in page, "hidden by scripts alone, and not in print"


def test_on_paper_nothing_is_cut_off(page: str) -> None:
    assert "@page { size: landscape;" in page
    paper = page.split("@media print {")[1].split("\n}")[0]
    assert ".scroll, .scroll.tall, .opened { overflow: visible; max-height: none; }" in paper
    assert re.search(r"table\.data td \{[^}]*white-space: normal", paper)


def test_without_records_and_gallery_it_still_stands(tmp_path: Path) -> None:
    path = write_report(tmp_path / "r.html", build_tables(records(), RUN), [], RUN)
    text = path.read_text(encoding="utf-8")
    assert 'id="gallery"' not in text
    assert 'id="tables"' in text


def test_pictures_carry_the_mask_as_alpha() -> None:
    picture = np.full((SIZE, SIZE, 3), 0.25, np.float32)
    data = base64.b64decode(data_uri(picture, mask()).partition(",")[2])
    levels = np.asarray(Image.open(io.BytesIO(data)))
    assert levels.shape == (SIZE, SIZE, 4)
    assert levels[..., 0].min() == levels[..., 0].max() == 64
    np.testing.assert_array_equal(levels[..., 3], np.round(mask()[..., 0] * 255))
    (card,) = shelves([item("x")], RUN, {}, SIZE)[0]["cards"]
    shown = Image.open(io.BytesIO(base64.b64decode(card["truth"][0]["uri"].partition(",")[2])))
    np.testing.assert_array_equal(np.asarray(shown)[..., 3], levels[..., 3])


def test_display_pictures_of_maps() -> None:
    inside = (mask() > 0).astype(np.float32)
    maps = Intrinsics(normal=inside * np.array([0, 0, 1], np.float32), roughness=0.5 * inside, mask=mask())
    pictures = map_pictures(maps)
    assert list(pictures) == ["normal", "roughness"]
    np.testing.assert_allclose(pictures["normal"][SIZE // 2, SIZE // 2], [0.5, 0.5, 1.0])
    np.testing.assert_allclose(pictures["roughness"][SIZE // 2, SIZE // 2], 0.5)
    image = image_picture(0.5 * mask() * np.ones(3, np.float32), mask())
    assert image[mask()[..., 0] > 0].std() < 1e-6  # the edge is not darker


def test_flip_is_zero_for_equal_pictures_and_grows_with_the_error() -> None:
    truth = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    means = [flip_map(truth + delta, truth, mask())[1] for delta in (0.0, 0.05, 0.3)]
    assert means[0] == pytest.approx(0, abs=1e-6)
    assert means[0] < means[1] < means[2]


def test_a_picture_of_another_size_is_refused() -> None:
    good = item("x")
    with pytest.raises(UnirenderError, match="gallery x, ours albedo"):
        replace(good, predictions={"ours": {"albedo": np.zeros((2, 2, 3), np.float32)}})
    replace(good, given={"HDRI": np.zeros((2, 4, 3), np.float32)})  # a light has a size of its own


def tile_of(column: str, values: dict[str, list[float]], quantity: str, metric: str) -> dict:
    """The tile of one column of the inverse table, from values per row and sample."""
    key = metric_key(quantity, metric)
    made = [
        Record("inverse", "single-image", method, f"s{i}", f"o{i}", {key: value})
        for method, found in values.items()
        for i, value in enumerate(found)
    ]
    run = replace(RUN, limit=None)
    (tile,) = [tile for tile in tiles(build_tables(made, run)) if column in tile["what"]]
    return tile


@pytest.mark.parametrize(
    ("quantity", "metric", "trivial", "ours", "end", "at"),
    [
        ("metallic", "mse", 0.10, 0.05, "perfect: 0", "50.0"),
        ("normal", "cosine", 0.6, 0.9, "perfect: 1", "75.0"),
        ("albedo", "psnr", 20.0, 26.0206, "perfect: no error (scale of RMS error)", "50.0"),  # half the RMS error
        ("albedo", "psnr", 26.0206, 20.0, "perfect: no error (scale of RMS error)", "0.0"),  # worse than trivial
    ],
)
def test_a_scale_without_a_ceiling_ends_at_a_perfect_value_and_says_so(
    quantity: str, metric: str, trivial: float, ours: float, end: str, at: str
) -> None:
    tile = tile_of(quantity.capitalize(), {"input": [trivial] * 3, "ours": [ours] * 3}, quantity, metric)
    assert (tile["end"], tile["end_kind"]) == (end, "perfect")
    assert tile["start"].startswith("Input as albedo")
    assert [(mark["kind"], mark["at"]) for mark in tile["marks"]] == [("ours", at)]


@pytest.mark.parametrize(("quantity", "metric", "best"), [("albedo", "psnr", 22.0), ("metallic", "mse", 0.01)])
def test_a_tile_has_the_best_of_our_rows_that_are_complete(quantity: str, metric: str, best: float) -> None:
    """By name the last, by score in the middle; one on fewer samples is not asked."""
    worse, better_on_one = (20.0, 30.0) if metric == "psnr" else (0.05, 0.001)
    values = {"m": [best] * 3, "a": [worse] * 3, "z": [worse] * 3, "y": [better_on_one]}
    key = metric_key(quantity, metric)
    made = [
        Record("inverse", "single-image", method, f"s{i}", f"o{i}", {key: value})
        for method, found in values.items()
        for i, value in enumerate(found)
    ]
    run = replace(RUN, limit=None, methods=tuple(MethodInfo(name, name, "ours") for name in values))
    (tile,) = [tile for tile in tiles(build_tables(made, run)) if quantity in tile["what"].lower()]
    assert (tile["by"], tile["value"]) == ("m", f"{best:.{METRICS[metric].decimals}f}")


def test_a_scale_with_a_ceiling_ends_there_and_prints_its_n() -> None:
    tile = tile_of("Albedo", {"input": [10.0] * 3, "ours": [20.0] * 3, "ceiling": [50.0]}, "albedo", "psnr")
    assert (tile["end"], tile["end_kind"]) == ("Noise ceiling: 50.00 (n\xa0=\xa01)", "ceiling")
    assert [mark["at"] for mark in tile["marks"]] == ["25.0"]


def test_a_scale_is_clamped_and_an_infinite_psnr_is_its_end() -> None:
    scale = Scale(20.0, float("inf"))
    assert [scale.at(x) for x in (0.0, 20.0, 40.0, float("inf"))] == pytest.approx([0, 0, 0.9, 1])
    assert Scale(0.1, 0.0).at(0.1) == 0
    assert Scale(0.0, 0.0).at(0.0) == 1


def test_cells_on_fewer_samples_than_their_row_print_their_n(tmp_path: Path) -> None:
    """A ceiling with PSNR everywhere and SSIM on a subset."""
    ssim = {metric_key("albedo", "ssim"): 0.9}
    made = [
        r if r.method == "ceiling" and r.sample > "s1" else replace(r, values={**r.values, **ssim}) for r in records()
    ]
    page = write_report(tmp_path / "r.html", build_tables(made, RUN), [], RUN).read_text(encoding="utf-8")
    assert page.count('<span class="few">n = 2</span>') == 1
    whole = write_report(tmp_path / "r.html", build_tables(records(), RUN), [], RUN).read_text(encoding="utf-8")
    assert "few" not in whole.split("</style>")[1]


def test_a_heading_names_the_protocol_only_where_it_says_more() -> None:
    assert heading("Physics", "physics") == "Physics"
    assert heading("Inverse rendering", "single-image") == "Inverse rendering: from the image"


def test_the_legend_names_the_kinds_that_are_there(page: str) -> None:
    legend = page.split('<p class="legend">')[1].split("</p>")[0]
    assert re.findall(r'k-(\w+)">([^<]+)', legend) == [
        ("ours", "ours"), ("paper", "published only"), ("trivial", "trivial"), ("ceiling", "bounds"),
    ]  # fmt: skip


def test_a_report_is_made_again_from_its_folder(tmp_path: Path) -> None:
    suite = make_suite(tmp_path / "suite")
    run = replace(RUN, suite=suite.spec.name, suite_hash=suite.sha256)
    with pytest.raises(UnirenderError, match=r"no run\.json"):
        rebuild(tmp_path / "nothing")
    write_run(tmp_path / "run.json", run)
    write_records(tmp_path / "records.jsonl", records())
    with pytest.raises(UnirenderError, match=rf"no suite '{suite.spec.name}'.*path of a \.toml file.* with --suite$"):
        rebuild(tmp_path)
    with pytest.raises(UnirenderError, match=r"no suite 'other'.*file$"):
        rebuild(tmp_path, "other")
    assert rebuild(tmp_path, str(suite.spec.path)) == tmp_path / "report.html"
    assert "<table class" in (tmp_path / "report.html").read_text(encoding="utf-8")
    write_run(tmp_path / "run.json", replace(run, suite_hash="of another suite"))
    (tmp_path / "report.html").unlink()
    with pytest.raises(UnirenderError, match=r"leave --suite .*ball.* out, or name that one"):
        rebuild(tmp_path, str(suite.spec.path))
    assert not (tmp_path / "report.html").exists()


def test_the_gallery_is_led_by_our_row_else_by_a_strangers() -> None:
    trivial, ours = RUN.methods[1], RUN.methods[0]
    strangers = tuple(MethodInfo(key, key, "external") for key in ("theirs", "others"))
    assert leading_row(replace(RUN, methods=(trivial, *strangers, ours))) == ours.key
    assert leading_row(replace(RUN, methods=(trivial, *strangers))) == "theirs"
    assert leading_row(replace(RUN, methods=(trivial,))) == ""


def test_a_report_made_again_is_the_same_without_a_row_of_ours(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The gallery's order and leader are those of the run: the stranger's. Without its pictures it says how many."""
    suite = make_suite(tmp_path / "suite")
    method = MethodInfo("theirs", "Theirs", "external")
    keeper, made = Pictures(tmp_path / "pictures", suite, list(suite.scenes)), []
    for place, task in enumerate(tasks(suite, "inverse", "single-image", list(suite.scenes))):
        for row, level in (("input", 10.0 + place), ("theirs", 30.0 - place)):
            record = Record(
                task.table, task.protocol, row, task.sample, task.scene.object, {metric_key("albedo", "psnr"): level}
            )
            keeper.keep(task, row, row, Prediction(maps=task.truth_maps))
            made.append(record)
    run = replace(RUN, suite="ball", suite_hash=suite.sha256, limit=None, methods=(RUN.methods[1], method))
    report_run(tmp_path, suite, run, made, build_tables(made, run, ALL_TABLES))
    first = (tmp_path / "report.html").read_text(encoding="utf-8")
    write_run(tmp_path / "run.json", run)
    write_records(tmp_path / "records.jsonl", made)
    rebuild(tmp_path, str(suite.spec.path))
    assert "ranked by Theirs" in first
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == first
    assert not caplog.text
    (tmp_path / "pictures").rename(tmp_path / "elsewhere")
    rebuild(tmp_path, str(suite.spec.path))
    assert f"{tmp_path / 'pictures'}: the pictures of {len(made)} answers are not there" in caplog.text


def samples_of(page: str) -> list[dict]:
    """The page's own numbers."""
    (data,) = re.findall(r'<script type="application/json" id="samples-json">(.*?)</script>', page, re.DOTALL)
    return json.loads(data)


def test_every_value_of_every_sample_is_in_the_page_as_the_tables_round_it(page: str) -> None:
    (section,) = samples_of(page)
    assert [method["label"] for method in section["methods"]] == ["Ours <mean>", "Input as albedo", "Noise ceiling"]
    keys = [column["key"] for column in section["columns"]]
    assert keys.index(metric_key("albedo", "psnr", Variant("masked"))) < keys.index(
        metric_key("albedo", "psnr", Variant("whole"))
    ), "what we believe comes first"
    found = {
        (method["label"], sample["id"], key): value
        for sample in section["samples"]
        for method, row in zip(section["methods"], sample["values"], strict=True)
        for key, value in zip(keys, row or [], strict=bool(row))
        if value is not None
    }
    labels = {info.key: info.label for info in RUN.methods}
    expected = {(labels[r.method], r.sample, key): round(v, 2) for r in records() for key, v in r.values.items()}
    assert found == expected


def test_infinite_values_and_rows_without_an_answer_are_told_apart(tmp_path: Path) -> None:
    key = metric_key("albedo", "psnr")
    made = [*records(), Record("inverse", "single-image", "ours", "alone", "o9", {key: float("inf")})]
    page = write_report(tmp_path / "r.html", build_tables(made, RUN), [], RUN, made).read_text(encoding="utf-8")
    (alone,) = [sample for sample in samples_of(page)[0]["samples"] if sample["id"] == "alone"]
    assert "inf" in alone["values"][0]
    assert alone["values"][1:] == [None, None]


def test_sheets_take_the_worst_first_and_no_more_than_their_limit() -> None:
    items = [item(f"s{i}", place=i + 1) for i in range(6)]
    one = len(make_sheets(items[:1])["inverse", "single-image", "s0"].uri)
    sheets = make_sheets(iter(items), limit=3 * one + 10)
    assert [sample for _, _, sample in sheets] == ["s0", "s1", "s2"]
    sheet = sheets["inverse", "single-image", "s0"]
    assert (sheet.names, sheet.width, sheet.height) == (("albedo", "normal"), 2 * SIZE, 2 * SIZE)
    picture = Image.open(io.BytesIO(base64.b64decode(sheet.uri.partition(",")[2])))
    assert picture.size == (sheet.width, sheet.height)


def test_a_sheet_has_the_input_then_truth_over_answer_inside_their_masks() -> None:
    """Of even colours, which a lossy picture keeps; nothing stands below the input."""
    levels = {"input": 0.2, "truth": 0.4, "answer": 0.8}
    seen, truth, answer = (np.full((SIZE, SIZE, 3), level, np.float32) for level in levels.values())
    made = replace(
        item("x"), given={"input": seen}, given_mask=np.ones_like(mask()), truth={"albedo": truth},
        predictions={"ours": {"albedo": answer}},
    )  # fmt: skip
    (sheet,) = make_sheets([made]).values()
    assert (sheet.names, sheet.caption) == (("input", "albedo"), "question x · caption x")
    data = Image.open(io.BytesIO(base64.b64decode(sheet.uri.partition(",")[2]))).convert("RGBA")
    shown = np.asarray(data).reshape(2, SIZE, 2, SIZE, 4)
    middle = shown[:, SIZE // 2, :, SIZE // 2]
    np.testing.assert_allclose(middle[..., 0], [[51, 102], [0, 204]], atol=3)
    assert (shown[0, :, 0, :, 3] == 255).all(), "the input's own mask"
    assert not shown[1, :, 0, :, 3].any()
    for line in range(2):
        np.testing.assert_allclose(shown[line, :, 1, :, 3], np.round(255 * mask()[..., 0]), atol=3)


def test_the_gallery_of_large_pictures_is_shown_smaller_and_scored_at_full_size() -> None:
    """Noise, which no PNG can pack: the worst case."""
    large = 384
    rng = np.random.default_rng(0)
    picture = rng.random((large, large, 3), dtype=np.float32)
    whole = np.ones((large, large, 1), np.float32)
    made = replace(
        item("x"), mask=whole, given={}, truth={"albedo": picture}, predictions={"ours": {"albedo": 1 - picture}}
    )
    items = [made] * 12
    most = shown_width(items, limit=1_000_000)
    (card,) = shelves([replace(made)], RUN, {}, most)[0]["cards"]
    shown = card["rows"][0]["cells"][0]
    assert shown["picture"]["width"] == picture_size(large, most) <= most < large
    assert shown["flip_mean"] == f"FLIP {flip_map(1 - picture, picture, whole)[1]:.3f}"
    assert 12 * sum(len(p["uri"]) for p in (card["truth"][0], shown["picture"], shown["flip"])) < 5 * 1_000_000
    assert shown_width([item("x")]) == SIZE, "small ones stay as they are"
    full = replace(made, given={"input": picture, "light": picture}, truth=dict.fromkeys("abc", picture))
    assert shown_width([full], int(7 * BYTES_PER_PIXEL * 100**2)) == 100, "2 given, 3 true, a prediction and its error"
    assert shown_width(items) > most, f"{GALLERY_BYTES} bytes hold more"


def test_a_shrunken_picture_keeps_its_colour_at_the_edge() -> None:
    inside = (mask() > 0).astype(np.float32)
    picture, half = shrink_covered(0.5 * inside * np.ones(3, np.float32), inside, SIZE // 2)
    assert picture.shape == (SIZE // 2, SIZE // 2, 3)
    np.testing.assert_allclose(picture[half[..., 0] > 0], 0.5, rtol=1e-5)
    assert half[(half > 0) & (half < 1)].size > 0
