"""Runs the physics table: which row answers which test, on how many scenes."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial

from unirender.intrinsics import Intrinsics
from unirender_evaluation.bounds import SHADE_SPP, KeyOf
from unirender_evaluation.engine import NoAnswer, ask, decomposition
from unirender_evaluation.methods.mitsuba import MITSUBA
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.physics.stage import Light, Stage
from unirender_evaluation.physics.tests import LOSS, PSNR, TESTS, renderer_tests
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row
from unirender_evaluation.store import Job
from unirender_evaluation.suites.objects import object_is_here
from unirender_evaluation.suites.suite import Scene, Suite
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


def physics_scenes(suite: Suite, scenes: list[Scene], most: int | None) -> list[Scene]:
    """The scenes of the physics table: at most `most` of the run's, evenly spaced; None = all of them."""
    if most is None or len(scenes) <= most:
        return scenes
    return [s for s in scene_ids(suite, most) if s in scenes] or scenes[:most]


def loop_values(maps: Intrinsics, stage: Stage) -> dict[str, float]:
    """Metric key -> value of the closed loops of the maps found in the base picture, and what they lose to the true."""
    base, true = stage.suite.spec.base, stage.true_maps(stage.suite.spec.base)
    lights: tuple[Light, ...] = ("input", "heldout")
    values: dict[str, float] = {}
    for light in lights:
        for shader in ("shade", "composite"):
            values |= stage.loop_values(maps, shader, light, base, f"{shader}_{light}")
        key = metric_key(f"shade_{light}", PSNR)
        best = stage.loop_values(true, "shade", light, base, f"shade_{light}")[key]
        values[metric_key(f"loss_{light}", LOSS)] = best - values[key]
    return values


def physics_jobs(
    suite: Suite, scene: Scene, rows: Sequence[Row], key_of: KeyOf, with_mitsuba: bool = False
) -> Iterator[Job]:
    """The records of the physics table on one scene: renderers, decomposers, the true maps and, if asked for, Mitsuba's
    own buffers."""
    stage = Stage(suite, scene)
    bounds = ((TRUE_MAPS, _true_maps), *([(MITSUBA, _mitsuba)] if with_mitsuba else []))
    for info, record in bounds:
        key = key_of("physics", info, {REFERENCE})
        possible = info is not MITSUBA or object_is_here(suite, scene)
        yield Job(key, f"physics: {info.label}", partial(record, stage, key), possible=possible)
    for row in filter(takes_part, rows):
        loops = callable(getattr(row.method, "decompose", None))  # shaded again by Mitsuba
        key = key_of("physics", row.info, row.uses | {REFERENCE} if loops else row.uses)
        yield Job(key, f"physics: {row.info.label}", partial(_record, stage, row, key))


def _true_maps(stage: Stage, key: str) -> Record:
    return _made(stage, TRUE_MAPS, loop_values(stage.true_maps(stage.suite.spec.base), stage), key)


def _mitsuba(stage: Stage, key: str) -> Record:
    """Mitsuba's closed loops: its own buffers, traced again; nothing where the object is not the truth's."""
    mitsuba = stage.mitsuba
    values = loop_values(mitsuba.maps(stage.suite.spec.base), stage) if mitsuba.shows_the_truth else {}
    return _made(stage, MITSUBA, values, key)


def _record(stage: Stage, row: Row, key: str) -> Record:
    """The row's values of all tests that its functions can be asked for."""
    values: dict[str, float] = {}
    suite, scene = stage.suite, stage.scene
    if callable(getattr(row.method, "render", None)):
        render = partial(ask, row, "render", f"physics/{scene.key}")
        with suppress(NoAnswer):
            found = renderer_tests(lambda maps: render(intrinsics=maps), stage)
            values |= {TESTS[name].key: value for name, value in found.items()}
    if callable(getattr(row.method, "decompose", None)):
        seen = picture(suite, scene, suite.spec.base)
        maps, _ = decomposition(row, seen, partial(ask, row, "decompose", f"physics/{scene.key}", **seen))
        if maps is not None and {"albedo", "normal", "roughness", "metallic"} <= set(maps.present):
            values |= loop_values(maps, stage)
    return _made(stage, row.info, values, key)


def _made(stage: Stage, info: MethodInfo, values: dict[str, float], key: str) -> Record:
    return Record("physics", "physics", info.key, stage.scene.key, stage.scene.object, values, key)


def takes_part(row: Row) -> bool:
    """Whether a row is in the physics table: strangers' methods, Mitsuba's shading, the composite and our main row."""
    able = any(callable(getattr(row.method, name, None)) for name in ("render", "decompose"))
    return able and (row.info.kind in ("external", "reference") or row.info.key in METHODS)
