"""Every table that a run fills, and every metric that stands in one or is recorded beside it."""

from unirender_evaluation.methods.mistakes import AT_WHITE, BIAS, GAINS
from unirender_evaluation.metrics import METRICS, Metric
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE
from unirender_evaluation.physics.tests import PHYSICS_TABLE
from unirender_evaluation.tables.lights import LIGHT_TABLE
from unirender_evaluation.tables.specs import TABLES, TableSpec

BESIDE_THE_PAPERS = (LIGHT_TABLE, MULTIVIEW_TABLE, PHYSICS_TABLE)
ALL_TABLES: dict[str, TableSpec] = {**TABLES, **{spec.name: spec for spec in BESIDE_THE_PAPERS}}
ALL_METRICS: dict[str, Metric] = {
    **{column.metric.name: column.metric for spec in ALL_TABLES.values() for column in spec.columns},
    **METRICS,
    **GAINS,
    **{metric.name: metric for metric in (BIAS, AT_WHITE)},
}
