"""A run of `unirender bench speed`: measures part by part, prints each as it is there, writes."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rich.console import Console

from unirender_evaluation.studies.folder import open_folder, write_files
from unirender_evaluation.studies.speed.parts import PartName
from unirender_evaluation.studies.speed.timing import Part
from unirender_evaluation.tables.formats import json_text
from unirender_evaluation.tables.protocol import protocol_text

NAME = "speed"

Measures = dict[PartName, Callable[[], Part]]


def run(
    out: Path, measures: Mapping[PartName, Callable[[], Part]], protocol: Sequence[tuple[str, str]], console: Console
) -> list[Part]:
    """Measures the parts in turn; writes `speed.md` and `.json` anew after each, so that a late failure costs one."""
    with open_folder(out):
        parts: list[Part] = []
        for name, measure in measures.items():
            with console.status(f"{name} ..."):
                parts.append(measure())
            write_files(out, {f"{NAME}.md": to_markdown(parts, protocol), f"{NAME}.json": to_json(parts, protocol)})
            for table in parts[-1].tables:
                table.show(console)
        console.print(f"Protocol: {protocol_text(protocol)}.", style="dim", highlight=False, markup=False)
        console.print(f"{out / NAME}.md, .json", highlight=False, markup=False)
        return parts


def to_markdown(parts: Sequence[Part], protocol: Sequence[tuple[str, str]]) -> str:
    """Every table, and the protocol below them."""
    texts = [table.markdown() for part in parts for table in part.tables]
    return "\n".join([*texts, f"Protocol: {protocol_text(protocol)}.\n"])


def to_json(parts: Sequence[Part], protocol: Sequence[tuple[str, str]]) -> str:
    """Strict JSON of every part."""
    content = {"protocol": dict(protocol), **{part.name: part.data for part in parts}}
    return json_text(content)
