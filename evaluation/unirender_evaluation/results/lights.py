"""Paired differences with lights as draws, too: whether a result would stand under other lights than the suite's."""

from collections.abc import Mapping, Sequence

from unirender.errors import UnirenderError
from unirender_evaluation.comparisons import Selection, compare, values_of
from unirender_evaluation.results.data import Results
from unirender_evaluation.results.findings import NOT_RUN, Question, label_of, markdown_table
from unirender_evaluation.statistics import crossed_interval
from unirender_evaluation.suites.suite import Suite

_TO = "_to_"  # between the scene whose picture is relit and the name of its object's other light


def scene_lights(suite: Suite) -> dict[str, str]:
    """Scene -> its light, as `over_lights` wants it."""
    return {scene.key: scene.light for scene in suite.scenes}


def over_lights(results: Results, questions: Sequence[Question], lights: Mapping[str, str]) -> str:
    """A table with a line for each question: the difference with its interval over objects, and over both.

    Args:
        results: a run's.
        questions: rows `a` and `b` of each.
        lights: scene -> light, of the run's suite. A relit picture counts for the light that it is relit by; of an
            object seen from many sides, for the one that it was seen under.

    Raises:
        UnirenderError: a sample belongs to no scene of `lights`.
    """
    head = ["", "A", "B", "A - B", "over objects", "over objects and lights", "pairs (objects, lights)"]
    return markdown_table(head, [_line(results, question, lights) for question in questions], left=3)


def _line(results: Results, question: Question, lights: Mapping[str, str]) -> list[str]:
    labels = [label_of(results, key) for key in (question.a, question.b)]
    records = Selection(question.table, question.protocol).of(results.records)
    a, b = (values_of(records, key, question.key) for key in (question.a, question.b))
    shared = sorted(a.keys() & b.keys())
    if not shared:
        return [question.text, *labels, NOT_RUN, "", "", "0"]
    found = compare(records, question.kind, question.key, question.a, question.b).difference
    objects = {record.sample: record.object for record in records}
    own = [light_of(sample, lights) for sample in shared]
    crossed = crossed_interval([a[s] - b[s] for s in shared], [objects[s] for s in shared], own)
    decimals = question.kind.decimals
    intervals = [f"[{low:+.{decimals}f}, {high:+.{decimals}f}]" for low, high in ((found.low, found.high), crossed)]
    counts = f"{found.n} ({found.clusters}, {len(set(own))})"
    return [question.text, *labels, f"{found.mean:+.{decimals}f}", *intervals, counts]


def light_of(sample: str, lights: Mapping[str, str]) -> str:
    """The light under which a sample's answer is scored: that of its scene, or the one that it is relit by.

    Raises:
        UnirenderError: the sample belongs to no scene of `lights`.
    """
    scene = max((key for key in lights if f"{sample}_".startswith(f"{key}_")), key=len, default="")
    rest = sample.removeprefix(scene)
    if scene and rest.startswith(_TO):
        scene = f"{scene.rpartition('_')[0]}_{rest.removeprefix(_TO)}"
    if scene not in lights:
        raise UnirenderError(
            f"sample {sample!r} belongs to none of the {len(lights)} scenes, expected the suite that the results are of"
        )
    return lights[scene]
