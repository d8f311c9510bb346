"""`log.jsonl` of a run: a line of JSON for all that is worth knowing afterwards, each with its `step`.

Losses are averaged between two lines. What waits for the next line is part of the training state, so that the lines of
a resumed run are those of an uninterrupted one.
"""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from unirender.system.whole_files import whole_file
from unirender.system.writing import writing
from unirender.training.logs.live import Report
from unirender.training.optim.processes import Processes

LOG_FILE = "log.jsonl"
NEWS = {"data", "parts"}  # entries of lines on what holds from their step on
OVERFLOW = "above_x_max_"  # prefix of entries that are left out where they are zero


class RunLog:
    """The log of a run's folder; of several processes the first one writes it."""

    def __init__(self, folder: Path, processes: Processes) -> None:
        self.path, self.processes = folder / LOG_FILE, processes
        self.waiting: dict[str, list[float]] = defaultdict(list)

    def add(self, values: Mapping[str, float]) -> None:
        """Keeps the values of a step for the next line."""
        for name, value in values.items():
            self.waiting[name].append(value)

    def means(self) -> dict[str, float]:
        """Means over the steps since they were last asked for, and over the processes: all must ask."""
        own = {name: sum(values) / len(values) for name, values in self.waiting.items()}
        self.waiting.clear()
        of_all = self.processes.gather(own)
        means = {name: sum(of_one[name] for of_one in of_all) / len(of_all) for name in own}
        return {name: mean for name, mean in means.items() if mean or not name.startswith(OVERFLOW)}

    def tell(self, line: dict[str, Any], report: Report) -> None:
        """Writes a line, and reports it."""
        if not self.processes.is_main:
            return
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")
        report(line)

    def forget_after(self, step: int) -> None:
        """Drops the lines that a killed run wrote after its last state, whose steps come again, and unreadable ones."""
        if self.processes.is_main:
            forget_after(self.path, step)


def forget_after(path: Path, step: int) -> None:
    """Keeps the readable lines of a log up to a step, if there is one; at it, without what holds only from there on."""
    if not path.is_file():
        return
    kept = [line for line, values in _read(path) if values["step"] <= step - bool(NEWS & values.keys())]
    with writing(path), whole_file(path) as file:
        file.write("".join(kept).encode())


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a log that are whole; none of a file that is not there."""
    return [values for _, values in _read(path)] if path.is_file() else []


def _read(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Lines and what they hold, without those that a kill cut short or that are no line of a log."""
    for line in path.read_text(errors="replace").splitlines(keepends=True):
        try:
            values = json.loads(line)
        except ValueError:
            continue
        if line.endswith("\n") and isinstance(values, dict) and isinstance(values.get("step"), int):
            yield line, values
