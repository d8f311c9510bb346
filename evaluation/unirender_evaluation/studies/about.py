"""What a study says of itself below its tables, for who compares them with others."""

import hashlib
import os
from collections.abc import Mapping
from datetime import UTC, datetime

from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.versions import installed_version


def code_digest(code: str) -> str:
    """Twelve digits that stand for the versions of what the figures depend on."""
    return hashlib.sha256(code.encode()).hexdigest()[:12]


def today() -> str:
    """The date, as ISO 8601 has it."""
    return datetime.now(UTC).date().isoformat()


def description(suite: Suite, code: str, **more: str) -> dict[str, str]:
    """What a reader must know to compare."""
    return {
        "suite": f"{suite.spec.name} {suite.sha256[:12]}",
        "resolution": f"{suite.spec.resolution}",
        **more,
        "mitsuba": str(installed_version("mitsuba")),
        "cores": str(os.cpu_count()),
        "code": code_digest(code),
        "date": today(),
    }


def line(about: Mapping[str, object]) -> str:
    """A description as a line of Markdown."""
    return ", ".join(f"{name} {value}" for name, value in about.items()) + ".\n"
