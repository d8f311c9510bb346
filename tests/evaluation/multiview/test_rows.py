"""The multi-view table from jobs to print: records once, resumed by key; every format with its protocol."""

import dataclasses
import json
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from multiview_pieces import SMALL

from unirender_evaluation.ceiling import ceiling_breaches
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.multiview.methods import ConstantObject
from unirender_evaluation.multiview.pictures import MultiviewPictures
from unirender_evaluation.multiview.rows import TRIVIAL_USES, multiview_jobs
from unirender_evaluation.multiview.settings import MultiviewSettings
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE, PROTOCOL
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.report.page import write_report
from unirender_evaluation.rows import Row, make_row
from unirender_evaluation.store import Job, Store, content_key
from unirender_evaluation.suites.suite import Suite, load_suite
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import Table, build_tables
from unirender_evaluation.tables.formats import to_json, to_markdown
from unirender_evaluation.tables.latex import to_latex
from unirender_evaluation.versions import LPIPS, MULTIVIEW, OPTIMIZER, REFERENCE, Versions
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Views
from unirender_reference.shapes import MeshObject

VERSIONS = Versions("test", {LPIPS: "none", MULTIVIEW: "1", OPTIMIZER: "1", REFERENCE: "1"})
TINY = dataclasses.replace(SMALL, seen=2, held_out=1, spp=16, truth_spp=16)


class Counting(ConstantObject):
    """A method that says how often it was asked."""

    name = "counting"
    asked = 0

    def solve(self, views: Views, mesh: MeshObject) -> Solution:
        Counting.asked += 1
        return super().solve(views, mesh)


@pytest.fixture(scope="module")
def suite() -> Suite:
    return load_suite("tiny")


def jobs(
    suite: Suite, rows: list[Row], folder: Path, settings: MultiviewSettings = TINY, versions: Versions = VERSIONS
) -> list[Job]:
    scene = suite.scenes[6]

    def key_of(what: str, info: MethodInfo, uses: Collection[str]) -> str:
        return content_key(suite, scene, what, info.config, versions.of(uses))

    return list(multiview_jobs(suite, scene, rows, key_of, (), MultiviewPictures(folder), settings))


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return [make_row(Counting(), "optimisation", "Counting", uses=TRIVIAL_USES | {OPTIMIZER})]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("multiview")


@pytest.fixture(scope="module")
def records(suite: Suite, rows: list[Row], folder: Path) -> list[Record]:
    """Two runs over one store: the second finds all there."""
    found: list[Record] = []
    for _ in range(2):
        store = Store.open(folder / "records.jsonl")
        for job in jobs(suite, rows, folder):
            if not job.is_done(store.has):
                store.add(job.make())
        found = store.close()
    return found


def test_records_are_made_once(records: list[Record], suite: Suite) -> None:
    assert Counting.asked == 1
    assert [record.method for record in records] == ["counting", "noise-ceiling"]
    for record in records:
        assert (record.table, record.protocol) == ("multi-view", "known-mesh")
        assert (record.sample, record.object) == (suite.scenes[6].key, suite.scenes[6].object)
    assert records[0].seconds == records[0].values["time.seconds"] >= 0
    assert not any("lpips" in key for key in records[0].values)
    assert not ceiling_breaches(records)


def test_a_lost_picture_is_made_again(suite: Suite, rows: list[Row], folder: Path, records: list[Record]) -> None:
    assert all(job.kept for job in jobs(suite, rows, folder))
    assert [job.kept for job in jobs(suite, rows, folder / "elsewhere")] == [True, False], "the ceiling has none"


def test_the_report_shows_what_was_found(
    suite: Suite, rows: list[Row], folder: Path, records: list[Record], table: Table
) -> None:
    run = RunInfo("tiny", "0" * 64, 64, (rows[0].info, MethodInfo("noise-ceiling", "Noise ceiling", "ceiling")))
    item = MultiviewPictures(folder).items(records, suite, run)[0]
    assert (item.rank, item.leader, item.count) == ("worst", "counting", 1)
    assert list(item.truth) == ["novel view", "relit", "albedo", "roughness", "metallic"]
    assert list(item.predictions["counting"]) == list(item.truth)
    assert list(item.given) == ["seen 1", "seen 2"]
    assert item.given_mask is not None
    assert item.given_mask.min() == 1, "the mask of the card is another camera's, which would cut them"
    inside = item.mask[..., 0] > 0.99
    assert np.ptp(item.predictions["counting"]["albedo"][inside], axis=0).max() < 0.01, "one colour"
    assert np.ptp(item.truth["novel view"][inside], axis=0).max() > 0.2
    assert item.scores["counting"]["novel view"].endswith(" dB")
    page = write_report(folder / "report.html", [table], [item], run, records, specs=ALL_TABLES).read_text()
    assert page.count("Multi-view inverse rendering: 8 views, known mesh") >= 2, "table and gallery"
    assert 'class="dot k-optimisation"' in page


def test_the_gallery_is_ranked_by_the_first_row_of_the_run_not_of_the_alphabet(
    suite: Suite, rows: list[Row], folder: Path, records: list[Record], tmp_path: Path
) -> None:
    for path in folder.glob("multi-view-*.png"):
        shutil.copy(path, tmp_path)
        shutil.copy(path, tmp_path / path.name.replace("counting", "a-trivial-one"))
    trivial = [dataclasses.replace(r, method="a-trivial-one") for r in records if r.method == "counting"]
    run = RunInfo("tiny", "0" * 64, 64, (rows[0].info, MethodInfo("a-trivial-one", "Trivial", "trivial")))
    (item,) = MultiviewPictures(tmp_path).items([*trivial, *records], suite, run)
    assert (set(item.predictions), item.leader) == ({"a-trivial-one", "counting"}, "counting")
    (score,) = (r.values[metric_key("novel", "psnr")] for r in records if r.method == "counting")
    assert item.figure == f"PSNR of novel views {score:.1f} dB", "of all held-out cameras; a picture's own is below it"


def test_keys_follow_settings_and_the_parts_that_a_row_uses(suite: Suite, rows: list[Row], folder: Path) -> None:
    def keys(**options: Any) -> list[str]:
        return [job.key for job in jobs(suite, rows, folder, **options)]

    base = keys()
    assert base == keys()
    assert not set(base) & set(keys(settings=dataclasses.replace(TINY, spp=36)))
    optimizer = Versions("test", {**VERSIONS.parts, OPTIMIZER: "2"})
    assert [a == b for a, b in zip(base, keys(versions=optimizer), strict=True)] == [True, False]
    scoring = Versions("test", {**VERSIONS.parts, MULTIVIEW: "2"})
    assert not set(base) & set(keys(versions=scoring))


@pytest.fixture(scope="module")
def table(records: list[Record], rows: list[Row]) -> Table:
    infos = (rows[0].info, MethodInfo("noise-ceiling", "Noise ceiling", "ceiling"))
    run = RunInfo("tiny", "0" * 64, 64, infos, coverage=0.3, mitsuba="3", truth_spp=999)
    tables = build_tables(records, run, {MULTIVIEW_TABLE.name: MULTIVIEW_TABLE})
    assert [table.protocol_key for table in tables] == [PROTOCOL]
    return tables[0]


def test_the_table_has_what_it_promises(table: Table) -> None:
    assert table.heading == "Multi-view inverse rendering: 8 views, known mesh (masked)"
    assert not any(table.published_columns)
    cells = {row.key: row.cells for row in table.rows}
    names = [f"{column.group} {column.metric.label}" for column in table.columns]
    measured = {name for name, cell in zip(names, cells["counting"], strict=True) if cell.measured is not None}
    assert measured == set(names) - {"Novel view LPIPS-VGG", "Novel view LPIPS-Alex"}
    ceiling = {name for name, cell in zip(names, cells["noise-ceiling"], strict=True) if cell.measured is not None}
    assert ceiling == {"Relit PSNR", "Novel view PSNR"}
    values = {n: c.measured.mean for n, c in zip(names, cells["counting"], strict=True) if c.measured is not None}
    assert values["Albedo PSNR"] != values["Albedo (aligned) PSNR"]
    assert np.isfinite(values["Light log-RMSE"])


def test_the_protocol_is_that_of_the_table(table: Table) -> None:
    """Its truth is not the suite's stored one."""
    protocol = dict(table.protocol)
    assert "8 pictures from all around" in protocol["given"]
    assert protocol["truth"].startswith("Mitsuba 3, rendered in this run, 8 seen and 4 held-out cameras")
    assert "999" not in str(table.protocol)
    assert protocol["coverage"] == "-"


def test_every_format_has_it(table: Table, tmp_path: Path) -> None:
    markdown, latex = to_markdown(table), to_latex(table)
    assert "Light angle (deg) ↓" in markdown
    assert "Optimisation time (s) ↓" in markdown
    assert r"\multicolumn{2}{c}{Light}" in latex
    assert json.loads(to_json([table]))[0]["name"] == "multi-view"
