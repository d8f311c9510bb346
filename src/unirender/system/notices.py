"""How a command speaks to its user: one line on the standard error. Light to import."""

import logging
import sys


def notice(text: str) -> None:
    """One line to the user that is no result."""
    print(f"unirender: {text}", file=sys.stderr)


class NoticeHandler(logging.Handler):
    """Prints what the package logs as notices."""

    def emit(self, record: logging.LogRecord) -> None:
        notice(record.getMessage())
