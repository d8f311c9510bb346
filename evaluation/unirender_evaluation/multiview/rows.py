"""Runs the multi-view table: its rows, and the records of one scene.

An optimisation uses both cores and its seconds are part of the table: these records are made in the run's own process,
one after another, not in its workers.
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import cache, partial

from unirender_evaluation.bounds import KeyOf, ceiling_info
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.multiview.methods import PLAIN_ITERATIONS, ConstantObject, Optimized, PlainLoop
from unirender_evaluation.multiview.pictures import MultiviewPictures
from unirender_evaluation.multiview.scenes import MultiviewScene, suite_scene
from unirender_evaluation.multiview.scoring import ceiling_values, score_solution, solution_looks, true_looks
from unirender_evaluation.multiview.settings import STANDARD, MultiviewSettings
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE, PROTOCOL, SECONDS
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row, make_row
from unirender_evaluation.store import Job
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.versions import MULTIVIEW, OPTIMIZER, REFERENCE

TRIVIAL_USES = frozenset({MULTIVIEW, REFERENCE})
OPTIMIZED_USES = TRIVIAL_USES | {OPTIMIZER}


def multiview_rows() -> list[Row]:
    """The rows of the multi-view table, the ceiling aside."""
    return [
        make_row(Optimized(), "optimisation", uses=OPTIMIZED_USES),
        make_row(
            PlainLoop(),
            "optimisation",
            uses=OPTIMIZED_USES,
            note=f"Adam, {PLAIN_ITERATIONS} steps of 16 samples, squared error of display values, from a grey object "
            "in uniform light",
        ),
        make_row(
            ConstantObject(),
            "trivial",
            uses=TRIVIAL_USES,
            note="training objects' mean albedo, metallic and roughness 0.5, uniform light of the pictures' energy",
        ),
    ]


def multiview_jobs(
    suite: Suite,
    scene: Scene,
    rows: Sequence[Row],
    key_of: KeyOf,
    backbones: Sequence[str],
    pictures: MultiviewPictures,
    settings: MultiviewSettings = STANDARD,
) -> Iterator[Job]:
    """The records of the multi-view table on one scene; what they share is rendered when the first is made."""
    question = f"{MULTIVIEW_TABLE.name}/{PROTOCOL}/{json.dumps(asdict(settings), sort_keys=True)}"
    shared = cache(lambda: suite_scene(suite, scene, settings))
    info = ceiling_info(suite)
    key = key_of(question, info, TRIVIAL_USES)
    yield Job(key, f"multi-view: {info.label}", partial(_ceiling, shared, scene, info, key))
    for row in rows:
        key = key_of(question, row.info, row.scored_with)
        make = partial(_solved, shared, scene, row, key, backbones, pictures)
        yield Job(key, f"multi-view: {row.info.label}", make, pictures.has(scene.key, row.info.key, key))


def _ceiling(shared: Callable[[], MultiviewScene], scene: Scene, info: MethodInfo, key: str) -> Record:
    return _record(scene, info, ceiling_values(shared()), key)


def _solved(
    shared: Callable[[], MultiviewScene],
    scene: Scene,
    row: Row,
    key: str,
    backbones: Sequence[str],
    pictures: MultiviewPictures,
) -> Record:
    """The record of a method on one object: it is solved, timed, rendered and scored."""
    from unirender_evaluation import lpips

    networks = [lpips.load(name) for name in backbones]
    views, mesh = shared().views, shared().mesh
    start = time.perf_counter()
    solution = row.method.solve(views, mesh)
    seconds = time.perf_counter() - start
    looks = solution_looks(shared(), solution)
    values = score_solution(shared(), solution, networks, looks)
    if row.info.kind != "trivial":  # which optimises nothing
        values[metric_key("time", SECONDS)] = seconds
    pictures.keep(scene.key, row.info.key, key, shared(), looks)
    pictures.keep_truth(scene.key, shared(), true_looks(shared()))
    return _record(scene, row.info, values, key, seconds)


def _record(scene: Scene, info: MethodInfo, values: dict[str, float], key: str, seconds: float | None = None) -> Record:
    return Record(MULTIVIEW_TABLE.name, PROTOCOL, info.key, scene.key, scene.object, values, key, seconds=seconds)
