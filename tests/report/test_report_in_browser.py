"""The report in a real browser: `make test-report`. A missing Chromium or chromedriver is an error, never a skip.

The file is opened from file:// as a reader opens it, clicked and typed at. Each check has a twin that it must refuse.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import browser
import pytest
from browser import Browser
from report_pieces import LONG, write_page

pytestmark = [pytest.mark.report, pytest.mark.slow]

PHONE = 390
PAPER = 960  # CSS pixels between the margins of a landscape page: Letter, the narrower one
ON_PAPER = """for (const sheet of document.styleSheets) for (const rule of sheet.cssRules)
    if (rule.media) {
        const text = rule.media.mediaText;
        rule.media.mediaText = {print: "all", screen: "not all"}[text] ?? text;
    }"""  # the page's rules for print, on the screen


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("page"))


@pytest.fixture
def desk(page: Path, tmp_path: Path) -> Iterator[Browser]:
    """The page in a wide window; whatever a test does with it, nothing may go wrong in the page."""
    with Browser.start(tmp_path) as opened:
        opened.open(page)
        yield opened
        assert opened.errors() == []
        assert opened.requests() == [page.as_uri()]


def twin(page: Path, folder: Path, addition: str) -> Path:
    """The page with something wrong in it."""
    path = folder / "twin.html"
    path.write_text(page.read_text(encoding="utf-8").replace("</main>", f"{addition}</main>"), encoding="utf-8")
    return path


def test_it_opens_from_a_file_without_an_error_or_a_request(desk: Browser) -> None:
    assert desk.ask("return location.protocol") == "file:"
    assert desk.ask("return document.querySelectorAll('img.pic').length") > 10
    broken = "return [...document.images].filter(i => i.src && (!i.complete || !i.naturalWidth)).length"
    assert desk.ask(broken) == 0


def test_a_page_that_throws_or_asks_another_host_is_noticed(page: Path, tmp_path: Path) -> None:
    addition = '<script>no_such_function()</script><img src="http://example.invalid/x.png">'
    with Browser.start(tmp_path) as opened:
        opened.open(twin(page, tmp_path, addition))
        assert any("no_such_function is not defined" in message for message in opened.errors())
        assert "http://example.invalid/x.png" in opened.requests()


def test_a_phone_does_not_scroll_sideways(page: Path, tmp_path: Path) -> None:
    width = "return document.documentElement.scrollWidth"
    with Browser.start(tmp_path, PHONE, 844) as phone:
        phone.open(page)
        assert phone.ask(width) == PHONE
        phone.click("#sample-rows .open")
        assert phone.ask(width) == PHONE, "a sample that is open is no wider"
        phone.click(".compare")
        assert phone.ask("return document.querySelector('#viewer').getBoundingClientRect().width") <= PHONE
        phone.open(twin(page, tmp_path, '<p style="width:500px">wide</p>'))
        assert phone.ask(width) > PHONE


def test_a_long_name_breaks_and_covers_no_number(tmp_path: Path) -> None:
    """Of our row: in its cell, below the big number, in legends, plots and cards."""
    covered = """return [...document.querySelectorAll('table.data tbody > tr > :first-child')].filter(cell => {
        const text = document.createRange(); text.selectNodeContents(cell);
        return text.getBoundingClientRect().right > cell.getBoundingClientRect().right + 1; }).length"""
    page = write_page(tmp_path, LONG)
    for width in (PHONE, 1280):
        with Browser.start(tmp_path / str(width), width, 844) as opened:
            opened.open(page)
            assert opened.ask("return document.documentElement.scrollWidth") == width
            assert opened.ask(covered) == 0
            opened.ask("document.querySelectorAll('th, td').forEach(cell => { cell.style.overflowWrap = 'normal'; })")
            assert opened.ask(covered) > 0, "the twin"


def test_a_phone_breaks_no_word_of_the_published_names(page: Path, tmp_path: Path) -> None:
    """Each word of a row's name is on one line: IntrinsicAnything, GaussianShader, Decomposition."""
    broken = """return [...document.querySelectorAll('#tables tbody th')].flatMap(cell => {
        const text = cell.lastChild, words = [...text.textContent.matchAll(/[^\\s-]+/g)];
        return words.filter(word => {
            const range = document.createRange();
            range.setStart(text, word.index); range.setEnd(text, word.index + word[0].length);
            return range.getClientRects().length > 1; }).map(word => word[0]) })"""
    with Browser.start(tmp_path, PHONE, 844) as phone:
        phone.open(page)
        assert phone.ask(broken) == []
        phone.ask("document.querySelectorAll('#tables th').forEach(cell => { cell.style.overflowWrap = 'anywhere'; })")
        assert "GaussianShader" in phone.ask(broken), "the twin"


def test_the_contents_stay_in_sight_and_cover_no_heading(desk: Browser) -> None:
    bar = "return document.querySelector('.bar').getBoundingClientRect()"
    for name in ("tables", "samples"):
        desk.ask("document.documentElement.style.scrollBehavior = 'auto'")
        desk.click(f".bar a[href='#{name}']")
        assert desk.ask(bar)["top"] == 0
        heading = desk.ask("return document.querySelector(arguments[0]).getBoundingClientRect()", f"#{name} h2")
        assert desk.ask(bar)["bottom"] <= heading["top"]
    desk.ask("document.querySelector('.bar').style.position = 'static'")
    assert desk.ask(bar)["bottom"] < 0, "the twin"


def test_the_name_of_a_sample_is_on_one_line(desk: Browser) -> None:
    """Also where its table is wider than the page: a hyphen is no place to break it."""
    lines = """const cell = document.querySelector('#sample-rows > tbody th'), text = document.createRange();
        cell.firstChild.textContent = 'test-000019_l0_m100_r050';
        document.querySelectorAll('#sample-rows tr > td').forEach(other => { other.style.minWidth = '600px'; });
        cell.style.whiteSpace = arguments[0];
        text.selectNodeContents(cell.firstChild);
        return text.getClientRects().length"""
    assert desk.ask(lines, "") == 1
    assert desk.ask(lines, "normal") == 2, "the twin"


def test_on_paper_every_column_is_within_the_page(tmp_path: Path) -> None:
    wide = """return [...document.querySelectorAll('table')].filter(table =>
        table.getBoundingClientRect().right > document.documentElement.clientWidth + 1).length"""
    shown = """return [...document.querySelectorAll('.variant, .panel, .tabs')].map(e =>
        [e.className, e.offsetHeight > 0])"""
    page = write_page(tmp_path, LONG)
    with Browser.start(tmp_path, PAPER, 800) as opened:
        opened.open(page)
        before = opened.ask(shown)
        assert before == [["tabs", True], ["panel", True], ["variant", False], ["panel", False], ["variant", False]]
        opened.ask(ON_PAPER)
        assert opened.ask(wide) == 0
        assert opened.ask("return document.documentElement.scrollWidth") == PAPER
        assert opened.ask(shown) == [[name, name != "tabs"] for name, _ in before]
        cut = "return [...document.querySelectorAll('.scroll')].map(e => getComputedStyle(e).overflowX)"
        assert set(opened.ask(cut)) == {"visible"}
        opened.ask("document.querySelectorAll('th, td').forEach(cell => { cell.style.minWidth = '200px'; })")
        assert opened.ask(wide) > 0, "the twin"


def test_on_paper_it_is_light_and_says_which_number_the_samples_show(page: Path, tmp_path: Path) -> None:
    """Also where it was read in the dark; what says how to click is left out."""
    shown = "return [...document.querySelectorAll(arguments[0])].filter(e => e.offsetHeight > 0).length"
    paper = "return getComputedStyle(document.documentElement).getPropertyValue('--paper')"
    with Browser.start(tmp_path, PAPER, 800) as opened:
        opened.open(page)
        light = opened.ask(paper)
        opened.click("#theme")
        assert opened.ask(paper) != light
        assert opened.ask(shown, ".screen") > 1
        opened.ask(ON_PAPER)
        assert opened.ask(paper) == light
        assert opened.ask(shown, "#sample-tools select") == 2
        for hidden in (".screen", "#sample-find", "#which", "#theme", "footer button"):
            assert opened.ask(shown, hidden) == 0, hidden


def test_without_scripts_each_panel_has_its_heading_and_there_are_no_tabs(page: Path, tmp_path: Path) -> None:
    text = re.sub(r"<script.*?</script>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "plain.html").write_text(text, encoding="utf-8")
    with Browser.start(tmp_path) as opened:
        opened.open(tmp_path / "plain.html")
        headings = (
            "return [...document.querySelectorAll('.variant')].filter(e => e.offsetHeight > 0).map(e => e.textContent)"
        )
        assert opened.ask(headings) == ["whole frame, beside the paper", "inside the mask"]
        assert opened.ask("return document.querySelector('.tabs').offsetHeight") == 0


def test_arrow_keys_move_between_tabs(desk: Browser) -> None:
    state = """const all = (selector, view) => [...document.querySelectorAll(selector)].map(view);
        return [document.activeElement.textContent,
            all('#tables [role=tab]', tab => [tab.getAttribute('aria-selected'), tab.tabIndex]),
            all('#tables .panel', panel => panel.hidden)]"""
    first = ["whole frame, beside the paper", [["true", 0], ["false", -1]], [False, True]]
    second = ["inside the mask", [["false", -1], ["true", 0]], [True, False]]
    desk.click("#tables [role=tab]")
    assert desk.ask(state) == first
    for key, expected in (("right", second), ("right", first), ("left", second), ("home", first), ("end", second)):
        desk.press("#tables [aria-selected=true]", key)
        assert desk.ask(state) == expected, key


def test_a_heading_sorts_a_table_and_the_samples(desk: Browser) -> None:
    column = """return [...document.querySelectorAll(arguments[0])].map(cell => cell.textContent.trim())"""
    values = "#sample-rows tbody td:nth-child(2)"
    assert desk.ask(column, values) == [f"{20 + i}.00" for i in range(6)], "the worst come first"
    desk.click("#sample-rows th:nth-child(2) button")
    assert desk.ask(column, values) == [f"{25 - i}.00" for i in range(6)]
    desk.click("#sample-rows th:nth-child(1) button")
    assert desk.ask(column, "#sample-rows .open") == [f"s{i}" for i in range(6)]
    order = """const t = document.querySelector('#tables .panel:not([hidden]) table.data');
        return [...t.tBodies].flatMap(b => [...b.rows].map(r => r.cells[1].dataset.v)).filter(Boolean).map(Number)"""
    before = desk.ask(order)
    desk.click("#tables .panel:not([hidden]) thead tr:last-child th:nth-child(2) button")
    down = desk.ask(order)
    desk.click("#tables .panel:not([hidden]) thead tr:last-child th:nth-child(2) button")
    up = desk.ask(order)
    assert sorted(before) == sorted(down) == sorted(up)
    assert down != up


def test_a_sample_opens_to_every_rows_numbers_and_its_pictures(desk: Browser) -> None:
    assert desk.ask("return document.querySelectorAll('#sample-rows .details').length") == 0
    desk.click("#sample-rows tr[data-sample='s0'] .open")
    inside = "return [...document.querySelectorAll('.opened ' + arguments[0])].map(e => e.textContent)"
    assert desk.ask(inside, "tbody th") == ["Ours <mean>", "Input as albedo", "Noise ceiling"] * 2
    assert desk.ask(inside, "caption") == ["inside the mask", "whole frame"]
    assert desk.ask("return document.querySelectorAll('#sample-rows th:not([scope])').length") == 0
    assert desk.ask(inside, "tbody td:nth-child(2)") == ["20.00", "12.00", "45.00"] * 2
    assert desk.ask("return document.querySelector('.opened .sheet img').naturalWidth") == 48
    desk.click("#sample-rows tr[data-sample='s0'] .open")
    desk.click("#sample-rows tr[data-sample='s3'] .open")
    assert desk.ask(inside, "p") == ["No pictures of this sample in this page."]


def test_the_slider_moves_by_mouse_and_by_key_and_moves_the_line(desk: Browser) -> None:
    state = """const left = document.querySelector('#viewer-left'), line = document.querySelector('#viewer-line');
        const stage = document.querySelector('.stage').getBoundingClientRect();
        return [document.querySelector('#viewer-slider').value, getComputedStyle(left).clipPath,
                Math.round(100 * (line.getBoundingClientRect().left + 1 - stage.left) / stage.width)]"""
    desk.click(".compare")
    assert desk.ask("return document.activeElement.id") == "viewer-slider"
    value, clip, line = desk.ask(state)
    assert (value, line) == ("50", 50)
    desk.press("#viewer-slider", "right")
    assert desk.ask(state)[0] == "51"
    desk.drag(".stage", 0.3, 0.8)
    value, clipped, line = desk.ask(state)
    assert (value, line) == ("80", 80)
    assert clipped != clip
    desk.press("#viewer-slider", "home")
    assert desk.ask(state)[0] == "0"


def test_flip_shows_the_truth_in_place_and_next_goes_on(desk: Browser) -> None:
    clip = "return getComputedStyle(document.querySelector('#viewer-left')).clipPath"
    right = "return document.querySelector('#viewer-right').src"
    desk.click(".compare")
    before = desk.ask(clip)
    assert before != "none"
    desk.click("#viewer-flip")
    assert desk.ask(clip) == "none", "the whole frame is the truth"
    assert desk.ask(
        "return document.querySelector('#viewer-left').src === document.querySelector('.card .pic[id]').src"
    )
    desk.press("#viewer-slider", "f")
    assert desk.ask(clip) == before
    first = desk.ask(right)
    desk.click("#viewer-next")
    assert desk.ask(right) != first
    desk.press("#viewer-slider", "escape")
    assert desk.ask("return document.querySelector('#viewer').open") is False


def test_both_themes_are_legible(desk: Browser) -> None:
    """Contrast of text and page (WCAG): 4.5 at least, in light and in dark."""
    contrast = """const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).map(v => v / 255)
            .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
            return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
        const page = light(getComputedStyle(document.body).backgroundColor);
        return [...document.querySelectorAll('p, td, figcaption, h2')].map(e => {
            const own = light(getComputedStyle(e).color);
            return (Math.max(own, page) + 0.05) / (Math.min(own, page) + 0.05); }).reduce((a, b) => Math.min(a, b))"""
    grounds = []
    for theme in ("light", "dark"):
        desk.ask("document.documentElement.dataset.theme = arguments[0]", theme)
        assert desk.ask(contrast) >= 4.5, theme
        grounds.append(desk.ask("return getComputedStyle(document.body).backgroundColor"))
    assert grounds[0] != grounds[1]
    desk.ask("document.body.style.color = 'grey'; document.querySelector('h2').style.color = '#444'")
    assert desk.ask(contrast) < 4.5, "the twin"


def test_the_downloads_are_the_numbers(desk: Browser) -> None:
    """A download of file:// is a blob: what is put into it is read back."""
    caught = """const made = []; URL.createObjectURL = blob => { made.push(blob); return '#'; };
        document.querySelector('#download').click(); document.querySelector('#download-samples').click();
        return Promise.all(made.map(blob => blob.text())).then(texts => texts.map(JSON.parse))"""
    tables, samples = desk.ask(caught)
    assert tables
    assert len(samples[0]["samples"]) == 6
    assert not any("sheet" in sample for sample in samples[0]["samples"]), "numbers alone"


def test_a_missing_browser_is_an_error_that_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browser.shutil, "which", lambda name: None)
    with pytest.raises(RuntimeError, match=r"no chromium and chromedriver.*apt-get install chromium chromium-driver"):
        browser.executables()
