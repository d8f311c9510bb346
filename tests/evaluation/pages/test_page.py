"""The page *What the tables say*: what it asks, and its tables of results that have the answers or lack them."""

import ast
import inspect

import pytest
from doc_blocks import DOCS, blocks
from small_results import small_results

from unirender.errors import UnirenderError
from unirender_evaluation.pages import page as page_module
from unirender_evaluation.pages.findings import Question
from unirender_evaluation.pages.page import Page
from unirender_evaluation.pages.questions import BY_TARGET, SECTIONS, VIEWS, Section
from unirender_evaluation.suites.suite import load_suite

CELL, TAGS = "{code-cell} python", ":tags: [remove-input]\n"
ALBEDO = Question("albedo", "inverse", "single-image", "albedo", "psnr", "ours-mean", "input-as-albedo")


@pytest.fixture
def page() -> Page:
    one = small_results()
    return Page(one, one, one, load_suite("tiny"))


def calls() -> list[tuple[str, list[str]]]:
    """What the last line of each cell of the page calls, and with what."""
    cells = [block.text.removeprefix(TAGS) for block in blocks(DOCS / "findings.md") if block.language == CELL]
    last = [ast.parse(cell.splitlines()[-1], mode="eval").body for cell in cells]
    found = [line for line in last if isinstance(line, ast.Call)]
    assert len(found) == len(cells) > 0
    return [(ast.unparse(line.func), [ast.literal_eval(word) for word in line.args]) for line in found]


def test_the_page_calls_what_there_is() -> None:
    """The build of the documentation runs its cells, which takes a minute."""
    for called, words in calls():
        name = called.removeprefix("page.")
        inspect.signature(getattr(Page, name)).bind(None, *words)


def test_the_page_shows_every_section_once() -> None:
    """All of their lines count in the correction."""
    assert sorted(words[0] for called, words in calls() if called == "page.table") == sorted(SECTIONS)


def test_no_question_is_asked_twice() -> None:
    """One that is would count twice where all are corrected for."""
    asked = [(section.view, question) for section in SECTIONS.values() for question in section.questions]
    assert len({question for _, question in asked}) == len(asked)
    assert {view for view, _ in asked} == set(VIEWS)


def test_a_table_is_markdown_and_the_correction_counts_its_lines(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three objects that differ alike: p is 0."""
    monkeypatch.setattr(page_module, "SECTIONS", {"one": Section((ALBEDO,))})
    assert "| **A is better** | 3 of 3 (4) |" in page.table("one").replace("\N{NO-BREAK SPACE}", " ")
    assert page.table("one")._repr_markdown_() == str(page.table("one"))
    assert page.correction() == "Of 1 lines 1 say that a row is better; in 1 of them that is **bold**."


def test_what_has_no_answers_stops_the_page(page: Page) -> None:
    """A row by another name would be a line of "not run", which nobody looks for."""
    with pytest.raises(UnirenderError, match="nvdiffrec-mitsuba"):
        page.table("optimisation")


def test_edits_by_their_target_are_rows_of_their_own(page: Page) -> None:
    assert {info.key for info in page.view(BY_TARGET).run.methods} >= {"ours-mean@to 0.1", "ours-mean@to 0.9"}
