"""What `unirender bench ls` prints: one function for each list, a line for each entry."""

from collections.abc import Callable, Iterator, Mapping
from importlib import metadata, resources
from pathlib import Path

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import MASKS, SCALES, SPACES
from unirender_evaluation.plugins import ENTRY_POINT_GROUP
from unirender_evaluation.specs import PROTOCOLS
from unirender_evaluation.suite_spec import read_spec
from unirender_evaluation.table_list import ALL_METRICS, ALL_TABLES

METHOD_GROUPS = {
    "ours": "our model: mean and sample, plain and anchored",
    "optimisation": "NvDiffRec (Mitsuba) on each picture, and the multi-view table",
    "trivial": "what a method must beat, closed forms, shade(true maps)",
    "plugins": "what is installed:",
}


def suites() -> Iterator[str]:
    """The bundled suites, and whether their truth is here."""
    folder = Path(str(resources.files("unirender_evaluation"))) / "data" / "suites"
    for path in sorted(folder.glob("*.toml")):
        try:
            spec = read_spec(path)
        except UnirenderError as error:
            yield f"{path.stem}: {error}"
            continue
        make = f"not made: unirender bench truth --suite {spec.name}"
        truth = f"truth {spec.truth_sha256[:12]}" if spec.truth_path.is_file() and spec.truth_sha256 else make
        yield f"{spec.name}: {spec.title}; {len(spec.objects)} objects, {spec.resolution} px, {truth}"
    yield "your own: a TOML file like these, by its path"


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
