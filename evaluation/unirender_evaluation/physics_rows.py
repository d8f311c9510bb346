"""Runs the physics table: which row answers which test, on how many scenes."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from unirender.intrinsics import Intrinsics
from unirender_evaluation.bounds import SHADE_SPP, KeyOf, Shade
from unirender_evaluation.engine import Job, ask
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.physics import RENDERER_TESTS, closed_loop, composite_shader, renderer_tests
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row
from unirender_evaluation.scoring import score_image
from unirender_evaluation.suites import Scene, Suite
from unirender_evaluation.tasks import picture, scene_ids
from unirender_evaluation.versions import REFERENCE

TRUE_MAPS = MethodInfo(
    "true-maps",
    "True maps",
    "reference",
    note="the closed loops' ceiling, since one point per pixel is not a render",
    config={"bound": "true-maps", "spp": SHADE_SPP},
)
INFOS = (TRUE_MAPS,)
METHODS = ("composite", "ours-mean")


def shade_under(maps: Intrinsics, environment: Any) -> Any:
    """Mitsuba's shading of maps under a light."""
    return Shade().render(maps.replace(environment=environment))


SHADERS = {"shade": shade_under, "composite": composite_shader}


def physics_scenes(suite: Suite, scenes: list[Scene], most: int | None) -> list[Scene]:
    """The scenes of the physics table: at most `most` of the run's, evenly spaced; None = all of them."""
    if most is None or len(scenes) <= most:
        return scenes
    return [s for s in scene_ids(suite, most) if s in scenes] or scenes[:most]


def renderer_values(render: Callable[[Intrinsics], Any], suite: Suite, scene: Scene) -> dict[str, float]:
    """Metric key -> value of a renderer's tests on one scene."""
    values = renderer_tests(render, suite, scene)
    return {metric_key(name, RENDERER_TESTS[name][1]): value for name, value in values.items()}


def loop_values(maps: Intrinsics, suite: Suite, scene: Scene) -> dict[str, float]:
    """Metric key -> value of the closed loops of one picture's maps."""
    base, mask, values = suite.spec.base, suite.mask(scene), {}
    for name, image in closed_loop(maps.replace(mask=mask), suite, scene, SHADERS).items():
        lit = scene if name.endswith("input") else suite.other_light(scene)
        values |= score_image(image, suite.image(lit, base), mask, quantity=name)
    return values


def physics_jobs(suite: Suite, scene: Scene, rows: Sequence[Row], key_of: KeyOf) -> Iterator[Job]:
    """The records of the physics table on one scene: renderers, decomposers, and the true maps."""
    key = key_of("physics", TRUE_MAPS, {REFERENCE})
    yield Job(key, f"physics: {TRUE_MAPS.label}", partial(_true_maps, suite, scene, key))
    for row in filter(takes_part, rows):
        loops = callable(getattr(row.method, "decompose", None))  # shaded again by Mitsuba
        key = key_of("physics", row.info, row.uses | {REFERENCE} if loops else row.uses)
        yield Job(key, f"physics: {row.info.label}", partial(_record, suite, scene, row, key))


def _true_maps(suite: Suite, scene: Scene, key: str) -> Record:
    values = loop_values(suite.intrinsics(scene, suite.spec.base), suite, scene)
    return Record("physics", "physics", TRUE_MAPS.key, scene.key, scene.object, values, key)


def _record(suite: Suite, scene: Scene, row: Row, key: str) -> Record:
    values: dict[str, float] = {}
    if callable(getattr(row.method, "render", None)):
        render = partial(ask, row, "render", f"physics/{scene.key}")
        values |= renderer_values(lambda maps: render(intrinsics=maps), suite, scene)
    if callable(getattr(row.method, "decompose", None)):
        seen = picture(suite, scene, suite.spec.base)
        maps = ask(row, "decompose", f"physics/{scene.key}", **seen)
        if {"albedo", "normal", "roughness", "metallic"} <= set(maps.present):
            values |= loop_values(maps, suite, scene)
    return Record("physics", "physics", row.info.key, scene.key, scene.object, values, key)


def takes_part(row: Row) -> bool:
    """Whether a row is in the physics table: strangers' methods, Mitsuba's shading, the composite and our main row."""
    able = any(callable(getattr(row.method, name, None)) for name in ("render", "decompose"))
    return able and (row.info.kind in ("external", "reference") or row.info.key in METHODS)
