"""Tables of a run on a public test set: the benchmark's own table code under the set's protocol line."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from unirender_evaluation.public.orb_scoring import FLOORED
from unirender_evaluation.public.sets import PublicSet
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.statistics import CONFIDENCE, METHOD
from unirender_evaluation.tables.build import Table, build_table
from unirender_evaluation.tables.specs import Column, TableSpec

SHOWN = 5  # names of photographs without an answer, in a note; `missing.txt` has all


def public_tables(
    public: PublicSet, records: Sequence[Record], run: RunInfo, missing: Mapping[str, Sequence[str]]
) -> list[Table]:
    """A table for each question that has records.

    Args:
        public: the set.
        records: of the run.
        run: its rows.
        missing: label of a stranger's row -> "table/sample" that it has no answer to.
    """
    tables = []
    for spec in public.tables:
        chosen = [record for record in records if record.table == spec.name]
        if chosen:
            (protocol,) = spec.protocols
            here = replace(spec, columns=tuple(c for c in spec.columns if _backbone(c) in (None, *run.lpips)))
            table = build_table(here, averaged(public, chosen), run, protocol=protocol, variant=public.variant)
            line = protocol_line(public, spec, chosen, run)
            notes = (*table.notes, *_floors(chosen, run), *_gaps(chosen, run, missing))
            tables.append(replace(table, protocol_label=table.title, protocol=line, notes=notes))
    return tables


def averaged(public: PublicSet, records: Sequence[Record]) -> list[Record]:
    """A record for each unit that the set averages first, with the means of its samples' values."""
    if public.averaged_first is None:
        return list(records)
    units: defaultdict[tuple[str, ...], list[Record]] = defaultdict(list)
    for record in records:
        units[record.table, record.protocol, record.subset, record.method, public.unit(record.sample)].append(record)
    return [
        replace(same[0], sample=sample, values=_means(same), seconds=_mean([r.seconds for r in same]))
        for (*_, sample), same in units.items()
    ]


def protocol_line(
    public: PublicSet, spec: TableSpec, records: Sequence[Record], run: RunInfo
) -> tuple[tuple[str, str], ...]:
    """(what, value) pairs: everything one must know to compare a number with one's own."""
    samples, objects = ({getattr(record, name) for record in records} for name in ("sample", "object"))
    wanted = list(dict.fromkeys(name for column in spec.columns if (name := _backbone(column))))
    units = len({public.unit(sample) for sample in samples})
    first = public.averaged_first
    means = "means over samples" if first is None else f"means over {units} {first}, each the mean of its samples"
    absent = "".join(f"; {name}: no weights here, no column" for name in wanted if name not in run.lpips)
    return (
        ("set", f"{public.name}, from a user's folder, content {run.suite_hash[:12]}"),
        *public.protocol(spec.name),
        *((("LPIPS backbones", f"{', '.join(run.lpips) or 'none'}{absent}"),) if wanted else ()),
        ("n", f"{len(samples)} samples of {len(objects)} objects or scenes; {means}"),
        ("interval", f"{CONFIDENCE:.0%} over objects or scenes: {METHOD}"),
        ("reader", "layout and metrics from the set's own code, checked on made data"),
        ("code", f"{run.code}, {run.date}"),
    )


def _means(records: Sequence[Record]) -> dict[str, float]:
    """Of each value, over the records that have it."""
    names = dict.fromkeys(name for record in records for name in record.values)
    return {name: float(np.mean([r.values[name] for r in records if name in r.values])) for name in names}


def _mean(seconds: Sequence[float | None]) -> float | None:
    known = [value for value in seconds if value is not None]
    return float(np.mean(known)) if known else None


def _backbone(column: Column) -> str | None:
    """The backbone of an LPIPS column; None for others."""
    name = column.metric.name
    return name.removeprefix("lpips_") if name.startswith("lpips_") else None


def _floors(records: Sequence[Record], run: RunInfo) -> list[str]:
    """How many PSNRs of each row stand at the benchmark's floor."""
    found = []
    for key in dict.fromkeys(record.method for record in records):
        flags = [v for r in records if r.method == key for name, v in r.values.items() if FLOORED in name]
        if sum(flags):
            found.append(f"{run.method(key).label}: {sum(flags):.0f} of {len(flags)} PSNRs are the benchmark's floor.")
    return found


def _gaps(records: Sequence[Record], run: RunInfo, missing: Mapping[str, Sequence[str]]) -> list[str]:
    """Which questions of a table its rows left open."""
    table, found = f"{records[0].table}/", []
    for label in dict.fromkeys(run.method(record.method).label for record in records):
        here = [name.removeprefix(table) for name in missing.get(label, ()) if name.startswith(table)]
        if here:
            more = f" and {len(here) - SHOWN} more (missing.txt)" if len(here) > SHOWN else ""
            found.append(f"{label}: no answer to {len(here)}: {', '.join(here[:SHOWN])}{more}.")
    return found
