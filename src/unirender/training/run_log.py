"""`log.jsonl` of a run: a line of JSON for all that is worth knowing afterwards, each with its `step`.

Losses are averaged between two lines. What waits for the next line is part of the training state, so that the lines of
a resumed run are those of an uninterrupted one.
"""

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from unirender.files import replace_file
from unirender.training.live import Report
from unirender.training.processes import Processes
from unirender.writing import writing

LOG_FILE = "log.jsonl"
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
        """Drops the lines that a killed run wrote after its last state: their steps come again."""
        if not self.processes.is_main or not self.path.is_file():
            return
        lines = self.path.read_text().splitlines(keepends=True)
        kept = [line for line in lines if line.endswith("\n") and json.loads(line)["step"] <= step]
        with writing(self.path):
            replace_file(self.path, "".join(kept))
