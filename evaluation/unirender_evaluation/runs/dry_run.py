"""`bench run --dry-run`: what a run would compute and what its folder holds already, by row. Nothing is computed or
written.

The only estimate is one that was measured: where the folder holds records of a row, the mean seconds of its answers,
times those that are missing. It leaves scoring out, and so it is said.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from unirender_evaluation.records import Record
from unirender_evaluation.runs.benchmark import check_request, prepare, views_jobs
from unirender_evaluation.runs.config import BenchConfig, anywhere
from unirender_evaluation.runs.truth_check import stored_check
from unirender_evaluation.store import Store
from unirender_evaluation.tables.text import print_whole
from unirender_evaluation.truth.check import scenes_here


@dataclass(frozen=True)
class PlannedRow:
    """What a run has to do for one row."""

    label: str  # of the row
    stored: int  # records that are there
    missing: int  # records that would be computed
    seconds: float | None = None  # mean time of an answer, of the stored records that have one; None = not measured


@dataclass(frozen=True)
class Plan:
    """What a run has to do; `check_date` is that of the truth check that it would reuse, None = Mitsuba renders, or
    `unchecked` says why not; `jobs` processes of this machine, or those of a `cluster`."""

    out: Path
    rows: tuple[PlannedRow, ...]
    check_scenes: int
    check_date: str | None
    jobs: int
    cluster: str | None = None
    unchecked: str = ""


def planned(config: BenchConfig) -> Plan:
    """The plan of a configuration.

    Raises:
        UnirenderError: what would stop the run before it begins: unusable suite, checkpoint, plug-in or predictions.
    """
    config = anywhere(config)
    here, known = prepare(config), Store.open(config.out / "records.jsonl", mend=False).known
    every = itertools.chain(*(here.jobs(scene) for scene in here.scenes), views_jobs(here, config))
    # Without the jobs themselves, which hold the pictures of their scene.
    wanted = (job for job in every if job.possible or job.key in known)
    facts = [(job.label, job.is_done(known.__contains__), known.get(job.key)) for job in wanted]
    labels = dict.fromkeys(label for label, _, _ in facts)
    check = stored_check(check_request(config), here, known.keys()) if config.check_scenes else None
    unchecked = "" if scenes_here(here.suite) else "since the meshes of the suite are not here"
    return Plan(
        out=config.out,
        rows=tuple(
            _planned_row(label, [(done, record) for own, done, record in facts if own == label]) for label in labels
        ),
        check_scenes=config.check_scenes,
        check_date=None if check is None else str(check["date"]),
        jobs=config.jobs,
        cluster=config.cluster,
        unchecked=unchecked if config.check_scenes else "as --check-scenes 0 asks",
    )


def _planned_row(label: str, facts: Sequence[tuple[bool, Record | None]]) -> PlannedRow:
    """Of each job whether it is done, and its record if there is one."""
    stored = sum(done for done, _ in facts)
    times = [record.seconds for _, record in facts if record is not None]
    measured = [seconds for seconds in times if seconds is not None]
    mean = sum(measured) / len(measured) if measured else None
    return PlannedRow(label, stored, len(facts) - stored, mean)


def print_plan(plan: Plan, console: Console) -> None:
    """Prints a plan."""
    table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("Row")
    for name in ("stored", "to compute", "s an answer", "answers, s"):
        table.add_column(name, justify="right")
    for row in plan.rows:
        each = "-" if row.seconds is None else f"{row.seconds:.3g}"
        total = "-" if row.seconds is None else f"{row.seconds * row.missing:.3g}"
        table.add_row(escape(row.label), str(row.stored), str(row.missing), each, total)
    table.add_section()
    stored, missing = (sum(getattr(row, name) for row in plan.rows) for name in ("stored", "missing"))
    table.add_row("all", str(stored), str(missing), "", "")
    print_whole(console, table)
    scenes = "1 scene" if plan.check_scenes == 1 else f"{plan.check_scenes} scenes"
    check = f"Mitsuba renders {scenes}" if plan.check_date is None else f"that of {plan.check_date} is reused"
    if plan.check_date is None and plan.unchecked:
        check = f"none, {plan.unchecked}"
    console.print(f"Truth check: {check}.", highlight=False)
    if any(row.seconds is not None for row in plan.rows):
        console.print(
            "Seconds: the mean of the answers that are stored, in the process that gave them; scoring is not in them.",
            highlight=False,
        )
    processes = plan.cluster or ("this process" if plan.jobs == 0 else f"{plan.jobs} processes")
    console.print(f"Dry run: {missing} records for {processes} in {plan.out}; nothing was computed.", highlight=False)
