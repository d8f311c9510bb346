"""What a results file holds: a run's description, its records, and what the numbers mean."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from unirender_evaluation.comparisons import Lights
from unirender_evaluation.metrics import Metric
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.table_list import ALL_METRICS
from unirender_evaluation.tables.specs import PROTOCOLS

NAME = "results.json"
PACKED = ".gz"  # what the name of a file that gzip has packed ends in


@dataclass(frozen=True)
class Definitions:
    """What the numbers of a file mean: protocol -> what a method is given; metric -> unit, direction, formula."""

    protocols: Mapping[str, str]
    metrics: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Results:
    """A validated file. `source` is how the user named it; `lights` is empty of a file that does not name them."""

    run: RunInfo
    records: tuple[Record, ...]
    definitions: Definitions
    source: str
    lights: Lights = field(default_factory=dict)

    def __repr__(self) -> str:
        run = self.run
        return (
            f"Results({self.label}: suite {run.suite} at {run.resolution} px, {run.date or 'no date'}, "
            f"{len(run.methods)} methods, {len(self.records)} records)"
        )

    @property
    def label(self) -> str:
        """A short name: the file's, or its folder's where the file has the usual name."""
        path = Path(self.source.removesuffix(PACKED)).absolute()
        return path.parent.name if path.name == NAME else path.stem


def definitions(records: Iterable[Record]) -> Definitions:
    """Those that records use, as they are in this installation."""
    records = list(records)
    names = {metric_name(key) for record in records for key in record.values}
    used = {record.protocol for record in records}
    return Definitions(
        {key: protocol_definition(key) for key in PROTOCOLS if key in used},
        {name: metric_definition(metric) for name, metric in ALL_METRICS.items() if name in names},
    )


def protocol_definition(key: str) -> str:
    """What a method is given under a protocol and what its answers are scored against."""
    protocol = PROTOCOLS[key]
    return protocol.given + (f"; truth: {protocol.truth}" if protocol.truth else "")


def metric_definition(metric: Metric) -> dict[str, Any]:
    """What a metric is to somebody who reads the file without this code."""
    return {name: getattr(metric, name) for name in ("label", "unit", "higher_is_better", "formula")}


def metric_name(key: str) -> str:
    """The metric of a metric key: "psnr" of "albedo.psnr@masked-srgb-raw"."""
    return key.partition("@")[0].rpartition(".")[2]
