"""Jobs for a worker process of the demo, which imports them by name."""

import os
import tempfile
import time
from pathlib import Path

from unirender.errors import UnirenderError
from unirender.pipelines.remembered import remembered

LOOKS: list[int] = []


def start() -> int:
    """A context."""
    return 40


def no_start() -> int:
    raise UnirenderError("no checkpoint: expected one")


def add(context: int, value: int) -> int:
    return context + value


def refuse(context: int) -> None:
    raise UnirenderError(f"refused with {context}")


def fail(context: int) -> float:
    return context / 0


def sleep(context: int, seconds: float) -> int:
    time.sleep(seconds)
    return context


def sleep_over_a_file(context: int, path: str) -> None:
    """Says where its temporary folder is, and takes its time."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "picture.png").touch()
        Path(path).write_text(folder)
        time.sleep(600)


def die(context: int) -> None:
    os._exit(3)


def process(context: int) -> int:
    return os.getpid()


@remembered(most=1)
def looked_at(picture: int) -> None:
    LOOKS.append(picture)


def look(context: int, picture: int) -> int:
    """How often a picture was looked at."""
    looked_at(picture)
    return len(LOOKS)
