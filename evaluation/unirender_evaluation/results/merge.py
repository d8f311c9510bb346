"""Several runs' results as one: their rows side by side, where their numbers can stand side by side at all.

A row that two files have (the trivial rows, the noise ceiling) appears once where their values agree; where they do not
(two checkpoints called "Ours"), each keeps its place, and the labels say which file it is from. Every merged row says
that it is stored, with its file, date and code: none of them was measured now.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from unirender.errors import UnirenderError
from unirender_evaluation.comparisons import Lights, agree
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.results.data import Results
from unirender_evaluation.rows import slug
from unirender_evaluation.tables.protocol import doubts

Sample = tuple[str, str, str, str]  # table, protocol, subset, sample
SCENES_ONLY = re.compile(r"\d+ scenes? only")  # what a row's note says of one run (`rows.Row.described`)
PICTURES_ONLY = re.compile(r"inverse: \d+ pictures? of each scene only")


def obstacles(a: Results, b: Results) -> list[str]:
    """Why numbers of two files must not be compared; empty where they may."""
    facts = (
        ("the suites' truth", a.run.suite_hash[:12], b.run.suite_hash[:12]),
        ("the suites' resolution", a.run.resolution, b.run.resolution),
        ("the Mitsuba that rendered the truth", a.run.mitsuba, b.run.mitsuba),
        ("the exposure", a.run.exposure, b.run.exposure),
    )
    found = [
        f"{what} differs: {there} in {a.source}, {here} in {b.source}" for what, there, here in facts if there != here
    ]
    for kind in ("protocols", "metrics"):
        one, other = getattr(a.definitions, kind), getattr(b.definitions, kind)
        changed = [name for name in one.keys() & other.keys() if one[name] != other[name]]
        found += [f"the {kind[:-1]} {name!r} is defined otherwise in the two files" for name in sorted(changed)]
    return found


def differences(a: Results, b: Results) -> list[str]:
    """What a reader must know of two files whose numbers may be compared."""
    facts = (
        ("code", a.run.code or "-", b.run.code or "-"),
        ("scenes", *("all" if run.limit is None else f"--limit {run.limit}" for run in (a.run, b.run))),
        ("LPIPS", *(" and ".join(run.lpips) or "none" for run in (a.run, b.run))),
        ("Mitsuba of the run", *(run.environment.get("mitsuba", "-") for run in (a.run, b.run))),
    )
    return [f"{what}: {there} in {a.source}, {here} in {b.source}" for what, there, here in facts if there != here]


def check_comparable(files: Sequence[Results]) -> None:
    """Looks at all files against the first.

    Raises:
        UnirenderError: two are the same file, or their numbers must not be compared; the message says why.
    """
    for i, other in enumerate(files[1:], start=1):
        same = next((file for file in files[:i] if file.source == other.source), None)
        if same is not None:
            raise UnirenderError(f"{other.source}: given twice, expected each file once")
        found = obstacles(files[0], other)
        if found:
            raise UnirenderError(f"{files[0].source} and {other.source} cannot be compared: {'; '.join(found)}")


@dataclass
class _Row:
    """A row in the making: its description in the first file that has it, its records, and each file's note on them."""

    info: MethodInfo
    origin: str
    records: dict[Sample, Record] = field(default_factory=dict)
    notes: list[tuple[str, set[Sample]]] = field(default_factory=list)

    def is_also(self, info: MethodInfo, records: Mapping[Sample, Record]) -> bool:
        """Whether another file's row is this one: the same method with the same configuration and values."""
        shared = self.records.keys() & records.keys()
        same = (self.info.key, self.info.kind, self.info.config) == (info.key, info.kind, info.config)
        return same and all(agree(self.records[sample].values, records[sample].values) for sample in shared)

    def take(self, note: str, records: Mapping[Sample, Record]) -> None:
        """Adds what a file has of this row; the first file's record and values stay, where both have one."""
        self.notes.append((note, set(records)))
        for sample, record in records.items():
            own = self.records.get(sample)
            self.records[sample] = record if own is None else replace(own, values={**record.values, **own.values})

    def note(self) -> str:
        """The note of a file that has all of the row; else the first one's, without counts that the others do not say.

        How many scenes is true of one file, and not of several together.
        """
        whole = next((note for note, samples in self.notes if samples >= self.records.keys()), None)
        if whole is not None:
            return whole
        first, *others = [note.split("; ") for note, samples in self.notes if samples]
        kept = [
            part
            for part in first
            if not SCENES_ONLY.fullmatch(part)
            and (not PICTURES_ONLY.fullmatch(part) or all(part in other for other in others))
        ]
        return "; ".join(kept)


def merge(files: Sequence[Results]) -> tuple[RunInfo, list[Record]]:
    """The description and the records of several runs as if they were one, for `tables.build_tables`.

    A single file is returned as it is.

    Raises:
        UnirenderError: see `check_comparable`; or there is no file.
    """
    if not files:
        raise UnirenderError("merge: got no results, expected at least one file")
    check_comparable(files)
    if len(files) == 1:
        return files[0].run, list(files[0].records)
    rows: list[_Row] = []
    for file, name in zip(files, _names(files), strict=True):
        for info in file.run.methods:
            records = {(r.table, r.protocol, r.subset, r.sample): r for r in file.records if r.method == info.key}
            row = next((row for row in rows if row.is_also(info, records)), None)
            if row is None:
                row = _Row(replace(info, stored=info.stored or _stored(file, name)), name)
                rows.append(row)
            row.take(_without(info.note, doubts(info.key, file.records)), records)
    rows = _told_apart(rows)
    methods = tuple(row.info for row in rows)
    merged = [replace(r, method=row.info.key) for row in rows for r in row.records.values()]
    # In the order of a run's own records, so that sums over them round alike.
    merged.sort(key=lambda r: (r.table, r.protocol, r.method, r.sample))
    return _merged_run([file.run for file in files], methods), merged


def merged_lights(files: Sequence[Results]) -> Lights:
    """The lights of the samples of all files, which are of one suite."""
    return {sample: names for file in files for sample, names in file.lights.items()}


def _without(note: str, parts: Sequence[str]) -> str:
    """A note but for some of its parts: how many pictures are doubted is counted anew over all files."""
    return "; ".join(part for part in note.split("; ") if part not in parts)


def _stored(file: Results, name: str) -> str:
    return f"{name}, {file.run.date or 'no date'}, suite {file.run.suite_hash[:12]}, code {file.run.code or '-'}"


def _names(files: Sequence[Results]) -> list[str]:
    """Short names of the files, as they were given where the short ones are not unique."""
    labels = [file.label for file in files]
    return labels if len(set(labels)) == len(labels) else [file.source for file in files]


def _told_apart(rows: Sequence[_Row]) -> list[_Row]:
    """The rows with a key of their own each, and labels that name the file where two rows share one."""
    keys: set[str] = set()
    told = []
    labels = [row.info.label for row in rows]
    for row in rows:
        key, label = row.info.key, row.info.label
        if key in keys:
            key = f"{key}-from-{slug(row.origin)}"
        while key in keys:
            key += "-again"
        keys.add(key)
        label = f"{label} ({row.origin})" if labels.count(label) > 1 else label
        note = "; ".join([*filter(None, [row.note()]), *doubts(row.info.key, row.records.values())])
        told.append(replace(row, info=replace(row.info, key=key, label=label, note=note)))
    return told


def _merged_run(runs: Sequence[RunInfo], methods: tuple[MethodInfo, ...]) -> RunInfo:
    """What the protocol line prints of all runs: where they differ, everything that they say."""
    widest = max(runs, key=lambda run: math.inf if run.limit is None else run.limit)
    environment = {k: v for k, v in widest.environment.items() if all(run.environment.get(k) == v for run in runs)}
    return replace(
        widest,
        methods=methods,
        lpips=tuple(dict.fromkeys(name for run in runs for name in run.lpips)),
        code=" and ".join(dict.fromkeys(run.code or "-" for run in runs)),
        date=" and ".join(dict.fromkeys(run.date or "-" for run in runs)),
        unchecked=" and ".join(dict.fromkeys(run.unchecked for run in runs if run.unchecked)),
        carried=" and ".join(dict.fromkeys(run.carried for run in runs if run.carried)),
        limit=min((run.limit for run in runs if run.limit is not None), default=None),
        seeds=tuple(sorted({seed for run in runs for seed in run.seeds})),
        environment=environment,
    )
