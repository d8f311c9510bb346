"""What no schema can say of results: that their parts agree with each other, with this code, and with the suite.

A *problem* makes a file invalid. A *remark* is what a reader must know of a valid one.
"""

import functools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from unirender.errors import UnirenderError
from unirender.system.wording import instead
from unirender_evaluation.metrics import MASKS, OWN_MASK, SCALES, SPACES
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.results.data import Results, metric_definition, metric_name, protocol_definition
from unirender_evaluation.results.schema_check import Problem
from unirender_evaluation.table_list import ALL_METRICS, ALL_TABLES
from unirender_evaluation.tables.published import check_name
from unirender_evaluation.tables.specs import PROTOCOLS

if TYPE_CHECKING:
    from unirender_evaluation.suites.suite import Suite

MATERIALS = ("roughness", "metallic")
WORDS = {"mask": MASKS, "space": SPACES, "scale": SCALES}
ROUNDING = 1e-5  # relative
CONCAVE_DEG = 45.0  # mean angle up to which no cosines, of any angles, have a mean above its own
TOLERANCE = 1e-6  # by which rounding may carry a value beyond a perfect one
NO_BOUND = ("loss",)  # metrics whose perfect value is another row's, which noise may carry a row past
VIEW = re.compile(r"_\d+$")  # of one camera of several: `relit_3`
UNSHOWN = ("environment", "mask")  # quantities that are scored and stand in no column of some tables


def content_problems(results: Results) -> list[Problem]:
    """Everything that is wrong with the content of results whose layout is right."""
    return [
        *_method_problems(results),
        *_definition_problems(results),
        *_gathered(results.records, _record_problems),
        *_gathered(results.records, _value_problems(results.run.lpips)),
        *_gathered(results.records, _impossible_together),
        *_twice(results.records),
        *_light_problems(results),
        *_strangers_to_the_suite(results),
    ]


def remarks(results: Results) -> list[str]:
    """What a reader must know."""
    run, found = results.run, []
    if run.limit is not None:
        found.append(f"a partial run (--limit {run.limit}): its tables carry a watermark")
    else:
        found += _untold_part(results)
    if not results.lights:
        lights = "the lights of its samples are not named: those of the suite count, where the very suite is installed"
        found.append(lights)
    used = {record.method for record in results.records}
    idle = [info.key for info in run.methods if info.key not in used]
    if idle:
        found.append(f"described, but without a value: {', '.join(idle)}")
    shown = {column.quantity for spec in ALL_TABLES.values() for column in spec.columns} | set(UNSHOWN)
    quantities = Counter(key.partition(".")[0] for record in results.records for key in record.values)
    for name in sorted(q for q in quantities if q not in shown and VIEW.sub("", q) not in shown):
        found.append(f"quantity {name!r} stands in no table ({quantities[name]} values){instead(name, shown)}")
    here = installed_suite_hash(run.suite)
    if here not in (None, run.suite_hash):
        found.append(
            f"suite {run.suite} {run.suite_hash[:12]} is not the one installed here ({str(here)[:12]}): numbers on the "
            "two are not comparable"
        )
    return found


def installed_suite_hash(name: str) -> str | None:
    """The truth's sha256 of a bundled suite; None where no suite of that name is installed, or has no truth."""
    from unirender_evaluation.suites.home import found_spec

    if not re.fullmatch(r"[\w-]+", name):  # a path: somebody's own suite
        return None
    try:
        return found_spec(name).truth_sha256 or None
    except UnirenderError:
        return None


def _gathered(records: Iterable[Record], check: Callable[[Record], Iterable[tuple[str, str]]]) -> list[Problem]:
    """The (place in the record, problem) pairs of all records; one entry for a problem that many records share."""
    found: dict[str, list[str]] = {}
    for i, record in enumerate(records):
        for place, what in check(record):
            found.setdefault(what, []).append(f"records[{i}]{place}")
    return [
        Problem(places[0], what + (f" ({len(places) - 1} more like it)" if len(places) > 1 else ""))
        for what, places in found.items()
    ]


def _method_problems(results: Results) -> Iterator[Problem]:
    """Rows that are described twice, not at all, or under a name that is not published."""
    keys = Counter(info.key for info in results.run.methods)
    for i, info in enumerate(results.run.methods):
        place = f"run.methods[{i}]"
        if keys[info.key] > 1:
            yield Problem(place, f"key {info.key!r} occurs {keys[info.key]} times, expected a key of its own")
        if info.published is not None:
            try:
                check_name(info.published)
            except UnirenderError as error:
                yield Problem(f"{place}.published", str(error))
    yield from _gathered(
        results.records,
        lambda r: [] if r.method in keys else [(".method", f"no row {r.method!r}{instead(r.method, keys)}")],
    )


def _definition_problems(results: Results) -> Iterator[Problem]:
    """The numbers were taken as this code takes them, or its tables would print the wrong protocol beside them."""
    meaning = results.definitions
    used = {r.protocol for r in results.records} & PROTOCOLS.keys()
    taken: dict[str, tuple[Any, Any, str]] = {
        key: (meaning.protocols.get(key), protocol_definition(key), "protocols") for key in sorted(used)
    }
    keys = {key for r in results.records for key in r.values}
    names = {metric_name(key) for key in keys} & ALL_METRICS.keys()
    for name in sorted(names):
        taken[name] = (meaning.metrics.get(name), metric_definition(ALL_METRICS[name]), "metrics")
    for name, (there, here, kind) in taken.items():
        place = f"definitions.{kind}"
        if there is None:
            yield Problem(place, f"{name!r} is missing, but records use it")
        elif there != here:
            what = f"{name!r} is {there!r} in the file, and {here!r} in this version of unirender"
            yield Problem(place, f"{what}: numbers are not comparable; read the file with the version that wrote it")


def _record_problems(record: Record) -> Iterator[tuple[str, str]]:
    spec = ALL_TABLES.get(record.table)
    if spec is None:
        yield ".table", f"no table {record.table!r}{instead(record.table, ALL_TABLES)}"
    elif record.protocol not in spec.protocols:
        asked = instead(record.protocol, spec.protocols)
        yield ".protocol", f"table {record.table!r} has no protocol {record.protocol!r}{asked}"
    if not record.values:
        yield ".values", "is empty: leave a record without values out"


def _value_problems(backbones: Iterable[str]) -> Callable[[Record], Iterator[tuple[str, str]]]:
    """A check of a record's values: unknown keys, and numbers better than perfect ones."""
    problem_of = functools.cache(functools.partial(_key_problem, backbones=tuple(backbones)))
    metric_of = functools.cache(lambda key: ALL_METRICS[metric_name(key)])

    def check(record: Record) -> Iterator[tuple[str, str]]:
        for key, value in record.values.items():
            if problem := problem_of(key):
                yield f".values[{key!r}]", problem
            else:
                metric = metric_of(key)
                sign = 1 if metric.higher_is_better else -1
                if metric.name not in NO_BOUND and sign * value > sign * metric.perfect + TOLERANCE:
                    yield f".values[{key!r}]", f"a {metric.label} is better than a perfect one ({metric.perfect:g})"
                elif value == -sign * float("inf"):
                    yield (
                        f".values[{key!r}]",
                        f"a {metric.label} of {value} is infinitely bad; leave out what does not exist",
                    )

    return check


def _impossible_together(record: Record) -> Iterator[tuple[str, str]]:
    """Values of one answer that no answer has together: one of them was changed."""
    values = record.values
    for name in MATERIALS:
        whole, per_pixel = values.get(f"{name}.mse_object", 0), values.get(f"{name}.mse@masked", math.inf)
        if whole > per_pixel * (1 + ROUNDING) + TOLERANCE:
            yield f".values['{name}.mse_object']", "the square of a mean error is above the mean of its squares"
    cosine, angle = values.get("normal.cosine", -1), values.get("normal.angle_deg", 0)
    if angle <= CONCAVE_DEG and cosine > math.cos(math.radians(angle)) + TOLERANCE:
        yield ".values['normal.cosine']", "a mean cosine is above the cosine of the mean angle"
    for key in values if OWN_MASK not in values else ():
        pasted = key.replace("@whole", "@masked")
        if ".lpips_" in key and not math.isclose(values[key], values.get(pasted, values[key]), rel_tol=ROUNDING):
            yield f".values[{key!r}]", "differs from that of the masked picture, though the mask is pasted in both"


def _key_problem(key: str, backbones: Iterable[str]) -> str:
    """What is wrong with a metric key; empty where nothing is."""
    name = metric_name(key)
    if name not in ALL_METRICS:
        return f"no metric {name!r}{instead(name, ALL_METRICS)}"
    axes, words = ALL_METRICS[name].axes, [word for word in key.partition("@")[2].split("-") if word]
    if len(words) != len(axes) or any(word not in WORDS[axis] for word, axis in zip(words, axes, strict=True)):
        wanted = "-".join(f"({'|'.join(WORDS[axis])})" for axis in axes)
        stem = key.partition("@")[0]
        return f"got the key {key!r}, expected {f'{stem}@{wanted}' if axes else f'{stem} without a variant'}"
    backbone = name.removeprefix("lpips_")
    if name != backbone and backbone not in backbones:
        return f"a value of LPIPS-{backbone}, but `run.lpips` does not list {backbone!r}"
    return ""


def _twice(records: Iterable[Record]) -> Iterator[Problem]:
    """One measurement must not count twice, nor a sample belong to two objects: intervals are over objects."""
    seen: dict[tuple[str, ...], int] = {}
    owners: dict[str, tuple[str, int]] = {}
    for i, record in enumerate(records):
        identity = (record.table, record.protocol, record.method, record.sample, record.subset)
        if identity in seen:
            yield Problem(f"records[{i}]", f"the same measurement as records[{seen[identity]}], {' / '.join(identity)}")
        seen[identity] = i
        owner, first = owners.setdefault(record.sample, (record.object, i))
        if owner != record.object:
            what = f"sample {record.sample!r} is of {record.object!r} here and of {owner!r} in records[{first}]"
            yield Problem(f"records[{i}].object", what)


def _light_problems(results: Results) -> Iterator[Problem]:
    """Where a file names the lights of samples, it does of all."""
    for sample in sorted({record.sample for record in results.records}) if results.lights else ():
        if not results.lights.get(sample):
            what = f"names no light of the sample {sample!r}: name those of all samples, or leave the field out"
            yield Problem("lights", what)


def suite_of(run: RunInfo) -> "Suite | None":
    """The very suite of a run with its truth; None where this installation does not have it."""
    from unirender_evaluation.suites.suite import load_suite

    if installed_suite_hash(run.suite) != run.suite_hash:
        return None
    try:
        return load_suite(run.suite)
    except UnirenderError:  # the truth is not made here: nothing to compare with
        return None


def _beginnings(sample: str) -> set[str]:
    """What a sample's name begins with, word by word: one is the key of its scene, or its object's name."""
    words = sample.split("_")
    return {"_".join(words[:n]) for n in range(1, len(words) + 1)}


def _untold_part(results: Results) -> Iterator[str]:
    """That no row has all scenes of the suite, which only a partial run leaves out.

    A method answers as much as it can, but the trivial rows and the bounds answer for all scenes of a run. Without a
    record of any scene, as of the multi-view table alone, nothing is known.
    """
    suite = suite_of(results.run)
    if suite is None:
        return
    keys = {scene.key for scene in suite.scenes}
    of_rows: dict[str, set[str]] = {}
    for method, sample in {(record.method, record.sample) for record in results.records}:
        of_rows.setdefault(method, set()).update(_beginnings(sample) & keys)
    most = max(map(len, of_rows.values()), default=0)
    if 0 < most < len(keys):
        yield f"records of {most} of {len(keys)} scenes, though the run says that it is whole"


def _strangers_to_the_suite(results: Results) -> list[Problem]:
    """Pictures of another size and samples that the suite does not have, where it is the one installed here."""
    suite, run = suite_of(results.run), results.run
    if suite is None:
        return []
    from unirender_evaluation.results.lights import sample_lights
    from unirender_evaluation.task import PROTOCOLS as QUESTIONS
    from unirender_evaluation.tasks import tasks

    scenes = {scene.key: scene.object for scene in suite.scenes}
    names = {*scenes, *scenes.values()}
    lights = sample_lights(suite)
    asked = {question: {task.sample for task in tasks(suite, *question, list(suite.scenes))} for question in QUESTIONS}
    wrong = []
    if run.resolution != suite.spec.resolution:
        what = f"got {run.resolution}, expected {suite.spec.resolution}: suite {run.suite!r} has pictures of that size"
        wrong.append(Problem("run.resolution", what))
    for sample, own in results.lights.items():
        if sample in lights and own != lights[sample]:
            wrong.append(Problem(f"lights[{sample!r}]", f"got {own}, expected {lights[sample]}, those of the suite"))

    def check(record: Record) -> Iterator[tuple[str, str]]:
        found = _beginnings(record.sample) & names
        if not found:
            yield ".sample", f"suite {results.run.suite!r} has no scene of the sample {record.sample!r}"
        elif record.object not in {scenes.get(name, name) for name in found}:
            yield ".object", f"the sample {record.sample!r} is of another object than {record.object!r}"
        elif record.sample not in asked.get((record.table, record.protocol), {record.sample}):
            where = f"{record.table}/{record.protocol}"
            yield ".sample", f"suite {results.run.suite!r} has no sample {record.sample!r} under {where}"

    return [*wrong, *_gathered(results.records, check)]
