"""The figures in the sentences of *What the tables say* are those of the stored results, which its tables show."""

import re

import numpy as np
import pytest
from doc_blocks import DOCS, ROOT

from unirender_evaluation.claims import OPTIMISED_ON_MESH, OURS, SHADOWED, SPLIT_SUM
from unirender_evaluation.comparisons import Selection, compare, values_of
from unirender_evaluation.pages.findings import Question
from unirender_evaluation.pages.page import Page
from unirender_evaluation.pages.questions import (
    BY_TARGET,
    NOT_CLOSED,
    SECTIONS,
    STANDARD,
    by_target,
    edits,
    lit,
)
from unirender_evaluation.results.file import from_document, read_document
from unirender_evaluation.suites.suite import load_suite

ELSEWHERE = ("Joint training and the cycle", "What these tables cannot say")  # sections with figures of other records
ROWS = {OURS, NOT_CLOSED, SHADOWED, SPLIT_SUM, OPTIMISED_ON_MESH, "unedited-input", "true-maps", "shade-true-maps"}
ROWS |= {"true-light-16-x-32", "nvdiffrec-mitsuba-multi-view", "constant-object"}
FIGURE = re.compile(r"\d+(?:\.\d+)? ?(?:dB|°)")


def prose(page: str) -> str:
    """Its sentences in one line; no front matter, fenced blocks, tables and sections of other records."""
    text = re.sub(r"\A---.*?^---$|^```.*?^```$|^\|[^\n]*$", "", page, flags=re.M | re.S)
    sections = re.split(r"^## ", text, flags=re.M)
    return " ".join(" ".join(s for s in sections if not s.startswith(ELSEWHERE)).split())


@pytest.fixture
def page() -> Page:
    """Of the stored results the rows that the sentences below are about: to check all of them takes long."""
    document = read_document(ROOT / "evaluation" / "results" / "standard")
    document["records"] = [record for record in document["records"] if record["method"] in ROWS]
    standard = from_document(document, "standard")
    return Page(standard, standard, standard, load_suite("tiny"))


def sentences(page: Page) -> list[str]:
    """Parts of sentences, with the figures of the results."""

    def values(question: Question, row: str, view: str = STANDARD) -> list[float]:
        records = Selection(question.table, question.protocol).of(page.view(view).records)
        return list(values_of(records, row, question.key).values())

    def gain(question: Question, view: str = STANDARD) -> float:
        records = Selection(question.table, question.protocol).of(page.view(view).records)
        return compare(records, question.kind, question.key, question.a, question.b).difference.mean

    views = next(q for q in SECTIONS["many views"].questions if q.quantity == "albedo")
    albedo = sorted(values(views, views.a), reverse=True)
    shadows = [gain(q) for q in edits("given-light", SHADOWED, SPLIT_SUM, "")]
    shade = [np.mean(values(q, "shade-true-maps")) for q in edits("given-light", OURS, OURS, "")]
    loops = [-gain(q) for q in SECTIONS["physics"].questions[:2]]
    _, direction, matte, _ = lit(OURS, NOT_CLOSED, ("raw",))
    coarse = [np.mean(values(q, "true-light-16-x-32")) for q in lit(OURS, OURS, ("aligned",))[2:]]
    nearer = gain(lit(OURS, OPTIMISED_ON_MESH)[1])
    levelled, rough = (gain(by_target((OURS,), scale)[-1], BY_TARGET) for scale in ("aligned", "raw"))
    tinted = -gain(SECTIONS["without brightness, optimisation"].questions[-1])
    return [
        "{:.0f}, {:.0f} and {:.0f} dB on three objects and {:.0f} dB on the fourth".format(*albedo),
        *(f"are worth about {value:.0f} dB to the closed form" for value in shadows),
        *(f"(*shade(true maps)* in the [table](results.md), fewer pictures), stays at about {v:.0f} dB" for v in shade),
        "{:.0f} dB from what the true ones give under the picture's light, and {:.0f} dB under another".format(*loops),
        f"direction is off by {np.mean(values(direction, OURS)):.0f}°; a random one would be off by 90°",
        "wrong by {:.2f} on the matte and {:.2f} on the glossy ball".format(*coarse),
        f"takes {-gain(matte):.1f} off the matte ball's error",
        f"and {-gain(direction):.0f}° off the direction",
        f"it finds the brightest direction {nearer:.0f}° nearer",
        f"Edits to roughness 0.9 gain {levelled:.1f} dB instead of {rough:.1f}",
        f"relights *better* than the network, by {tinted:.0f} dB",
    ]


def test_figures_of_the_prose_are_those_of_the_results(page: Page) -> None:
    """All with a unit: a sentence with another one has to be added above."""
    text = prose((DOCS / "findings.md").read_text(encoding="utf-8"))
    for sentence in dict.fromkeys(sentences(page)):
        assert sentence in text
        text = text.replace(sentence, "")
    assert not FIGURE.findall(text + prose((ROOT / "README.md").read_text(encoding="utf-8")))
