"""`bench physics`: every physics test on Mitsuba, our method, the composite and the test's broken twin, side by side.

    physics.json   every value, by test, row and scene; the settings
    physics.md     the table: means with 95 % intervals over objects, what a perfect renderer scores, and whether the
                   test refuses its twin

Rows: *Mitsuba* renders with its path tracer and decomposes into its own buffers; *shade (true maps)* is one bounce and
one point per pixel, and the loops' ceiling; *ours* and *composite* are the rows of `bench run`. The ambiguity is asked
of Mitsuba's own posterior and of our samples (mode `sample`); who has none has no value.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender_evaluation.bounds import Shade
from unirender_evaluation.methods.composite import Composite
from unirender_evaluation.methods.method import Image, quantise
from unirender_evaluation.physics.ambiguity import POSTERIOR, Points, material_point
from unirender_evaluation.physics.definition import PhysicsTest
from unirender_evaluation.physics.questions import Posterior, true_maps
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.physics.tests import TESTS
from unirender_evaluation.physics.tracer import PathTracer
from unirender_evaluation.rows import SAMPLE_STEPS
from unirender_evaluation.statistics import Estimate, mean_estimate, unprinted_note
from unirender_evaluation.studies.folder import write_files
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite, material_key
from unirender_evaluation.tables.formats import estimate_text
from unirender_evaluation.tables.text import markdown_row
from unirender_evaluation.truth.render import item_seed

MITSUBA, SHADE, OURS, COMPOSITE, TWIN = "Mitsuba", "shade (true maps)", "Ours", "composite", "broken twin"
HEADING = "### What each row scores"
ROWS = (MITSUBA, SHADE, OURS, COMPOSITE, TWIN)


@dataclass(frozen=True)
class Value:
    """What one row scores in one test on one scene."""

    test: str
    row: str
    scene: str
    object: str
    value: float


def measure(suite: Suite, scenes: Sequence[Scene], ours: Any, spp: int) -> Iterator[list[Value]]:
    """The values of one test after another, scene by scene; `ours` renders and decomposes, its `pipeline` samples."""
    sampler = Sampler(ours.pipeline)
    for scene in scenes:
        stage = Stage(suite, scene)
        tracer = PathTracer(stage, spp)
        for test in TESTS.values():
            yield values_of(test, stage, subjects(test, tracer, ours, sampler))


def values_of(test: PhysicsTest, stage: Stage, asked: Mapping[str, Any]) -> list[Value]:
    """What each row scores in a test on a scene, as the table of `bench run` has it: a law that is asked of black
    pictures, or of none but clipped pixels, has no value.
    """
    scores = {row: test.run(subject, stage) for row, subject in asked.items()}
    key, name = stage.scene.key, stage.scene.object
    return [Value(test.name, row, key, name, score) for row, score in scores.items() if not math.isnan(score)]


def subjects(test: PhysicsTest, tracer: PathTracer, ours: Any, sampler: Posterior | None = None) -> dict[str, Any]:
    """Who answers a test: name of the row -> renderer, decomposer or posterior."""
    if test.asks == "render":
        return {
            MITSUBA: tracer.render,
            SHADE: Shade().render,
            OURS: ours.render,
            COMPOSITE: Composite().render,
            TWIN: test.twin,
        }
    if test.asks == "sample":
        return {MITSUBA: _perfect, **({} if sampler is None else {OURS: sampler}), TWIN: test.twin}
    return {MITSUBA: _buffers, SHADE: true_maps, OURS: partial(_found, ours.decompose), TWIN: test.twin}


def _buffers(stage: Stage, material: MetallicRoughness, _: Image) -> Intrinsics:
    return stage.mitsuba.maps(material)


def _found(decompose: Callable[..., Intrinsics], stage: Stage, _: MetallicRoughness, image: Image) -> Intrinsics:
    """What a method finds: it is handed what a camera would store, nothing else."""
    return decompose(**_shown(stage, image))


def _shown(stage: Stage, image: Image) -> dict[str, Any]:
    return {"image_srgb": quantise(image, stage.mask), "mask": stage.mask, "camera": stage.suite.spec.camera}


def _perfect(stage: Stage, *_: object) -> Points:
    return stage.explanations.posterior


class Sampler:
    """The materials of a pipeline's samples; those for one picture are drawn once, since several tests ask."""

    def __init__(self, pipeline: Any) -> None:
        self._pipeline = pipeline
        self._drawn: dict[tuple[str, MetallicRoughness], Points] = {}  # by scene and material: they make the picture

    def __call__(self, stage: Stage, material: MetallicRoughness, image: Image) -> Points:
        asked = (stage.scene.key, material)
        if asked not in self._drawn:
            import torch

            seed = item_seed("posterior", stage.scene.key, material_key(material))
            generator = torch.Generator().manual_seed(seed)
            steps = {"mode": "sample", "num_inference_steps": SAMPLE_STEPS, "num_samples": POSTERIOR}
            found = self._pipeline.decompose(**_shown(stage, image), **steps, generator=generator)
            self._drawn[asked] = np.stack([material_point(maps, stage.mask) for maps in found.samples])
        return self._drawn[asked]


@dataclass(frozen=True)
class Finding:
    """One line of the table: a test, and what each row that answers it scores, by the row's name."""

    test: PhysicsTest
    rows: dict[str, Estimate]

    @property
    def refused(self) -> bool:
        """Whether the test tells its twin from Mitsuba; not where one of them has no value."""
        if not {TWIN, MITSUBA} <= self.rows.keys():
            return False
        return self.test.fails(self.rows[TWIN].mean, self.rows[MITSUBA].mean)


def findings(values: Sequence[Value]) -> list[Finding]:
    """Means and intervals by test and row; samples of one object are one cluster."""
    found = []
    for test in TESTS.values():
        rows = {}
        for row in ROWS:
            own = [v for v in values if (v.test, v.row) == (test.name, row)]
            if own:
                rows[row] = mean_estimate([v.value for v in own], [v.object for v in own])
        found.append(Finding(test, rows))
    return found


def markdown(found: Sequence[Finding], settings: dict[str, Any]) -> str:
    """The table with its protocol."""
    lines = [
        HEADING,
        "",
        markdown_row(("Test", "expected", *ROWS, "twin refused")),
        markdown_row((":--", *["--:"] * (1 + len(ROWS)), ":--")),
    ]
    for finding in found:
        test = finding.test
        expected = test.expected if isinstance(test.expected, str) else f"{test.expected:g}"
        cells = [estimate_text(finding.rows.get(row), test.metric.decimals) for row in ROWS]
        verdict = "PASS" if finding.refused else "FAIL"
        unit = f", {test.metric.unit}" if test.metric.unit else ""
        heading = f"{test.label} ({test.metric.label}{unit}) {test.metric.arrow}"
        lines.append(markdown_row((heading, expected, *cells, f"{verdict}: {test.twin_is}")))
    protocol = " · ".join(f"{name}: {value}" for name, value in settings.items())
    notes = unprinted_note(estimate for finding in found for estimate in finding.rows.values())
    lines += [line for note in notes for line in ("", note)]
    return "\n".join([*lines, "", f"Protocol: {protocol}.", ""])


def write(out: Path, values: Sequence[Value], settings: dict[str, Any]) -> list[Finding]:
    """Writes both files; returns the table's lines."""
    found = findings(values)
    tests = [
        {
            "name": f.test.name,
            "formula": f.test.formula,
            "unit": f.test.metric.unit,
            "direction": "higher is better" if f.test.metric.higher_is_better else "lower is better",
            "expected": f.test.expected,
            "margin": f.test.margin,
            "twin": f.test.twin_is,
            "twin_refused": f.refused,
        }
        for f in found
    ]
    text = json.dumps({"settings": settings, "tests": tests, "values": [asdict(v) for v in values]}, indent=1)
    write_files(out, {"physics.json": text + "\n", "physics.md": markdown(found, settings)})
    return found
