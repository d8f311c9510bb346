"""Parts of a suite beside one another: one row by the true material, by the object, by how its albedo is aligned; and
what a row gains over another on two kinds of objects.

Two parts are compared by the difference of their means, whose interval is over objects (`contrast`): that each has an
interval of its own, and that the two overlap or do not, decides nothing.
"""

import math
import re
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from unirender.errors import UnirenderError
from unirender_evaluation.claims import MASKED
from unirender_evaluation.comparisons import Selection, values_of
from unirender_evaluation.metrics import METRICS, SCALES, Metric, Variant, metric_key
from unirender_evaluation.pages.findings import NOT_RUN, Question, interval_text, label_of, markdown_table
from unirender_evaluation.records import Record
from unirender_evaluation.results.data import Results
from unirender_evaluation.statistics import FEWEST, Estimate, mean_estimate, student_half_width
from unirender_evaluation.tables.formats import MISSING, estimate_text

Number = tuple[str, str]  # quantity, metric
_MATERIAL = re.compile(r"_m(\d{3})_r(\d{3})$")  # of a sample with one number each; others have maps of their own
# Metallic and roughness in thirds: the outer ones are where a material shows what it is.
_THIRDS = (("0 to 0.3", 0.0, 0.35), ("0.4 to 0.6", 0.35, 0.65), ("0.7 to 1", 0.65, 1.01))


def contrast(
    a: Sequence[float], b: Sequence[float], clusters_a: Sequence[Hashable], clusters_b: Sequence[Hashable]
) -> Estimate:
    """Mean of `a` less mean of `b`, two parts of the samples of a row, with its 95 % interval over clusters.

    Student's, with one degree of freedom less than the part of fewer clusters has. A cluster may have samples in both
    parts, in any numbers, or in one.

    Args:
        a: values of one part, finite.
        b: values of the other, finite.
        clusters_a: what each of `a` belongs to, e.g. its object.
        clusters_b: of `b`.

    Returns:
        No interval (NaN) where a part has fewer than `statistics.FEWEST` clusters.

    Raises:
        UnirenderError: a part is empty or has a value that is not finite, or lengths differ.
    """
    parts = ((np.asarray(a, np.float64), list(clusters_a)), (np.asarray(b, np.float64), list(clusters_b)))
    for x, names in parts:
        if not x.size or len(names) != x.size or not np.isfinite(x).all():
            raise UnirenderError(
                f"contrast: got {x.size} values of {len(names)} clusters, expected as many, at least one, all finite"
            )
    labels = {name: i for i, name in enumerate(dict.fromkeys([*clusters_a, *clusters_b]))}
    pulls = np.zeros(len(labels))  # of the clusters, on the difference
    for sign, (x, names) in zip((1, -1), parts, strict=True):
        np.add.at(pulls, [labels[name] for name in names], sign * (x - x.mean()) / x.size)
    mean, fewest = float(parts[0][0].mean() - parts[1][0].mean()), min(len(set(names)) for _, names in parts)
    half = math.nan
    if fewest >= FEWEST:
        half = student_half_width(fewest / (fewest - 1) * np.square(pulls).sum(), fewest - 1)
    return Estimate(mean, mean - half, mean + half, len(a) + len(b), len(labels))


def by_material(results: Results, method: str, numbers: Sequence[Number]) -> str:
    """Means of a row of the inverse table by the true material, ± half of their intervals over objects; below them what
    the highest third has less the lowest, **bold** where the interval of that difference excludes 0.

    Args:
        results: a run's.
        method: the row.
        numbers: (quantity, metric) of the columns.
    """
    records = _decompositions(results, method)
    thirds = {
        f"{name} {third}": [r for r in records if (m := material_of(r)) and low <= m[which] < high]
        for which, name in enumerate(("metallic", "roughness"))
        for third, low, high in _THIRDS
    }
    groups = {"all with one number each": [r for r in records if material_of(r)], **thirds}
    if own := [record for record in records if material_of(record) is None]:
        groups["with maps of their own"] = own
    lines = [[name, *_means(members, numbers)] for name, members in groups.items()]
    low, high = _THIRDS[0][0], _THIRDS[-1][0]
    for name in ("metallic", "roughness"):
        top, bottom = thirds[f"{name} {high}"], thirds[f"{name} {low}"]
        cells = [_contrast_text(top, bottom, number) for number in numbers]
        lines.append([f"{name}: {high} less {low}", str(len(top) + len(bottom)), *cells])
    return markdown_table(["true material", "pictures", *map(_column, numbers)], lines)


def material_of(record: Record) -> tuple[float, float] | None:
    """(metallic, roughness) of a sample's material by its name; None where it has maps."""
    found = _MATERIAL.search(record.sample)
    return (int(found[1]) / 100, int(found[2]) / 100) if found else None


def by_object(results: Results, method: str, numbers: Sequence[Number], count: int) -> str:
    """Means of the objects on which a row is worst, by the first number: the worst `count`."""
    records = _decompositions(results, method)
    objects = dict.fromkeys(record.object for record in records)
    quantity, name = numbers[0]
    key, metric = metric_key(quantity, METRICS[name], MASKED), METRICS[name]
    means = {o: float(np.mean([r.values[key] for r in records if r.object == o and key in r.values])) for o in objects}
    worst = sorted(objects, key=lambda o: means[o] if metric.higher_is_better else -means[o])[:count]
    lines = [[o, *_means([r for r in records if r.object == o], numbers)] for o in worst]
    return markdown_table(["object", "pictures", *map(_column, numbers)], lines)


def by_scale(results: Results, methods: Sequence[str]) -> str:
    """The albedo's PSNR of rows: as it is, and after a least-squares factor for the picture or for each channel; ± half
    of the intervals over objects.

    Means are over the pictures that all of these rows have, those that have none left aside.
    """
    records = Selection("inverse", "single-image").of(results.records)
    keys = [metric_key("albedo", METRICS["psnr"], Variant("masked", "srgb", scale)) for scale in SCALES]
    rows = {m: {r.sample: r for r in records if r.method == m and keys[0] in r.values} for m in methods}
    shared = sorted(set.intersection(*(set(found) for found in rows.values() if found))) if any(rows.values()) else []
    lines = []
    for method, found in rows.items():
        own = [found[sample] for sample in shared] if found else []
        means = [_mean_text(own, key, METRICS["psnr"]) if own else NOT_RUN for key in keys]
        lines.append([label_of(results, method), *means, str(len(own))])
    return markdown_table(["", "as it is", "one factor", "one a channel", "pictures"], lines)


def by_kind(results: Results, questions: Sequence[Question], kind_of: Mapping[str, str]) -> str:
    """Row A of each question and what it gains over B, on either kind of objects; and the difference of these gains,
    **bold** where its interval excludes 0.

    Args:
        results: a run's.
        questions: lines; both rows of each have run.
        kind_of: object -> kind, of all objects; two kinds, whose columns are in the order in which they come.

    Raises:
        UnirenderError: there are not two kinds.
    """
    kinds = list(dict.fromkeys(kind_of.values()))
    if len(kinds) != 2:
        raise UnirenderError(f"by kind of object: got kinds {kinds}, expected two")
    lines = []
    for question in questions:
        records, metric = Selection(question.table, question.protocol).of(results.records), question.kind
        a, b = (values_of(records, key, question.key) for key in (question.a, question.b))
        object_of = {record.sample: record.object for record in records}
        parts = [[s for s in sorted(a.keys() & b.keys()) if kind_of[object_of[s]] == kind] for kind in kinds]
        gains = [[a[s] - b[s] for s in part] for part in parts]
        objects = [[object_of[s] for s in part] for part in parts]
        own = []
        for part, gain, names in zip(parts, gains, objects, strict=True):
            own.append(f"{np.mean([a[s] for s in part]):.{metric.decimals}f}")
            own.append(interval_text(mean_estimate(gain, names), metric))
        rows = [label_of(results, row) for row in (question.a, question.b)]
        lines.append([question.text, *rows, *own, _bold(contrast(*gains, *objects), metric)])
    columns = [text for kind in kinds for text in (f"A, {kind}", f"A - B, {kind}")]
    return markdown_table(["", "A", "B", *columns, "difference of the two A - B"], lines, left=3)


def _bold(found: Estimate, metric: Metric) -> str:
    text = interval_text(found, metric)
    return f"**{text}**" if found.low > 0 or found.high < 0 else text


def _contrast_text(a: Sequence[Record], b: Sequence[Record], number: Number) -> str:
    metric = METRICS[number[1]]
    key = metric_key(number[0], metric, MASKED)
    top, bottom = ([record for record in part if key in record.values] for part in (a, b))
    if not top or not bottom:
        return MISSING
    values = ([record.values[key] for record in part] for part in (top, bottom))
    objects = ([record.object for record in part] for part in (top, bottom))
    return _bold(contrast(*values, *objects), metric)


def _decompositions(results: Results, method: str) -> list[Record]:
    return [r for r in Selection("inverse", "single-image").of(results.records) if r.method == method]


def _means(records: Sequence[Record], numbers: Sequence[Number]) -> list[str]:
    found = [_mean_text(records, metric_key(q, METRICS[name], MASKED), METRICS[name]) for q, name in numbers]
    return [str(len(records)), *found]


def _mean_text(records: Sequence[Record], key: str, metric: Metric) -> str:
    own = [record for record in records if key in record.values]
    found = mean_estimate([r.values[key] for r in own], [r.object for r in own]) if own else None
    return estimate_text(found, metric.decimals)


def _column(number: Number) -> str:
    quantity, metric = number[0], METRICS[number[1]]
    return f"{quantity}, {metric.label} ({metric.unit})" if metric.unit else f"{quantity}, {metric.label}"
