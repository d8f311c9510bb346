"""How far a measurement is: a bar at a terminal, elsewhere a line now and then, so that a log shows that it goes on."""

import threading
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TaskID, TextColumn, TimeRemainingColumn

EVERY = 20.0  # seconds from one line of a task to its next, at least
SURE = 0.05  # of a task: before, its pace says nothing yet


class LineProgress(Progress):
    """A `rich.progress.Progress` that draws nothing and prints lines: one when the count of a task is known, then one
    as it advances, at most every `EVERY` seconds, with the time that the rest takes at the pace since the first.

    Args:
        console: to print them on.
    """

    def __init__(self, console: Console) -> None:
        super().__init__(console=console, disable=True)
        self._said: dict[TaskID, float] = {}
        self._first: dict[TaskID, tuple[float, float]] = {}  # when the count was known, and what was done by then
        self._turn = threading.Lock()

    def add_task(self, description: str, *args: Any, **kwargs: Any) -> TaskID:
        """As `Progress.add_task`."""
        task = super().add_task(description, *args, **kwargs)
        self._say(task)
        return task

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """As `Progress.update`."""
        super().update(task_id, **changes)
        self._say(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """As `Progress.advance`."""
        super().advance(task_id, advance)
        self._say(task_id)

    def _say(self, task_id: TaskID) -> None:
        task = next(task for task in self.tasks if task.id == task_id)
        now = self.get_time()
        with self._turn:
            before = self._said.get(task_id)
            if not (task.total and task.visible) or task.finished or (before is not None and now - before < EVERY):
                return
            self._said[task_id] = now
            start, kept = self._first.setdefault(task_id, (now, task.completed))
        self.console.print(progress_line(task, kept, now - start), highlight=False, markup=False, soft_wrap=True)


def progress_line(task: Task, kept: float, seconds: float) -> str:
    """What is at work, how much of it is done, and how long the rest takes if it goes on as in these seconds, before
    which `kept` was done."""
    total = task.total or 0
    line, done = f"{task.description}: {task.completed:.0f} of {total:.0f}", task.completed - kept
    if done < SURE * (total - kept) or not done:
        return line
    return f"{line}, {_duration(seconds / done * (total - task.completed))} left at this pace"


def _duration(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 99.5 * 60 else f"{seconds / 3600:.1f} h"


def progress_bar(console: Console, *, transient: bool = False) -> Progress:
    """A bar with what is at work, how many are done and the time that remains; lines where `console` is no terminal.

    `transient`: the bar goes when it is done."""
    if not console.is_terminal:
        return LineProgress(Console(stderr=True, quiet=console.quiet))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=transient)
