"""The report of a run's folder: at the end of a run, or of a finished one again (`unirender bench report`)."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import Variant
from unirender_evaluation.records import Record, RunInfo, read_records, read_run
from unirender_evaluation.report.page import write_report
from unirender_evaluation.report.samples import make_sheets
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import RANKED_KINDS, Table, build_tables

if TYPE_CHECKING:
    from unirender_evaluation.suites.suite import Suite

VERDICT = "verdict.txt"

logger = logging.getLogger(__name__)


def read_finished(folder: Path, variants: Sequence[Variant] | None = None) -> tuple[RunInfo, list[Record], list[Table]]:
    """What a finished run left: its description, its records, and the tables made from them, in these variants.

    Raises:
        UnirenderError: no run in the folder.
    """
    if not (folder / "run.json").is_file():
        raise UnirenderError(f"{folder}: no run.json, expected the folder that `unirender bench run --out` wrote")
    run = read_run(folder / "run.json")
    records = [record for record in read_records(folder / "records.jsonl") if record.values]
    return run, records, build_tables(records, run, ALL_TABLES, variants)


def rebuild(folder: Path, suite: str | None = None, variants: Sequence[Variant] | None = None) -> Path:
    """Writes `report.html` of a finished run again; nothing is measured. Warns where pictures of it are gone.

    Args:
        folder: that `unirender bench run --out` wrote.
        suite: name or TOML file; None = the name that the run recorded.
        variants: of the tables; None = the usual ones (`tables.build_tables`).

    Raises:
        UnirenderError: no run in the folder, or the suite is not the one that it scored.
    """
    from unirender_evaluation.report.pictures import Pictures
    from unirender_evaluation.suites.suite import load_suite  # what runs need, a report alone does not

    run, records, tables = read_finished(folder, variants)
    try:
        loaded = load_suite(suite or run.suite)
    except UnirenderError as error:
        if suite is not None:
            raise
        raise UnirenderError(
            f"{error}; if the run in {folder} scored a suite of your own, give it with --suite"
        ) from error
    if loaded.sha256 != run.suite_hash:
        to_do = "name it with --suite" if suite is None else f"leave --suite {suite} out, or name that one"
        raise UnirenderError(
            f"suite {loaded.spec.name}: got {loaded.sha256[:12]}, expected {run.suite} {run.suite_hash[:12]}, which "
            f"the run in {folder} scored; {to_do}"
        )
    answers = [record for record in records if run.method(record.method).kind in RANKED_KINDS]
    if absent := Pictures(folder / "pictures", loaded, []).absent(answers):
        logger.warning(
            "%s: the pictures of %d answers are not there, and the report lacks them; `unirender bench run` as it "
            "was given makes them again",
            *(folder / "pictures", len(absent)),
        )
    return report_run(folder, loaded, run, records, tables)


def report_run(folder: Path, suite: "Suite", run: RunInfo, records: Sequence[Record], tables: Sequence[Table]) -> Path:
    """Writes `report.html` of a run, with the gallery from its kept pictures; returns its path."""
    from unirender_evaluation.multiview.pictures import MultiviewPictures
    from unirender_evaluation.report.pictures import Pictures
    from unirender_evaluation.tasks import scene_ids

    pictures = Pictures(folder / "pictures", suite, scene_ids(suite, run.limit))
    items = pictures.items(records, leading_row(run))
    items += MultiviewPictures(folder / "pictures").items(records, suite, run)
    sheets = make_sheets(pictures.leading(records, leading_row(run)))
    verdict = (folder / VERDICT).read_text(encoding="utf-8") if (folder / VERDICT).is_file() else ""
    return write_report(
        folder / "report.html", tables, items, run, records, specs=ALL_TABLES, sheets=sheets, verdict=verdict
    )


def leading_row(run: RunInfo) -> str:
    """Key of the row whose scores choose the gallery's samples: our first, else the first stranger's, else empty."""
    return next((info.key for kind in ("ours", "external") for info in run.methods if info.kind == kind), "")
