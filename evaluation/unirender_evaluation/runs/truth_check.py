"""The truth check of a run folder: rendered anew, or reused where the stored one has the same truth, code and seed.

`truth_check.json` holds the check's summary, when it was made, what identifies it, and the content keys of the records
that its renders give the row *reference (other seed)*. What a check has rendered is in `truth_check.part` until it is
done: one that is stopped goes on from there.
"""

import json
import secrets
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.progress import Progress

from unirender.system.whole_files import replace_file
from unirender_evaluation import bounds
from unirender_evaluation.engine import Prediction, record_of, score
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.store import Store, content_key
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.tasks import tasks
from unirender_evaluation.truth.check import (
    TruthCheck,
    check_steps,
    check_truth,
    chosen_scenes,
    scenes_here,
    where_meshes_belong,
)
from unirender_evaluation.truth.renders import TruthRenders
from unirender_evaluation.versions import LPIPS, REFERENCE

DRAWS = 1000  # of a seed whose scenes meet those of a limited run


@dataclass(frozen=True)
class CheckRequest:
    """What is to be checked."""

    path: Path  # of `truth_check.json`
    scenes: int  # how many; 0 = nothing is checked
    seed: int | None = None  # of scenes and renders; None = that of the stored check, or one drawn at random
    again: bool = False  # render also where the stored check would do

    @property
    def renders(self) -> TruthRenders:
        """What a check that is under way has rendered."""
        return TruthRenders(self.path.with_suffix(".part"))


def run_check(
    request: CheckRequest, here: Run, store: Store, progress: Progress, say: Callable[[str], None]
) -> dict[str, Any]:
    """The check's summary; its records are in the store, those of scenes outside the run laid by.

    Where no scene is asked for, or no object of the suite is here, its truth is not rendered again: `passed` is None,
    and no file is written.
    """
    if not request.scenes:
        return _none("--check-scenes 0", "--check-scenes 0")
    stored = stored_check(request, here, store.known.keys() | store.used.keys())
    if stored is not None:
        for key, scene in stored["records"].items():
            if here.suite.scene(scene) in here.scenes:
                store.has(key)
        say(
            f"Truth check of {stored['date']} reused: same truth, same code, check seed {stored['seed']} "
            "(--recheck renders again)"
        )
        request.renders.remove()
        return stored
    if not scenes_here(here.suite):
        reason = f"its meshes are not in {where_meshes_belong(here.suite)}"
        say(
            f"No truth check: {reason}. Of Mitsuba's rows what is stored counts. Rows that are told the true shape, as "
            "some of the group optimisation are, end the run: leave them out with --methods."
        )
        return _none(reason, "its meshes are not here")
    outcome = _rendered(request, here, progress, say)
    summary = outcome.summary()
    check = summary | {
        "identity": _identity(request, here),
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
        "checked_scenes": summary["scenes"],
    }
    info = reference_row(check, here.scenes)
    records = _records(outcome, info, here)
    for record, scene in records:
        if scene in here.scenes:
            store.add(record)
        else:
            store.lay_by(record)
    check["records"] = {record.key: scene.key for record, scene in records}
    replace_file(request.path, json.dumps(check, indent=1) + "\n")
    request.renders.remove()
    return check


def _none(reason: str, unchecked: str) -> dict[str, Any]:
    """What there is of a check that was not made: why, for the verdict, and in a few words for every table."""
    return {"passed": None, "reason": reason, "unchecked": unchecked, "seed": 0, "checked_scenes": []}


def stored_check(request: CheckRequest, here: Run, known: Collection[str]) -> dict[str, Any] | None:
    """The check in the run's folder, if it is the one that is asked for."""
    stored = read_check(request.path)
    complete = all(key in known for key in stored.get("records", {}))
    same = stored.get("identity") == _identity(request, here) and request.seed in (None, stored.get("seed"))
    return stored if same and complete and not request.again else None


def _identity(request: CheckRequest, here: Run) -> list[Any]:
    return [here.suite.sha256, request.scenes, here.versions.of({REFERENCE, LPIPS})]


def reference_row(check: dict[str, Any], scenes: list[Scene]) -> MethodInfo:
    """The row *reference (other seed)* of a run over `scenes`."""
    keys = {scene.key for scene in scenes}
    return bounds.reference_info(check["seed"], len(keys.intersection(check["checked_scenes"])))


def draw_seed(suite: Suite, count: int, scenes: list[Scene]) -> int:
    """A seed at random; for a run over a few scenes one whose check meets them, or the reference row is empty."""
    seed = secrets.randbits(31)
    for _ in range(DRAWS):
        if any(scene in scenes for scene in chosen_scenes(suite, count, seed)):
            break
        seed = secrets.randbits(31)
    return seed


def read_check(path: Path) -> dict[str, Any]:
    """The stored check; empty where there is none, or half a file that a kill has left."""
    if path.exists():
        with suppress(json.JSONDecodeError):
            found = json.loads(path.read_text(encoding="utf-8"))
            return found if isinstance(found, dict) else {}
    return {}


def _rendered(request: CheckRequest, here: Run, progress: Progress, say: Callable[[str], None]) -> TruthCheck:
    """The check, rendered as far as it is not there."""
    renders, identity = request.renders, _identity(request, here)
    seed = renders.begun(identity) if request.seed is None else request.seed
    if seed is None:
        seed = draw_seed(here.suite, request.scenes, here.scenes)
    renders.begin(identity, seed)
    if there := renders.count():
        say(f"Truth check: goes on from {there} renders of check seed {seed}.")
    bar = progress.add_task("Mitsuba: truth check", total=check_steps(here.suite, request.scenes, seed))
    outcome: TruthCheck | None = None
    for step in check_truth(here.suite, request.scenes, seed, renders):
        if isinstance(step, TruthCheck):
            outcome = step
        else:
            progress.advance(bar)
    progress.remove_task(bar)
    assert outcome is not None, "the last step is the whole check"
    return outcome


def _records(outcome: TruthCheck, info: MethodInfo, here: Run) -> list[tuple[Record, Scene]]:
    """The re-rendered truth as predictions, scored."""
    images = {check.name: check.mean for check in outcome.checks}
    version, found = here.versions.of({REFERENCE, LPIPS}), []
    for table, protocol in PROTOCOLS:
        for task in tasks(here.suite, table, protocol, list(here.suite.scenes)):
            image, maps = bounds.reference_prediction(task, images, here.suite)
            if image is not None or maps is not None:
                key = content_key(here.suite, task.scene, task.identity, info.config, version)
                values = score(task, Prediction(image, maps), here.backbones)
                found.append((record_of(task, info, values, key), task.scene))
    return found
