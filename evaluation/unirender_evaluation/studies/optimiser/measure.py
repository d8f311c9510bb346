"""Measures the ingredients: each row on each object, stored as soon as it is known and never measured twice.

Rows that differ from the full method in the refinement alone go on from the same transport start, which is solved
once for each object; its seconds count in each of them.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path

from rich.console import Console

from unirender_evaluation.metrics import metric_key
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.scoring import score_solution
from unirender_evaluation.multiview.tables import PROTOCOL, SECONDS
from unirender_evaluation.records import Record
from unirender_evaluation.store import Store
from unirender_evaluation.studies.optimiser.ingredients import Ingredient
from unirender_evaluation.studies.optimiser.study import Study, work_through
from unirender_evaluation.suites.suite import Scene
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.transport.config import TransportConfig

TABLE = "ingredients"
RECORDS = "records.jsonl"


class Starts:
    """The transport stage's results on one object, each solved once."""

    def __init__(self, scene: MultiviewScene) -> None:
        self._solved = cache(partial(_solve, scene))

    def of(self, config: OptimizeConfig) -> tuple[Solution, float]:
        """The start of a configuration and the seconds that it took; the refinement plays no part in it."""
        return self._solved(config.transport, config.texture_size, config.light_rows, config.seed)


def _solve(
    scene: MultiviewScene, transport: TransportConfig, size: int, light_rows: int, seed: int
) -> tuple[Solution, float]:
    from unirender_reference.optimize.shape.uv import charted
    from unirender_reference.optimize.transport.solve import solve_appearance

    views, mesh = scene.views, scene.mesh  # rendered before the clock starts
    began = time.perf_counter()
    solution = solve_appearance(
        views, charted(mesh, size), transport, texture_size=size, light_rows=light_rows, seed=seed
    )
    return solution, time.perf_counter() - began


def measure(scene: MultiviewScene, starts: Starts, config: OptimizeConfig) -> dict[str, float]:
    """Metric key -> value of what the optimiser finds, with its seconds; without LPIPS."""
    from unirender_reference.optimize.multiview.run import optimize

    start, seconds = starts.of(config)
    began = time.perf_counter()
    found = optimize(scene.views, None, config, init=start)
    seconds += time.perf_counter() - began
    return score_solution(scene, found) | {metric_key("time", SECONDS): seconds}


def rendered_protocol(study: Study) -> tuple[tuple[str, str], ...]:
    """The protocol of the study, with what results are rendered with."""
    settings = study.settings
    return study.protocol(
        pictures=f"relit (the object's other light) and novel view: {settings.held_out} held-out cameras, masked sRGB, "
        f"{settings.truth_spp} spp, against results at {settings.spp} spp"
    )


def measure_all(study: Study, rows: Sequence[Ingredient], folder: Path, console: Console) -> list[Record]:
    """The records of all rows on all objects; those that the folder holds already are read."""
    store = Store.open(folder / RECORDS)
    jobs: dict[str, Callable[[], None]] = {}
    for scene in study.scenes:
        shared = cache(partial(_opened, study, scene))
        for row in rows:
            key = study.key(scene, f"{TABLE}/{row.name}", asdict(row.config))
            if not store.has(key):
                jobs[f"{scene.object}, {row.name}"] = partial(_add, store, shared, scene, row, key)
    work_through(jobs, console, "ingredients")
    return store.close()


def _opened(study: Study, scene: Scene) -> tuple[MultiviewScene, Starts]:
    opened = study.scene(scene)
    return opened, Starts(opened)


def _add(
    store: Store, shared: Callable[[], tuple[MultiviewScene, Starts]], scene: Scene, row: Ingredient, key: str
) -> None:
    values = measure(*shared(), row.config)
    seconds = values[metric_key("time", SECONDS)]
    store.add(Record(TABLE, PROTOCOL, row.name, scene.key, scene.object, values, key, seconds=seconds))
