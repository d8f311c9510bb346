"""What `unirender bench ls` prints: one function for each list, a line for each entry."""

from collections.abc import Callable, Iterator, Mapping
from importlib import metadata

from unirender.errors import UnirenderError
from unirender_evaluation.methods.plugins import ENTRY_POINT_GROUP
from unirender_evaluation.metrics import MASKS, SCALES, SPACES
from unirender_evaluation.suites.home import found_spec, truth_command
from unirender_evaluation.suites.spec import SuiteSpec, read_spec, suite_folder
from unirender_evaluation.table_list import ALL_METRICS, ALL_TABLES
from unirender_evaluation.tables.specs import PROTOCOLS

METHOD_GROUPS = {
    "ours": "our model: mean and sample, plain and anchored",
    "optimisation": "NvDiffRec (Mitsuba) on each picture, and the multi-view table",
    "trivial": "what a method must beat, closed forms, shade(true maps)",
    "plugins": "what is installed:",
}


def suites() -> Iterator[str]:
    """The bundled suites, what is in them, and whether their truth is here."""
    for path in sorted(suite_folder().glob("*.toml")):
        try:
            spec = read_spec(path)
        except UnirenderError as error:
            yield f"{path.stem}: {error}"
            continue
        yield f"{spec.name}: {spec.title}"
        yield f"  objects: {_objects(spec)}; lights: {_lights(spec)}; {spec.resolution} px"
        yield f"  {_truth(spec)}"
    yield "your own: a TOML file like these, by its path"


def _objects(spec: SuiteSpec) -> str:
    counts = [group.count for group in spec.meshes]
    meshes = "all" if None in counts else str(sum(count or 0 for count in counts))
    parts = [f"{len(spec.objects)} procedural"] if spec.objects else []
    return " + ".join([*parts, f"{meshes} meshes of a folder"] if counts else parts)


def _lights(spec: SuiteSpec) -> str:
    files = spec.light_files
    counts = {
        "bundled": spec.bundled_lights,
        "procedural": len(spec.procedural_lights),
        "of a folder": 0 if files is None else files.count or "all",
    }
    parts = " + ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    return f"{parts}, {spec.lights_per_object} for each object"


def _truth(spec: SuiteSpec) -> str:
    try:
        found = found_spec(spec.path)
    except UnirenderError as error:
        return str(error)
    if not found.truth_sha256 or not found.truth_path.is_file():
        return f"no truth here: make it with {truth_command(spec)}"
    return f"truth {found.truth_sha256[:12]}: {found.truth_path}"


def tables() -> Iterator[str]:
    """Every table with its protocols and columns."""
    for spec in ALL_TABLES.values():
        yield f"{spec.name}: {spec.title}"
        for key in spec.protocols:
            yield f"  protocol {key}: given {PROTOCOLS[key].given}"
        yield f"  columns {', '.join(dict.fromkeys(column.published_key for column in spec.columns))}"


def methods() -> Iterator[str]:
    """Groups of rows, and the plug-ins by name: they are not imported."""
    yield from (f"{name}: {what}" for name, what in METHOD_GROUPS.items())
    entries = sorted(metadata.entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.name)
    yield from (f"  {entry.name} ({entry.value})" for entry in entries)
    if not entries:
        yield f"  none in the entry-point group {ENTRY_POINT_GROUP!r}"
    yield "yours: --method module:Class or file.py:Class; --predictions NAME=FOLDER"


def metrics() -> Iterator[str]:
    """Every metric with its direction and formula."""
    for metric in ALL_METRICS.values():
        unit, better = f" ({metric.unit})" if metric.unit else "", "higher" if metric.higher_is_better else "lower"
        yield f"{metric.name}: {metric.label}{unit}, {better} is better, perfect {metric.perfect:g}; {metric.formula}"


def variants() -> Iterator[str]:
    """The axes of `--variant`."""
    yield f"mask: {', '.join(MASKS)}"
    yield f"space: {', '.join(SPACES)}"
    yield f"scale: {', '.join(SCALES)}"
    yield "one word of each axis with - between, as in masked-srgb-raw; the first of an axis that is left out"
    yield "all: every one of them"


LISTINGS: Mapping[str, Callable[[], Iterator[str]]] = {
    "suites": suites,
    "tables": tables,
    "methods": methods,
    "metrics": metrics,
    "variants": variants,
}
