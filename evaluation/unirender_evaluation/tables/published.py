"""The numbers that the paper printed, for the column beside ours. They are read, never recomputed.

`data/published.json` keeps the paper's rows, in its order, under its names; a value that the paper left out is absent.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from unirender.errors import UnirenderError

# The paper gives one system two names: the ablation without the cycle-consistency constraint.
ALIASES = {"Ours w/o re-render": "Ours w/o constrain"}


@dataclass(frozen=True)
class PublishedRow:
    """One system's row: values by `<quantity>.<metric>`, e.g. `albedo.psnr`."""

    name: str
    group: str  # "data-driven", "optimisation", "ours": the paper's separators
    values: Mapping[str, float]

    @property
    def label(self) -> str:
        """The name as our tables print it: the paper's "Ours" is not ours."""
        return self.name.replace("Ours", "Uni-Renderer", 1)

    def is_called(self, name: str | None) -> bool:
        """Whether `name` is this system, under either of its names."""
        return name is not None and ALIASES.get(name, name) == ALIASES.get(self.name, self.name)


@lru_cache(maxsize=1)
def published_tables() -> dict[str, tuple[PublishedRow, ...]]:
    """Rows of the paper's tables: "rendering", "inverse", "relighting"."""
    return {
        name: tuple(PublishedRow(row["name"], row["group"], row["values"]) for row in table["rows"])
        for name, table in _load()["tables"].items()
    }


def taken_how(table: str) -> str:
    """What is known and what is not of how the numbers of one of its tables were taken; printed with them."""
    everywhere, own = _load(), _load()["tables"][table]
    return (
        f"as printed in the paper, of systems and on data that are not those of this table ({everywhere['test_set']}); "
        f"not stated there: {everywhere['not_stated']}, {own['not_stated']}"
    )


def check_name(name: str) -> None:
    """Raises UnirenderError if no table of the paper has a row of that name."""
    names = [row.name for rows in published_tables().values() for row in rows]
    if not any(row.is_called(name) for rows in published_tables().values() for row in rows):
        raise UnirenderError(f"published row: got {name!r}, expected one of {', '.join(dict.fromkeys(names))}")


@lru_cache(maxsize=1)
def _load() -> dict:
    path = Path(__file__).parents[1] / "data" / "published.json"
    return json.loads(path.read_text(encoding="utf-8"))
