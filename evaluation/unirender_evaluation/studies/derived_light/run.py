"""A run of `unirender bench derived-light`: measures with progress, prints, writes."""

from rich.console import Console

from unirender_evaluation.records import Record
from unirender_evaluation.studies.about import code_digest, today
from unirender_evaluation.studies.derived_light.measure import DerivedLight, measure, methods, settings
from unirender_evaluation.studies.derived_light.tables import table, to_json
from unirender_evaluation.studies.folder import open_folder, write_study
from unirender_evaluation.studies.progress import collect
from unirender_evaluation.versions import installed_version

NAME = "derived_light"


def run(what: DerivedLight, console: Console) -> list[Record]:
    """Measures what is missing and writes `derived_light.md` and `derived_light.json`; returns all records."""
    with open_folder(what.out):
        pictures = (1 + len(what.objects)) * len(what.lights)
        total = pictures * sum(len(methods(question)) for question in what.questions)
        records, computed = collect(measure(what), total, "derived light", console)
        made = table(records, what.questions, what.lights)
        about = {
            **settings(what),
            "mitsuba": installed_version("mitsuba"),
            "code": code_digest(what.code),
            "date": today(),
        }
        counts = f"{computed} new records of {len(records)}"
        below = {name: about[name] for name in ("resolution", "mitsuba", "code", "date")}
        write_study(what.out / NAME, [made], below, to_json(records, about), counts, console)
        return records
