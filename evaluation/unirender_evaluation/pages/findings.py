"""Questions put to stored results, answered in Markdown: what the page *What the tables say* is made of, and the
table at the top of the README.

Nothing is measured here: every figure is a mean of records, or a paired difference of two rows over the samples that
both answered, with the interval over objects.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unirender.errors import UnirenderError
from unirender_evaluation.claims import MASKED, MaskedNumber
from unirender_evaluation.comparisons import Comparison, Selection, compare, values_of, without_rounding
from unirender_evaluation.metrics import METRICS, Metric, Scale, metric_key
from unirender_evaluation.results.data import Results
from unirender_evaluation.statistics import FEWEST, Estimate, holm, paired_p_value
from unirender_evaluation.tables.published import published_tables
from unirender_evaluation.tables.text import markdown_row

NOT_RUN = "not run"


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


def answers(results: Results, questions: Sequence[Question], sure: Collection[Question]) -> str:
    """A table with a line for each question: both means, their difference with its interval, the verdict, and on how
    many objects row A is better.

    Args:
        results: a run's.
        questions: the lines.
        sure: those whose verdict is printed **bold**, e.g. what is left of all by `sure_of`.
    """
    lines = [_answer(results, question, question in sure) for question in questions]
    head = ["", "A", "B", "A", "B", "A - B", "", "A is better on objects (pairs)"]
    return markdown_table(head, lines, left=3)


def _answer(results: Results, question: Question, sure: bool) -> list[str]:
    labels = [label_of(results, key) for key in (question.a, question.b)]
    records = Selection(question.table, question.protocol).of(results.records)
    a, b = (values_of(records, key, question.key) for key in (question.a, question.b))
    shared = sorted(a.keys() & b.keys())
    if not shared:
        return [question.text, *labels, NOT_RUN, NOT_RUN, "", "", "0"]
    metric = question.kind
    found = compare(records, metric, question.key, question.a, question.b)
    means = [f"{np.mean([values[sample] for sample in shared]):.{metric.decimals}f}" for values in (a, b)]
    settled = without_rounding(a, b)
    objects = {record.sample: record.object for record in records}
    gains: dict[str, list[float]] = {}
    for sample in shared:
        gains.setdefault(objects[sample], []).append(a[sample] - settled[sample])
    better = sum(np.mean(own) > 0 if metric.higher_is_better else np.mean(own) < 0 for own in gains.values())
    counts = f"{better} of {len(gains)} ({len(shared)})"
    return [question.text, *labels, *means, interval_text(found.difference, metric), _word(found, sure), counts]


def interval_text(difference: Estimate, metric: Metric) -> str:
    """A difference with its interval, where it has one, in the digits of its metric."""
    low, high, decimals = difference.low, difference.high, metric.decimals
    interval = f" [{low:+.{decimals}f}, {high:+.{decimals}f}]" if math.isfinite(low) else ""
    return f"{difference.mean:+.{decimals}f}{interval}"


def _word(found: Comparison, sure: bool) -> str:
    if not found.decided:
        return f"fewer than {FEWEST} objects: no interval"
    if not found.a_beats_b and not found.b_beats_a:
        return "no difference shown"
    text = f"{'A' if found.a_beats_b else 'B'} is better"
    return f"**{text}**" if sure else text


def sure_of(asked: Sequence[tuple[Results, Question]]) -> set[Question]:
    """The questions whose two rows differ by Holm's correction for all of them, whose rows have run; p is that of
    Student's t over objects."""
    ran, p_values = [], []
    for results, question in asked:
        records = Selection(question.table, question.protocol).of(results.records)
        a, b = (values_of(records, key, question.key) for key in (question.a, question.b))
        if a.keys() & b.keys():
            ran.append(question)
            p_values.append(paired_p_value(a, without_rounding(a, b), {r.sample: r.object for r in records}))
    return {question for question, refused in zip(ran, holm(p_values), strict=True) if refused}


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
    """Ours beside the best row without a model and the ceiling; None where one of them has no answer."""
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
        interval_text(found.difference, metric),
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


def label_of(results: Results, key: str) -> str:
    found = [info.label for info in results.run.methods if info.key == key]
    return found[0] if found else key


def markdown_table(head: Sequence[str], lines: Sequence[Sequence[str]], left: int = 1) -> str:
    """A Markdown table, whose first `left` columns are set to the left; an error where a line has another length."""
    if any(len(line) != len(head) for line in lines):
        raise UnirenderError(f"table: got lines of {sorted({len(line) for line in lines})} cells, expected {len(head)}")
    rule = [":--" if i < left else "--:" for i in range(len(head))]
    return "\n".join(map(markdown_row, (head, rule, *lines))) + "\n"
