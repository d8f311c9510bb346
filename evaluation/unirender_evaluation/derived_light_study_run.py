"""A run of `unirender bench derived-light`: measures with progress, prints, writes."""

import hashlib
from datetime import UTC, datetime

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from unirender_evaluation.derived_light_study import DerivedLight, measure, methods, settings
from unirender_evaluation.derived_light_study_tables import table, to_json
from unirender_evaluation.optimiser_study import open_folder, write_files
from unirender_evaluation.records import Record
from unirender_evaluation.versions import installed_version

NAME = "derived_light"


def run(what: DerivedLight, console: Console) -> list[Record]:
    """Measures what is missing and writes `derived_light.md` and `derived_light.json`; returns all records.

    Args:
        what: the measurement.
        console: for progress and the table.
    """
    with open_folder(what.out):
        pictures = (1 + len(what.objects)) * len(what.lights)
        total = pictures * sum(len(methods(question)) for question in what.questions)
        records, computed = [], 0
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=not console.is_terminal) as progress:
            bar = progress.add_task("derived light", total=total)
            for record, new in measure(what):
                records.append(record)
                computed += new
                progress.update(bar, advance=1, description=f"{record.sample}: {record.protocol}")
        made = table(records, what.questions, what.lights)
        about = {
            **settings(what),
            "mitsuba": installed_version("mitsuba"),
            "code": hashlib.sha256(what.code.encode()).hexdigest()[:12],
            "date": datetime.now(UTC).date().isoformat(),
        }
        line = ", ".join(f"{name} {about[name]}" for name in ("resolution", "mitsuba", "code", "date"))
        write_files(what.out, {f"{NAME}.md": f"{made.markdown()}\n{line}.\n", f"{NAME}.json": to_json(records, about)})
        made.show(console)
        console.print(f"{computed} new records of {len(records)}; {what.out / NAME}.md, .json", highlight=False)
        return records
