"""`bench public`: a public test set x rows -> per-sample records and tables in one folder.

    records.jsonl records.csv           every value, with its content key
    run.json                            the rows
    tables.md tables.tex tables.json    with the protocol line
    missing.txt                         what a stranger's row has no answer to, a line each, if the run has one

Running the same command again reuses what is done: a record depends on the content of its sample's files, the row's
configuration, the resolution and the code that measures.
"""

import hashlib
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from rich.console import Console

from unirender.system.run_progress import progress_bar
from unirender.system.whole_files import replace_file
from unirender_evaluation import lpips
from unirender_evaluation.predictions.check import PredictionError, folder_problems
from unirender_evaluation.public.answers import asked, questions, read_answer, takes_part
from unirender_evaluation.public.sets import PublicSet, Sample
from unirender_evaluation.public.tables import public_tables
from unirender_evaluation.records import Record, RunInfo, write_csv, write_run
from unirender_evaluation.rows import Row, evenly
from unirender_evaluation.runs.folder import say_missing, say_rows_without_values, write_missing, writing_run
from unirender_evaluation.store import KEY_PREFIX, Store
from unirender_evaluation.subsets import partial as partial_limit
from unirender_evaluation.tables.build import Table
from unirender_evaluation.tables.formats import print_tables, to_json, to_markdown
from unirender_evaluation.tables.latex import to_latex
from unirender_evaluation.tables.protocol import with_doubts
from unirender_evaluation.versions import LPIPS, SEPARATOR, Versions, installed_version, modules_version, versions
from unirender_reference.folder_lock import locked, made_folder


@dataclass(frozen=True)
class PublicRun:
    """What is scored."""

    public: PublicSet
    rows: tuple[Row, ...]
    out: Path  # folder of the run; an earlier run in it is continued
    limit: int | None  # samples, evenly spaced; the tables are then watermarked
    backbones: tuple[str, ...]  # of LPIPS
    versions: Versions  # of the code

    @classmethod
    def of(cls, public: PublicSet, rows: Sequence[Row], out: Path, limit: int | None = None) -> "PublicRun":
        """With the LPIPS weights that are here, where the set asks for LPIPS."""
        uses = any(column.metric.name.startswith("lpips_") for spec in public.tables for column in spec.columns)
        backbones = tuple(lpips.available()) if uses else ()
        return cls(public, tuple(rows), out, limit, backbones, versions(backbones))

    def key(self, row: Row, content: str) -> str:
        """The content key of a record; it begins with the core's version, as `Store` wants it.

        Args:
            row: whose record.
            content: hash of the sample.
        """
        own = modules_version(*self.public.modules, "public/answers")
        uses = row.uses | ({LPIPS} if self.backbones else set())
        code = f"{self.versions.of(uses)}{SEPARATOR}public {own}"
        text = json.dumps([content, self.public.resolution, row.config, code], sort_keys=True)
        core = hashlib.sha256(self.versions.core.encode()).hexdigest()
        return core[:KEY_PREFIX] + hashlib.sha256(text.encode()).hexdigest()[KEY_PREFIX:]


@dataclass(frozen=True)
class PublicResult:
    """What a run has found; `computed` counts the records that were not there before."""

    records: tuple[Record, ...]
    tables: tuple[Table, ...]
    missing: dict[str, list[str]]
    computed: int


def run(what: PublicRun, console: Console) -> PublicResult:
    """Scores what is missing, prints and writes the tables.

    Args:
        what: the run.
        console: for progress and tables.

    Raises:
        PublicSetError: the folder is not the set; nothing has run then.
        PredictionError: a folder of predictions has other files than the set asks for; nothing has run then.
        UnirenderError: another run is writing to the folder; or a file of the set is broken, or a method fails: a
            second run continues from there.
    """
    every = what.public.samples()
    what = replace(what, limit=partial_limit(what.limit, len(every)))
    check_folders(what)
    with made_folder(what.out), locked(what.out), writing_run(what.out):
        return _run(what, evenly(every, what.limit), console)


def _run(what: PublicRun, samples: Sequence[Sample], console: Console) -> PublicResult:
    """Answers what no record answers yet, and writes the tables."""
    missing = {
        row.info.label: [f"{sample.table}/{sample.key}" for sample in samples if not takes_part(row, sample)]
        for row in what.rows
        if row.predictions is not None
    }
    say = partial(console.print, highlight=False, markup=False, soft_wrap=True)
    counted = {label: (names, len(samples)) for label, names in missing.items()}
    write_missing(what.out, counted)
    say_missing(what.out, counted, say, "has files for")
    store = Store.open(what.out / "records.jsonl")
    before, contents = set(store.known), []
    with progress_bar(console) as progress:
        bar = progress.add_task(what.public.name, total=len(samples))
        for sample in samples:
            contents.append(sample.sha256())
            _work(what, sample, contents[-1], store)
            progress.update(bar, advance=1, description=f"{what.public.name}: {sample.key}")
    records = [record for record in store.close() if record.values]
    computed = len({record.key for record in records} - before)
    without = _unanswered(what.rows, samples, records)
    write_missing(what.out, without)
    say_missing(what.out, {label: found for label, found in without.items() if found != counted.get(label)}, say)
    missing = {label: names for label, (names, _) in without.items()}
    info = _info(what, records, contents)
    write_run(what.out / "run.json", info)
    write_csv(what.out / "records.csv", records)
    tables = public_tables(what.public, records, info, missing)
    replace_file(what.out / "tables.md", "\n\n".join(map(to_markdown, tables)) + "\n")
    replace_file(what.out / "tables.tex", "\n\n".join(map(to_latex, tables)) + "\n")
    replace_file(what.out / "tables.json", to_json(tables))
    print_tables(console, tables)
    absent = [spec.name for spec in what.public.tables if spec.name not in {record.table for record in records}]
    for line in filter(None, map(what.public.why_absent, absent)):
        say(line)
    say_rows_without_values(what.rows, records, say)
    console.print(f"{computed} new records of {len(records)}; {what.out / 'tables.md'}, .tex, .json", highlight=False)
    return PublicResult(tuple(records), tuple(tables), missing, computed)


def _unanswered(
    rows: Sequence[Row], samples: Sequence[Sample], records: Sequence[Record]
) -> dict[str, tuple[list[str], int]]:
    """Of each stranger's row, by its label: the questions without a value, and how many there are; to a plug-in those
    that one picture answers."""
    found = {(record.method, f"{record.table}/{record.sample}") for record in records}
    without = {}
    for row in rows:
        if row.info.kind == "external":
            asked_of = [s for s in samples if row.predictions is not None or s.one_picture]
            names = [f"{sample.table}/{sample.key}" for sample in asked_of]
            without[row.info.label] = [name for name in names if (row.info.key, name) not in found], len(names)
    return without


def check_folders(what: PublicRun) -> None:
    """Reads every file of the rows that are folders.

    Raises:
        PredictionError: there is a problem; all of them at once.
    """
    folders = [row.predictions for row in what.rows if row.predictions is not None]
    wanted = questions(what.public) if folders else {}
    problems = [line for folder in folders for line in folder_problems(folder, wanted, what.public.name)]
    if problems:
        raise PredictionError(problems)


def _work(what: PublicRun, sample: Sample, content: str, store: Store) -> None:
    """Scores the rows that have no record of the sample."""
    rows = {what.key(row, content): row for row in what.rows if takes_part(row, sample)}
    due = {key: row for key, row in rows.items() if not store.has(key)}
    inputs = what.public.inputs(sample) if any(row.predictions is None for row in due.values()) else {}
    networks = [lpips.load(name) for name in what.backbones] if due else []
    for key, row in due.items():
        if row.predictions is not None:
            answer, seconds = read_answer(row.predictions, sample, *what.public.frame(sample)), None
        else:
            answer, seconds = asked(row, sample, inputs)
        values = what.public.score(sample, answer, networks)
        if row.info.kind == "external":
            values |= what.public.suspicions(sample, answer)
        name = row.info.key
        store.add(Record(sample.table, sample.protocol, name, sample.key, sample.object, values, key, seconds=seconds))


def _info(what: PublicRun, records: Sequence[Record], contents: Sequence[str]) -> RunInfo:
    used = {record.method for record in records}
    return RunInfo(
        suite=what.public.name,
        suite_hash=hashlib.sha256("".join(contents).encode()).hexdigest(),
        resolution=what.public.resolution,
        methods=tuple(with_doubts(row.info, records) for row in what.rows if row.info.key in used),
        exposure="of the photographs",
        lpips=what.backbones,
        code=what.versions.code[:12],
        date=datetime.now(UTC).date().isoformat(),
        limit=what.limit,
        environment={name: installed_version(name) for name in ("unirender", "torch", "numpy")}
        | {"cpu": platform.machine(), "python": platform.python_version()},
    )
