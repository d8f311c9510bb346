"""Rows of a study, chosen by their names or groups, as `--variants` and `--choices` take them. Light to import.

A row without a group is what the others are compared with.
"""

from collections.abc import Sequence
from typing import Protocol, TypeVar, runtime_checkable

from unirender.errors import UsageError
from unirender.system.wording import meant, near


@runtime_checkable
class StudyRow(Protocol):
    """What a row must say of itself."""

    @property
    def name(self) -> str:
        """On the command line and in records."""
        ...

    @property
    def group(self) -> str:
        """What it has in common with some of the others; empty for the row that they are compared with."""
        ...


Row = TypeVar("Row", bound=StudyRow)


def chosen(rows: Sequence[Row], names: Sequence[str], option: str) -> tuple[Row, ...]:
    """The rows with these names, or of these groups, in their order; rows without a group are always among them.

    Raises:
        UsageError: there is no such row or group.
    """
    known = [row.name for row in rows]
    groups = list(dict.fromkeys(row.group for row in rows if row.group))
    if unknown := [name for name in names if name not in (*known, *groups)]:
        raise UsageError(
            f"{option} {' '.join(unknown)}: expected some of {', '.join(known)}, or the groups {', '.join(groups)}"
            f"{meant(near(unknown[0], [*known, *groups]))}"
        )
    return tuple(row for row in rows if not names or not row.group or {row.name, row.group} & set(names))
