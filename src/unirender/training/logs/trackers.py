"""Experiment trackers: every line of the log goes to TensorBoard, Weights & Biases, ... by accelerate's classes.

    with tracking(make_trackers(("tensorboard",), run.out), config) as report:
        trainer.fit(source, report)

A tracker of your own is a subclass of `accelerate.tracking.GeneralTracker`: hand an instance to `tracking`, or name it
after `accelerate.tracking.register_tracker_class`.
"""

import contextlib
import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from accelerate.tracking import LOGGER_TYPE_TO_CLASS, GeneralTracker, get_available_trackers

from unirender.errors import UnirenderError, UsageError
from unirender.system.notices import notice
from unirender.system.wording import one_of
from unirender.training.config import TrainConfig
from unirender.training.logs.live import Report

TRACKER_FOLDER = "trackers"
PROJECT = "unirender"


def known_trackers() -> tuple[str, ...]:
    """Names of the trackers that work here: accelerate's that are installed, and those that were registered with it."""
    installed = {str(name) for name in get_available_trackers()}
    own = {name for name, kind in LOGGER_TYPE_TO_CLASS.items() if kind.__module__ != GeneralTracker.__module__}
    return tuple(sorted(installed | own))


def check_trackers(names: Sequence[str]) -> None:
    """Looks at names of trackers.

    Raises:
        UsageError: one is unknown or not installed.
    """
    usable = known_trackers()
    for name in names:
        if name not in usable:
            if name in LOGGER_TYPE_TO_CLASS:  # all of them have the name of their package
                raise UsageError(f"--track {name}: not installed here; pip install {name}")
            expected = one_of(name, sorted(LOGGER_TYPE_TO_CLASS))
            raise UsageError(f"--track {name}: no tracker that accelerate knows, {expected}")


def make_trackers(names: Sequence[str], run_folder: Path) -> tuple[GeneralTracker, ...]:
    """The named trackers of a run, not started yet.

    Those that write files do so in `trackers/` of the run folder. The same folder gives the same place again: a resumed
    run goes on in the tracker's run.

    Raises:
        UsageError: as `check_trackers`.
    """
    check_trackers(names)
    made: list[GeneralTracker] = []
    for name in names:
        kind: Callable[..., GeneralTracker] = LOGGER_TYPE_TO_CLASS[name]
        place = [run_folder / TRACKER_FOLDER] if LOGGER_TYPE_TO_CLASS[name].requires_logging_directory else []
        made.append(kind(PROJECT, *place, **_run_options(name, run_folder)))
    return tuple(made)


def _run_options(name: str, run_folder: Path) -> dict[str, Any]:
    """What a tracker without a folder of its own needs to find its run again."""
    if name != "wandb":
        return {}
    identity = hashlib.sha256(str(run_folder.resolve()).encode()).hexdigest()[:16]
    return {"name": run_folder.resolve().name, "id": identity, "resume": "allow"}


@contextlib.contextmanager
def tracking(
    trackers: Sequence[GeneralTracker],
    config: TrainConfig,
    resumed: bool = False,
    show: Report = lambda line: None,
) -> Iterator[Report]:
    """Starts the trackers, gives the function that sends them a line of the log, and finishes them.

    One that fails later, as where its server is gone, ends no training: that is said, and it is told nothing more.

    Args:
        trackers: not started yet.
        config: stored as the run's parameters.
        resumed: the run's parameters are stored already.
        show: is told every line, too.

    Raises:
        UnirenderError: one cannot be started, as where nobody is logged in to its service.
    """
    working = list(trackers)  # those that have not failed
    with contextlib.ExitStack() as stack:
        for tracker in trackers:
            with _starting(tracker):
                tracker.start()
            stack.callback(_finish, tracker, working)
            if not resumed:
                with _starting(tracker):
                    tracker.store_init_configuration(parameters(dataclasses.asdict(config)))

        def report(line: dict[str, Any]) -> None:
            show(line)
            values = numbers(line)
            step = int(values.pop("step"))
            if not values:
                return
            working[:] = [each for each in working if _told(each, functools.partial(each.log, values, step=step))]

        yield report


def _finish(tracker: GeneralTracker, working: Sequence[GeneralTracker]) -> None:
    """Finishes a tracker; one that has failed may fail again, of which nothing more is said."""
    if any(tracker is each for each in working):
        _told(tracker, tracker.finish)
    else:
        with contextlib.suppress(Exception):
            tracker.finish()


def _told(tracker: GeneralTracker, tell: Callable[[], object]) -> bool:
    """Whether a tracker took what it is told; if not, that is said."""
    try:
        tell()
    except Exception as error:  # of any library
        notice(f"{_named(tracker, 'failed', error)}; the training goes on without it, and log.jsonl has all")
        return False
    return True


@contextlib.contextmanager
def _starting(tracker: GeneralTracker) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # of any library
        raise UnirenderError(f"{_named(tracker, 'cannot be started', error)}; mend that, or leave it out") from error


def _named(tracker: GeneralTracker, what: str, error: Exception) -> str:
    """What happened to a tracker, and why."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return f"--track {getattr(tracker, 'name', type(tracker).__name__)}: {what} ({reason})"


def numbers(line: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """The numbers of a line of the log, those of its dicts as `dict/name`."""
    found: dict[str, float] = {}
    for name, value in line.items():
        if isinstance(value, Mapping):
            found |= numbers(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[prefix + name] = value
    return found


def parameters(config: Mapping[str, Any], prefix: str = "") -> dict[str, bool | str | float | int]:
    """A nested configuration as trackers take it: one level, names joined by dots, tuples as text."""
    found: dict[str, bool | str | float | int] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            found |= parameters(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value if isinstance(value, bool | str | float | int) else str(value)
    return found
