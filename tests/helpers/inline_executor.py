"""An executor that runs every task at once, in the process of the test."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any


class Inline:
    """What `generate` needs of an executor; `begun` counts the tasks.

    Args:
        before: called with the arguments of a task before it runs; what it raises is the task's outcome.
    """

    workers = 1

    def __init__(self, before: Callable[..., None] | None = None) -> None:
        self.begun = 0
        self.before = before

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future:
        self.begun += 1
        future: Future = Future()
        try:
            if self.before:
                self.before(*arguments)
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future
