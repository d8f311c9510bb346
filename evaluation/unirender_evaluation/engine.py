"""The engine of a run: asks methods and scores their answers, a job for each record that is wanted."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from unirender.errors import UnirenderError
from unirender.intrinsics import IMAGE_MAPS, Intrinsics
from unirender_evaluation.light_metrics import DIMMEST, score_light
from unirender_evaluation.methods.method import Image
from unirender_evaluation.methods.plausible import picture_doubt
from unirender_evaluation.methods.plugin_source import raised_in
from unirender_evaluation.methods.suspicions import suspicions
from unirender_evaluation.predictions.folder import BRIGHTEST
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row
from unirender_evaluation.store import Job, content_key
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import tasks
from unirender_evaluation.versions import Versions

T = TypeVar("T")


@dataclass(frozen=True)
class Prediction:
    """A method's answer to one task; what it cannot do stays None."""

    image: Image | None = None
    maps: Intrinsics | None = None
    seconds: float | None = None  # None: not measured


class NoAnswer(UnirenderError):
    """A stranger's method returned None: it has no answer to this question, which is no fault."""


@runtime_checkable
class Keeper(Protocol):
    """What keeps the predictions of some samples (`pictures.Pictures`)."""

    def has(self, task: Task, method: str, key: str) -> bool: ...

    def keep(self, task: Task, method: str, key: str, prediction: Prediction) -> None: ...


def answer(row: Row, task: Task) -> Prediction:
    """Asks a method one question; it is handed `task.inputs` and what its row declares, never the truth.

    The seconds of an answer hold those of a decomposition that was there before. Where a stranger's method returns
    None, that part of the answer is None.
    """
    start = time.perf_counter()
    if row.predictions is not None:
        image, maps = row.predictions.answer(task)
        return Prediction(image, maps)
    image = maps = None
    earlier = 0.0
    for capability in task.asks:
        if not callable(getattr(row.method, capability, None)):
            continue
        told = {name: getattr(task, name)() for name in row.told}
        asked = partial(ask, row, capability, task.identity, **task.inputs[capability], **told)
        if capability == "decompose":
            maps, earlier = decomposition(row, task.inputs[capability], asked)
        else:
            image = answered(asked)
    seconds = time.perf_counter() - start + earlier
    if row.info.kind == "external":
        check_light(row, task, maps)
        check_picture(row, task, image)
    return Prediction(image, maps, seconds)


def answered(asked: Callable[[], T]) -> T | None:
    """What a question to a method gives; None where a stranger's has no answer."""
    try:
        return asked()
    except NoAnswer:
        return None


def decomposition(
    row: Row, seen: Mapping[str, Any], asked: Callable[[], Intrinsics]
) -> tuple[Intrinsics | None, float]:
    """The maps that a row finds in a picture, and the seconds that they took before this call.

    A stranger's method decomposes a picture once, whatever tables want it.
    """
    if row.info.kind != "external":
        return asked(), 0.0
    return row.found.of(**seen, decompose=partial(answered, asked))


def check_picture(row: Row, task: Task, image: Image | None) -> None:
    """Refuses a stranger's picture in other units or conventions, whose score would say nothing of it."""
    if image is None or (doubt := picture_doubt(image, task.mask)) is None:
        return
    raise UnirenderError(
        f"method {row.info.label!r}, {task.answer} ({task.identity}): its picture is no linear, premultiplied "
        f"radiance: {doubt}; return linear values, straight colour times the mask"
    )


def check_light(row: Row, task: Task, maps: Intrinsics | None) -> None:
    """Refuses a stranger's light that cannot be scored.

    Raises:
        UnirenderError: it is no lat-long map twice as wide as high, is black (`DIMMEST`), or brighter than `BRIGHTEST`.
    """
    light = None if maps is None else maps.environment
    if light is None or not task.asks_light:
        return
    shape, largest = light.shape, float(light.max())
    if len(shape) == 3 and shape[0] >= 2 and shape[1] == 2 * shape[0] and DIMMEST < largest <= BRIGHTEST:
        return
    raise UnirenderError(
        f"method {row.info.label!r}, decompose ({task.identity}): got an environment of shape {shape} with radiance up "
        f"to {largest:.3g}, expected [height, 2 height, 3], at least 2 rows, and radiance in ({DIMMEST:g}, "
        f"{BRIGHTEST:g}]; leave it out where none is found"
    )


def ask(row: Row, capability: str, what: str, **inputs: Any) -> Any:
    """Calls one capability of a row's method. A stranger's is handed arrays of its own and may write into them; what it
    returns is copied, so that it may use its arrays again.

    Raises:
        NoAnswer: a stranger's method returns None.
        UnirenderError: it fails, or returns something else than maps or a finite picture of the question's size.
    """
    function = getattr(row.method, capability)
    if row.info.kind != "external":
        return function(**inputs)
    name = f"method {row.info.label!r}, {capability} ({what})"
    asked = inputs.get("intrinsics")
    size = inputs["image_srgb"].shape[:2] if asked is None else (asked.height, asked.width)
    try:
        with row.defaults.here():
            result = function(**{argument: _own(value) for argument, value in inputs.items()})
    except (Exception, SystemExit) as error:  # neither ends a run without a word
        raise UnirenderError(f"{name}: {type(error).__name__}: {error}{raised_in(error)}") from error
    if result is None:
        raise NoAnswer(f"{name}: got None, expected {'maps' if capability == 'decompose' else 'a picture'}")
    if capability != "decompose":
        return _picture(result, size, name)
    if not isinstance(result, Intrinsics):
        raise UnirenderError(f"{name}: got {type(result).__name__}, expected unirender.Intrinsics")
    for map_name, value in result.maps.items():
        if value.ndim != 3:
            raise UnirenderError(
                f"{name}: got {map_name} of shape {value.shape}, expected those of one picture, not a batch"
            )
        if map_name in IMAGE_MAPS and value.shape[:2] != size:
            raise UnirenderError(f"{name}: got maps of size {value.shape[:2]}, expected {size}")
        if map_name in IMAGE_MAPS:
            _check_brightness(value, map_name, name)
    try:
        return _own(result)
    except UnirenderError as error:  # the method wrote into its arrays after it had made maps of them
        raise UnirenderError(f"{name}: {error}") from error


def _own(value: Any) -> Any:
    """An array, or maps, in memory that nobody else has; anything else as it is."""
    if isinstance(value, Intrinsics):
        return value.replace(**{name: _own(array) for name, array in value.maps.items()})
    return value.copy(order="K") if isinstance(value, np.ndarray) else value


def _picture(result: Any, size: tuple[int, int], name: str) -> Image:
    """The picture that a stranger's method returned, as an array of float32."""
    expected = f"expected finite linear radiance, floats of shape {(*size, 3)}"
    try:
        picture = np.asarray(result)
    except Exception as error:  # of a tensor's or a list's own: it has a gradient, or is elsewhere than in memory
        raise UnirenderError(
            f"{name}: got {type(result).__name__}, of which no array can be made ({error}), {expected}"
        ) from error
    if picture.shape != (*size, 3) or picture.dtype.kind != "f":
        raise UnirenderError(f"{name}: got {picture.dtype} of shape {picture.shape}, {expected}")
    picture = picture.astype(np.float32)
    if bad := int(np.count_nonzero(~np.isfinite(picture))):
        raise UnirenderError(f"{name}: {bad} of {picture.size} values are NaN or infinite, {expected}")
    _check_brightness(picture, "a picture", name)
    return picture


def _check_brightness(value: np.ndarray, what: str, name: str) -> None:
    """Refuses what is no float32 any more once it is divided by an edge's coverage, and would be scored as NaN."""
    if (largest := float(np.abs(value).max())) > BRIGHTEST:
        raise UnirenderError(f"{name}: got {what} with values up to {largest:.3g}, expected at most {BRIGHTEST:g}")


def score(task: Task, prediction: Prediction, backbones: Sequence[str]) -> dict[str, float]:
    """All values of one prediction.

    A picture is premultiplied and has no mask of its own: the true one is pasted. Maps bring theirs, if they have one.
    """
    from unirender_evaluation import lpips
    from unirender_evaluation.scoring import score_image, score_maps

    if task.asks_light:
        return score_light(prediction.maps, task.truth_maps)
    networks = [lpips.load(name) for name in backbones]
    values: dict[str, float] = {}
    if prediction.image is not None and task.truth_image is not None:
        values |= score_image(prediction.image, task.truth_image, task.mask, quantity=task.quantity, lpips=networks)
    if prediction.maps is not None and task.truth_maps is not None:
        values |= score_maps(prediction.maps, task.truth_maps, lpips=networks)
    return values


def record_of(
    task: Task, info: MethodInfo, values: Mapping[str, float], key: str, seconds: float | None = None
) -> Record:
    """The record of one method on one task."""
    return Record(
        table=task.table,
        protocol=task.protocol,
        method=info.key,
        sample=task.sample,
        object=task.scene.object,
        values=values,
        key=key,
        seconds=seconds,
    )


def method_jobs(
    suite: Suite,
    rows: Sequence[Row],
    scenes: list[Scene],
    scene: Scene,
    versions: Versions,
    backbones: Sequence[str],
    pictures: Keeper,
) -> Iterator[Job]:
    """Every question about one scene to every row that answers it; row innermost, so that rows share decompositions.

    In the order of their neutral names: by that of the suite, a method that counts its calls would know the material.
    `scenes` are those of the whole run: rows on a subset choose from them.
    """
    for table, protocol in PROTOCOLS:
        for task in sorted(tasks(suite, table, protocol, [scene]), key=lambda task: task.folder):
            for row in rows:
                if row.answers(task, scenes):
                    key = content_key(suite, scene, task.identity, row.config, versions.of(row.scored_with))
                    make = partial(_ask, row, task, key, backbones, pictures)
                    yield Job(key, row.info.label, make, pictures.has(task, row.info.key, key))


def _ask(row: Row, task: Task, key: str, backbones: Sequence[str], pictures: Keeper) -> Record:
    prediction = answer(row, task)
    pictures.keep(task, row.info.key, key, prediction)
    values = score(task, prediction, backbones)
    if row.info.kind == "external":
        values |= suspicions(task, prediction.image, prediction.maps)
    return record_of(task, row.info, values, key, prediction.seconds)
