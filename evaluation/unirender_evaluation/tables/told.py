"""Rows that stand in no rank: what they answer is nearer to the truth than any picture tells."""

from collections.abc import Sequence

from unirender_evaluation.ceiling import margins_of
from unirender_evaluation.metrics import Variant
from unirender_evaluation.records import Record
from unirender_evaluation.tables.mistakes import is_truth
from unirender_evaluation.tables.specs import TableSpec


def told_the_truth(spec: TableSpec, chosen: Sequence[Record], variant: Variant) -> frozenset[str]:
    """Methods whose maps or lights are the truth but for rounding, or whose pictures exceed the noise ceiling.

    Args:
        spec: of the table.
        chosen: records of strangers and of the ceiling, one `Selection`.
        variant: how its numbers are taken.
    """
    by_method: dict[str, list[Record]] = {}
    for record in chosen:
        by_method.setdefault(record.method, []).append(record)
    exact = {method for method, records in by_method.items() if is_truth(records)}
    keys = (column.key(variant) for column in spec.columns if column.metric.name == "psnr")
    return frozenset(exact.union(m.method for key in keys for m in margins_of(chosen, key) if m.breaks))
