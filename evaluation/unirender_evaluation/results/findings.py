"""Questions put to stored results, answered in Markdown: what the page *What the tables say* is made of, and the
table at the top of the README.

Nothing is measured here: every figure is a mean of records, or a paired difference of two rows over the samples that
both answered, with the interval over objects.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unirender.errors import UnirenderError
from unirender_evaluation.claims import MASKED, MaskedNumber
from unirender_evaluation.comparisons import Comparison, Selection, compare, values_of
from unirender_evaluation.metrics import METRICS, SCALES, Metric, Scale, Variant, metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.results.data import Results
from unirender_evaluation.statistics import mean_estimate
from unirender_evaluation.tables.formats import estimate_text
from unirender_evaluation.tables.published import published_tables
from unirender_evaluation.tables.text import markdown_row

NOT_RUN = "not run"
_MATERIAL = re.compile(r"_m(\d{3})_r(\d{3})$")  # of a sample with one number each; others have maps of their own
# Metallic and roughness in thirds: the outer ones are where a material shows what it is.
_THIRDS = (("0 to 0.3", 0.0, 0.35), ("0.4 to 0.6", 0.35, 0.65), ("0.7 to 1", 0.65, 1.01))


@dataclass(frozen=True)
class Question(MaskedNumber):
    """One number of row `a` against that of row `b`, or of the best trivial row (`against_trivial`).

    `scale`: how it is aligned, where its metric has such variants.
    """

    text: str
    table: str
    protocol: str
    quantity: str
    metric: str
    a: str
    b: str = ""
    scale: Scale = "raw"


def run_line(results: Results) -> str:
    """Which results these are, in a line."""
    run = results.run
    objects = len({record.object for record in results.records})
    carried = f" ({run.carried})" if run.carried else ""
    return (
        f"`{run.suite}`: {objects} objects at {run.resolution} x {run.resolution} pixels, {len(results.records):,} "
        f"answers; truth `{run.suite_hash[:12]}`, code `{run.code}`, {run.date}{carried}"
    )


def answers(results: Results, questions: Sequence[Question]) -> str:
    """A table with a line for each question: both means, their difference with its interval, and the verdict."""
    lines = [_answer(results, question) for question in questions]
    head = ["", "A", "B", "A", "B", "A - B", "", "pairs (objects)"]
    return markdown_table(head, lines, left=3)


def _answer(results: Results, question: Question) -> list[str]:
    labels = [label_of(results, key) for key in (question.a, question.b)]
    records = Selection(question.table, question.protocol).of(results.records)
    a, b = (values_of(records, key, question.key) for key in (question.a, question.b))
    shared = sorted(a.keys() & b.keys())
    if not shared:
        return [question.text, *labels, NOT_RUN, NOT_RUN, "", "", "0"]
    metric = question.kind
    found = compare(records, metric, question.key, question.a, question.b)
    means = [f"{np.mean([values[sample] for sample in shared]):.{metric.decimals}f}" for values in (a, b)]
    counts = f"{found.difference.n} ({found.difference.clusters})"
    return [question.text, *labels, *means, _difference(found, metric), _word(found), counts]


def _difference(found: Comparison, metric: Metric) -> str:
    difference, decimals = found.difference, metric.decimals
    return f"{difference.mean:+.{decimals}f} [{difference.low:+.{decimals}f}, {difference.high:+.{decimals}f}]"


def _word(found: Comparison) -> str:
    if not found.decided:
        return "one object: no interval"
    return "**A is better**" if found.a_beats_b else "**B is better**" if found.b_beats_a else "no difference shown"


def against_trivial(results: Results, questions: Sequence[Question]) -> str:
    """A table with a line for each question: row `a`, the best trivial row, their difference, the best possible.

    That is the noise ceiling where there is one. Questions that row `a` or all trivial rows have no answer to are left
    out.

    Raises:
        UnirenderError: no question is left.
    """
    lines = [line for question in questions if (line := _against_trivial(results, question))]
    if not lines:
        raise UnirenderError("against trivial rows: no question has answers of our row and of a trivial one; run both")
    return markdown_table(
        ["", label_of(results, questions[0].a), "without a model", "difference [95 %]", "perfect"], lines
    )


def _against_trivial(results: Results, question: Question) -> list[str] | None:
    metric = question.kind
    records = Selection(question.table, question.protocol).of(results.records)

    def means(kind: str) -> dict[str, float]:
        rows = [info.key for info in results.run.methods if info.kind == kind]
        found = {row: list(values_of(records, row, question.key).values()) for row in rows}
        return {row: float(np.mean(values)) for row, values in found.items() if values}

    ours, trivial, ceilings = means("ours").get(question.a), means("trivial"), means("ceiling")
    if ours is None or not trivial:
        return None
    best = min(trivial, key=lambda row: -trivial[row] if metric.higher_is_better else trivial[row])
    found = compare(records, metric, question.key, question.a, best)
    perfect = ceilings.get("noise-ceiling", metric.perfect)
    unit = f" ({metric.unit})" if metric.unit else ""
    return [
        f"{question.text}, {metric.label}{unit} {metric.arrow}",
        f"{ours:.{metric.decimals}f}",
        f"{trivial[best]:.{metric.decimals}f} ({label_of(results, best)})",
        _difference(found, metric),
        "∞" if math.isinf(perfect) else f"{perfect:.{metric.decimals}f}",
    ]


def together(runs: Mapping[str, Results]) -> Results:
    """Runs of one suite as one, so that rows of different runs stand side by side: row `ours-mean` of the run named
    `small` is `ours-mean@small`, and its label says the name.

    Their truths may have been rendered on different processors, which differ by far less than the truth's noise.

    Raises:
        UnirenderError: no run, or runs of different suites or sizes.
    """
    suites = {(results.run.suite, results.run.resolution) for results in runs.values()}
    if len(suites) != 1:
        raise UnirenderError(f"runs to put side by side: got suites and sizes {sorted(suites)}, expected the same one")
    methods = [
        replace(info, key=f"{info.key}@{name}", label=f"{info.label}, {name}")
        for name, results in runs.items()
        for info in results.run.methods
    ]
    records = [replace(r, method=f"{r.method}@{name}") for name, results in runs.items() for r in results.records]
    first = next(iter(runs.values()))
    return replace(first, run=replace(first.run, methods=tuple(methods)), records=tuple(records))


def by_material(results: Results, method: str, numbers: Sequence[tuple[str, str]]) -> str:
    """Means of a row of the inverse table by the true material, ± half of their intervals over objects.

    Args:
        results: a run's.
        method: the row.
        numbers: (quantity, metric) of the columns.
    """
    records = [r for r in Selection("inverse", "single-image").of(results.records) if r.method == method]
    groups: list[tuple[str, Callable[[float, float], bool]]] = [("all with one number each", lambda m, r: True)]
    groups += [(f"metallic {name}", _between(low, high, 0)) for name, low, high in _THIRDS]
    groups += [(f"roughness {name}", _between(low, high, 1)) for name, low, high in _THIRDS]
    lines = []
    for name, belongs in groups:
        lines.append([name, *_means([r for r in records if (m := material_of(r)) and belongs(*m)], numbers)])
    own = [record for record in records if material_of(record) is None]
    if own:
        lines.append(["with maps of their own", *_means(own, numbers)])
    return markdown_table(["true material", "pictures", *map(_column, numbers)], lines)


def material_of(record: Record) -> tuple[float, float] | None:
    """(metallic, roughness) of a sample's material by its name; None where it has maps."""
    found = _MATERIAL.search(record.sample)
    return (int(found[1]) / 100, int(found[2]) / 100) if found else None


def by_object(results: Results, method: str, numbers: Sequence[tuple[str, str]], count: int) -> str:
    """Means of the objects on which a row is worst, by the first number: the worst `count`."""
    records = [r for r in Selection("inverse", "single-image").of(results.records) if r.method == method]
    objects = dict.fromkeys(record.object for record in records)
    quantity, name = numbers[0]
    key, metric = metric_key(quantity, METRICS[name], MASKED), METRICS[name]
    means = {o: float(np.mean([r.values[key] for r in records if r.object == o and key in r.values])) for o in objects}
    worst = sorted(objects, key=lambda o: means[o] if metric.higher_is_better else -means[o])[:count]
    lines = [[o, *_means([r for r in records if r.object == o], numbers)] for o in worst]
    return markdown_table(["object", "pictures", *map(_column, numbers)], lines)


def by_scale(results: Results, methods: Sequence[str]) -> str:
    """The albedo's PSNR of rows: as it is, and after a least-squares factor for the picture or for each channel.

    Means are over the pictures that all of these rows have, those that have none left aside.
    """
    records = Selection("inverse", "single-image").of(results.records)
    keys = [metric_key("albedo", METRICS["psnr"], Variant("masked", "srgb", scale)) for scale in SCALES]
    rows = {m: {r.sample: r for r in records if r.method == m and keys[0] in r.values} for m in methods}
    shared = set.intersection(*(set(found) for found in rows.values() if found)) if any(rows.values()) else set()
    lines = []
    for method, found in rows.items():
        values = [[found[sample].values[key] for sample in shared] if found else [] for key in keys]
        means = [f"{np.mean(own):.2f}" if own else NOT_RUN for own in values]
        lines.append([label_of(results, method), *means, str(len(values[0]))])
    return markdown_table(["", "as it is", "one factor", "one a channel", "pictures"], lines)


def published_against_constant(results: Results) -> str:
    """The paper's errors of metallic and roughness beside those of one constant, which looks at no picture."""
    records = Selection("inverse", "single-image").of(results.records)
    keys = [metric_key(quantity, METRICS["mse"], MASKED) for quantity in ("metallic", "roughness")]
    lines = [
        [f"{row.label} (*published*)", f"{row.values['metallic.mse']:.4f}", f"{row.values['roughness.mse']:.4f}"]
        for row in published_tables()["inverse"]
        if {"metallic.mse", "roughness.mse"} <= row.values.keys()
    ]
    for method in ("constant-0-5", "ours-mean"):
        found = [values_of(records, method, key) for key in keys]
        shown = [f"{np.mean(list(values.values())):.4f}" if values else NOT_RUN for values in found]
        lines.append([f"{label_of(results, method)} (measured here)", *shown])
    return markdown_table(["", "metallic MSE", "roughness MSE"], lines)


def seconds(results: Results, rows: Sequence[tuple[str, str, str]]) -> str:
    """Median seconds of an answer as the run recorded them, for (table, protocol, method)."""
    lines = []
    for table, protocol, method in rows:
        records = Selection(table, protocol).of(results.records)
        times = [r.seconds for r in records if r.method == method and r.seconds is not None]
        shown = f"{np.median(times):.2f}" if times else NOT_RUN
        lines.append([label_of(results, method), f"{table}, {protocol}", shown, str(len(times))])
    return markdown_table(["", "question", "seconds", "answers"], lines, left=2)


def _means(records: Sequence[Record], numbers: Sequence[tuple[str, str]]) -> list[str]:
    cells = [str(len(records))]
    for quantity, name in numbers:
        key = metric_key(quantity, METRICS[name], MASKED)
        own = [record for record in records if key in record.values]
        found = mean_estimate([r.values[key] for r in own], [r.object for r in own]) if own else None
        cells.append(estimate_text(found, METRICS[name].decimals))
    return cells


def _between(low: float, high: float, which: int) -> Callable[[float, float], bool]:
    return lambda *material: low <= material[which] < high


def label_of(results: Results, key: str) -> str:
    found = [info.label for info in results.run.methods if info.key == key]
    return found[0] if found else key


def _column(number: tuple[str, str]) -> str:
    quantity, metric = number[0], METRICS[number[1]]
    return f"{quantity}, {metric.label} ({metric.unit})" if metric.unit else f"{quantity}, {metric.label}"


def markdown_table(head: Sequence[str], lines: Sequence[Sequence[str]], left: int = 1) -> str:
    if any(len(line) != len(head) for line in lines):
        raise UnirenderError(f"table: got lines of {sorted({len(line) for line in lines})} cells, expected {len(head)}")
    rule = [":--" if i < left else "--:" for i in range(len(head))]
    return "\n".join(map(markdown_row, (head, rule, *lines))) + "\n"
