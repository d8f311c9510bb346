"""The report: one file, nothing from the network, failures first, both themes; and the gallery's pictures."""

import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.gallery import GalleryItem, data_uri, flip_map, image_picture, map_pictures
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.report import picture_rows, worst_samples, write_report
from unirender_evaluation.tables import build_tables

SIZE = 24
RUN = RunInfo(
    "tiny",
    "abcdef0123456789",
    SIZE,
    (
        MethodInfo("ours", "Ours <mean>", "ours", "Ours", 1, 1, 0),
        MethodInfo("input", "Input as albedo", "trivial"),
        MethodInfo("ceiling", "Noise ceiling", "ceiling"),
    ),
    lpips=("alex",),
    limit=2,
)


def mask() -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE] - (SIZE - 1) / 2
    return np.clip(9 - np.hypot(y, x), 0, 1).astype(np.float32)[..., None]


def records() -> list[Record]:
    made = []
    for method, level in (("ours", 20.0), ("input", 12.0), ("ceiling", 45.0)):
        for i in range(6):
            values = {metric_key("albedo", "psnr", Variant(m)): level + i for m in ("masked", "whole")}
            made.append(Record("inverse", "single-image", method, f"s{i}", f"o{i // 2}", values))
    return made


def item(sample: str, badness: float) -> GalleryItem:
    rng = np.random.default_rng(0)
    truth, other = rng.random((2, SIZE, SIZE, 3), dtype=np.float32)
    maps = {"albedo": truth, "normal": other}
    return GalleryItem(
        "inverse", "single-image", sample, f"caption {sample}", mask(), {"image": other}, maps,
        {"ours": maps, "input": {"albedo": other}}, {"ours": {"albedo": "20.0 dB"}}, badness,
    )  # fmt: skip


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    made = records()
    write_report(path, build_tables(made, RUN), [item("good", -30), item("bad", -10)], RUN, made)
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
    assert "paper <b>23.20</b>" in page
    assert "22.50" in page  # measured whole-frame mean of ours
    assert "prefers-color-scheme: dark" in page


def test_labels_are_escaped(page: str) -> None:
    assert "Ours &lt;mean&gt;" in page
    assert "Ours <mean>" not in page.split('id="tables-json"')[0]


def test_failures_come_first(page: str) -> None:
    assert page.index("caption bad</h4>") < page.index("caption good</h4>")


def test_trivial_rows_for_different_maps_share_a_picture_row() -> None:
    made = {"constant": {"normal": item("x", 0).truth["normal"]}, **item("x", 0).predictions}
    run = replace(RUN, methods=(*RUN.methods, MethodInfo("constant", "Constant", "trivial")))
    rows = picture_rows(replace(item("x", 0), predictions=made), run)
    assert rows == [
        ("Ours <mean>", {"albedo": "ours", "normal": "ours"}),
        ("Trivial", {"normal": "constant", "albedo": "input"}),
    ]


def test_verdicts_and_distributions_are_there(page: str) -> None:
    assert re.search(r"beats</span> Input as albedo</td><td>Albedo PSNR ↑</td><td>\+8\.00 dB", page)
    assert page.count('class="rug"') == 3


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


def test_worst_samples_follow_the_direction_of_the_metric() -> None:
    key = metric_key("albedo", "psnr")
    assert worst_samples(records(), key, "ours", higher_is_better=True, count=2) == ["s0", "s1"]
    assert worst_samples(records(), key, "ours", higher_is_better=False, count=2) == ["s5", "s4"]


def test_a_picture_of_another_size_is_refused() -> None:
    good = item("x", 0)
    with pytest.raises(UnirenderError, match="gallery x, given image"):
        GalleryItem(
            good.table, good.protocol, "x", "", mask(), {"image": np.zeros((2, 2, 3), np.float32)}, good.truth, {}
        )
