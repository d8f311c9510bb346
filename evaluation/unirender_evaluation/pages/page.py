"""The tables of the page *What the tables say*, made from the stored results as it is built: a call each.

    page = Page.read(Path("evaluation"))
    page.table("optimisation")

shows in a notebook what `answers` makes of that section's questions (`questions.SECTIONS`).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from unirender.arguments import as_path
from unirender.errors import UnirenderError
from unirender_evaluation.claims import OPTIMISED, OPTIMISED_ON_MESH, OURS, REFINED
from unirender_evaluation.pages.findings import (
    NOT_RUN,
    Question,
    answers,
    published_against_constant,
    run_line,
    seconds,
    sure_of,
    together,
)
from unirender_evaluation.pages.groups import by_kind, by_material, by_object, by_scale
from unirender_evaluation.pages.questions import (
    BOTH_SIZES,
    BY_KIND,
    BY_TARGET,
    DECOMPOSED,
    EDITED,
    MAPS,
    SAMPLED,
    SECTIONS,
    STANDARD,
    TARGETS,
)
from unirender_evaluation.results.data import Results
from unirender_evaluation.results.file import read_results
from unirender_evaluation.results.verdict import claims_table
from unirender_evaluation.suites.suite import Suite, load_suite

_BETTER = re.compile(r"\| (\*\*)?[AB] is better(?:\*\*)? \|")  # a cell of `answers`
WORST = 6  # objects that are listed
REAL, PROCEDURAL = "real meshes", "procedural objects"


class Shown(str):
    """Markdown that a notebook shows as such."""

    __slots__ = ()

    def _repr_markdown_(self) -> str:
        return str(self)


@dataclass(frozen=True)
class Page:
    """The stored results that the page is made of."""

    standard: Results  # `small` on the suite `standard`, of which all tables are that say nothing else
    enlarged: Results  # `tiny` on the same suite, its maps enlarged
    tiny: Results  # `tiny` on its own suite
    suite: Suite  # `standard`

    @classmethod
    def read(cls, evaluation: Path | str) -> "Page":
        """From the folder `evaluation` of a checkout.

        Raises:
            UnirenderError: a results file or the suite is not there, or cannot be read.
        """
        folder = as_path(evaluation)
        standard, enlarged, tiny = (read_results(folder / "results" / n) for n in ("standard", "standard-tiny", "tiny"))
        return cls(standard, enlarged, tiny, load_suite(folder / "suites" / "standard" / "standard.toml"))

    def runs(self) -> Shown:
        """A line for each run."""
        named = (("small", self.standard), ("tiny", self.enlarged), ("tiny", self.tiny))
        return Shown("\n".join(f"- `{checkpoint}` on {run_line(results)}" for checkpoint, results in named))

    def view(self, name: str) -> Results:
        """One of `questions.VIEWS`."""
        return self._views[name]

    def table(self, section: str) -> Shown:
        """The answers to one of `SECTIONS`; a verdict is bold if it holds for all lines of the page together.

        Raises:
            UnirenderError: the stored results have no answers to one of its questions.
        """
        asked = SECTIONS[section]
        lines = answers(self.view(asked.view), asked.questions, self._sure)
        if found := next((line for line in lines.splitlines() if f"| {NOT_RUN} |" in line), None):
            raise UnirenderError(
                f"{section!r} of the findings: no sample has both rows of {found}; store a run of both"
            )
        return Shown(lines)

    def correction(self) -> Shown:
        """How many lines there are, how many say that a row is better, and how many of them are bold."""
        lines = sum(len(section.questions) for section in SECTIONS.values())
        stars = [found[1] for name in SECTIONS for found in _BETTER.finditer(self.table(name))]
        bold = sum(map(bool, stars))
        return Shown(f"Of {lines} lines {len(stars)} say that a row is better; in {bold} of them that is **bold**.")

    def by_kind(self) -> Shown:
        """What ours gains on procedural objects and on real meshes."""
        kinds = {s.object: REAL if s.family == "mesh" else PROCEDURAL for s in self.suite.scenes}
        return Shown(by_kind(self.standard, BY_KIND, dict(sorted(kinds.items(), key=lambda item: item[1]))))

    def seconds(self) -> Shown:
        """What a decomposition takes."""
        rows = (OURS, SAMPLED, OPTIMISED, OPTIMISED_ON_MESH, REFINED)
        return Shown(seconds(self.standard, [(*DECOMPOSED, row) for row in rows]))

    def published_against_constant(self) -> Shown:
        """The paper's errors of metallic and roughness beside a constant's."""
        return Shown(published_against_constant(self.standard))

    def by_material(self) -> Shown:
        """Our maps by the true material."""
        return Shown(by_material(self.standard, OURS, MAPS))

    def by_scale(self) -> Shown:
        """Our albedo by how it is aligned."""
        return Shown(by_scale(self.standard, [OURS, "input-as-albedo"]))

    def worst(self) -> Shown:
        """The objects of our worst albedo."""
        return Shown(by_object(self.standard, OURS, MAPS, WORST))

    def under_other_lights(self) -> Shown:
        """The verdict on each claim, over objects and over objects and lights."""
        table = claims_table(self.standard.run, self.standard.records, self.standard.lights, stated=False)
        return Shown(table.markdown().partition("\n\n")[2])  # without its title

    @cached_property
    def _sure(self) -> set[Question]:
        asked = [(self.view(s.view), question) for s in SECTIONS.values() for question in s.questions]
        return sure_of(asked)

    @cached_property
    def _views(self) -> Mapping[str, Results]:
        def edited_to(end: str) -> Results:
            chosen = (r for r in self.standard.records if (r.table, r.protocol) == EDITED and r.sample.endswith(end))
            return replace(self.standard, records=tuple(chosen))

        return {
            STANDARD: self.standard,
            BY_TARGET: together({target: edited_to(end) for target, end in TARGETS.items()}),
            BOTH_SIZES: together({"small": self.standard, "tiny": self.enlarged}),
        }
