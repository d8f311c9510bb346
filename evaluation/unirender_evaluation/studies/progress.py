"""The bar of a study that measures record by record."""

from collections.abc import Iterable

from rich.console import Console

from unirender.system.run_progress import progress_bar
from unirender_evaluation.records import Record


def collect(
    measured: Iterable[tuple[Record, bool]], total: int, title: str, console: Console
) -> tuple[list[Record], int]:
    """All records, and how many of them are new, under a bar."""
    records, computed = [], 0
    with progress_bar(console) as progress:
        bar = progress.add_task(title, total=total)
        for record, new in measured:
            records.append(record)
            computed += new
            progress.update(bar, advance=1, description=f"{record.sample}: {record.protocol}, {record.method}")
    return records, computed
