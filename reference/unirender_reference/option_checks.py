"""Ranges of options, with one sentence for a value outside. Light to import."""

import math
from collections.abc import Collection, Mapping
from typing import Any

from unirender.errors import UsageError
from unirender.system.wording import one_of


def require_least(options: Any, group: str, least: Mapping[str, float], above: bool = False) -> None:
    """Looks at some fields of a group of options; None is in every range.

    Args:
        options: a dataclass.
        group: its name on the command line; empty: none.
        least: by field, the smallest value that serves.
        above: the values have to be larger than that.

    Raises:
        UsageError: one is smaller, infinite or NaN.
    """
    for name, bound in least.items():
        value = getattr(options, name)
        if value is None:
            continue
        if not math.isfinite(value) or value < bound or (above and value == bound):
            wanted = f"more than {bound:g}" if above else f"{bound:g} or more"
            shown = f"{value:g}" if isinstance(value, float) else str(value)
            prefix = f"{group}." if group else ""
            raise UsageError(f"--{prefix}{name.replace('_', '-')} {shown}: expected {wanted}")


def require_one_of(options: Any, group: str, choices: Mapping[str, Collection[str]]) -> None:
    """Looks at some fields of a group of options that name one of a few things.

    Args:
        options: a dataclass.
        group: its name on the command line.
        choices: by field, the names that serve.

    Raises:
        UsageError: one is another name.
    """
    for name, names in choices.items():
        value = getattr(options, name)
        if value not in names:
            option = f"--{group}.{name.replace('_', '-')}"
            raise UsageError(f"{option} {value!s:.40}: {one_of(str(value), names)}")
