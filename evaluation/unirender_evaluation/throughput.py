"""How fast scoring is, and what its time goes into: the engine's own `score`, all variants of all metrics, in one
process.

Two questions are timed: a rendered *picture*, and the *maps* that were found in one (albedo, normal, roughness,
metallic). Both are a suite's, their pixels repeated up to the resolution, with every truth met once in a pass: what
LPIPS keeps of a truth that many methods share (`lpips.KEPT_TRUTHS`) makes a real run faster than this.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UsageError
from unirender.intrinsics import IMAGE_MAPS, Intrinsics
from unirender_evaluation import lpips, metrics
from unirender_evaluation.engine import Prediction, score
from unirender_evaluation.suites import Suite
from unirender_evaluation.task import Asked, Task
from unirender_evaluation.tasks import tasks

LEAST = lpips.KEPT_TRUTHS + 1  # pictures of a pass: with fewer, LPIPS would find features kept from the last one
QUESTIONS = {"picture": ("rendering", "from-image"), "maps": ("inverse", "single-image")}


@dataclass(frozen=True)
class Throughput:
    """How fast one kind of question is scored.

    Attributes:
        question: "picture" or "maps".
        resolution: side in pixels.
        values: numbers that one answer gets.
        per_second: answers scored in a second, in every repeat.
        shares: part -> its share of the time, median over repeats; "rest" is what no named part took. Sums to 1 up to
            the medians.
    """

    question: str
    resolution: int
    values: int
    per_second: tuple[float, ...]
    shares: dict[str, float]

    @property
    def median(self) -> float:
        return median(self.per_second)


@dataclass
class Clock:
    """Seconds spent inside watched functions, by part."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def watch(self, owner: Any, name: str, part_of: Callable[..., str]) -> Iterator[None]:
        """Times every call of `owner.name`; `part_of` names the part from the call's arguments."""
        function = getattr(owner, name)

        @wraps(function)
        def timed(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                part = part_of(*arguments, **options)
                self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start

        setattr(owner, name, timed)
        try:
            yield
        finally:
            setattr(owner, name, function)


def measure(
    suite: Suite, question: str, resolution: int, images: int, repeats: int, backbones: Sequence[str]
) -> Throughput:
    """Scores `images` answers `repeats` times, after one pass that loads what is loaded once.

    Args:
        suite: whose pictures.
        question: "picture" or "maps".
        resolution: side in pixels: a multiple of the suite's.
        images: answers in a pass.
        repeats: passes that are timed.
        backbones: of LPIPS.

    Raises:
        UsageError: the suite has not so many pictures, there are fewer than `LEAST`, or the resolution is no multiple.
    """
    answers = list(_answers(suite, question, resolution, images))
    passes: list[tuple[float, dict[str, float]]] = []
    values = 0
    for _ in range(1 + repeats):
        clock = Clock()
        with ExitStack() as stack:
            stack.enter_context(clock.watch(lpips.Lpips, "distance", lambda network, *_: f"LPIPS-{network.backbone}"))
            stack.enter_context(clock.watch(metrics, "ssim_map", lambda *_: "SSIM"))
            stack.enter_context(clock.watch(metrics, "ciede2000", lambda *_: "CIEDE2000"))
            start = time.perf_counter()
            for task, prediction in answers:
                values = len(score(task, prediction, backbones))
            passes.append((time.perf_counter() - start, clock.seconds))
    timed = passes[1:]
    shares = {part: median(seconds[part] / total for total, seconds in timed) for part in sorted(timed[0][1])}
    shares["rest"] = median(1 - sum(seconds.values()) / total for total, seconds in timed)
    return Throughput(question, resolution, values, tuple(images / total for total, _ in timed), shares)


def _answers(suite: Suite, question: str, resolution: int, images: int) -> Iterator[tuple[Task, Prediction]]:
    """Questions at the resolution, each with the truth darkened as its answer."""
    own = suite.spec.resolution
    if resolution % own:
        raise UsageError(f"--resolution {resolution}: expected a multiple of the suite's, {own}")
    found = list(tasks(suite, *QUESTIONS[question], list(suite.scenes)))
    if not LEAST <= images <= len(found):
        raise UsageError(f"--images {images}: expected {LEAST} to {len(found)}")
    for task in found[:images]:
        image = None if task.truth_image is None else _enlarged(task.truth_image, resolution // own)
        maps = None if task.truth_maps is None else _enlarged_maps(task.truth_maps, resolution // own)
        answered = None if maps is None or maps.albedo is None else maps.replace(albedo=0.8 * maps.albedo)
        mask = _enlarged(task.mask, resolution // own)
        asked = replace(task.asked, mask=mask, truth_image=image, truth_maps=maps)
        yield (
            replace(task, read=partial(_as_it_is, asked)),
            Prediction(None if image is None else 0.8 * image, answered),
        )


def _as_it_is(asked: Asked) -> Asked:
    return asked


def _enlarged(x: Float[np.ndarray, "h w c"], factor: int) -> Float[np.ndarray, "hh ww c"]:
    return x.repeat(factor, axis=0).repeat(factor, axis=1)


def _enlarged_maps(maps: Intrinsics, factor: int) -> Intrinsics:
    return maps.replace(**{name: _enlarged(maps.maps[name], factor) for name in maps.present if name in IMAGE_MAPS})
