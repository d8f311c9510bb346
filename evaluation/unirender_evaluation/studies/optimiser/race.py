"""Runs the race: our optimiser and the plain loop on the same pictures, one after the other in one process.

Ours runs first, so that kernels which both need are compiled in its time. The plain loop is the one of Mitsuba's
tutorials (`RefineConfig.plain`) from a grey object in uniform light, once for each loss. Both are watched by the same
measure: the aligned albedo of the multi-view table.
"""

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.multiview.methods import LIGHT_SHAPE, PLAIN_TEXTURE
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.scoring import score_colour
from unirender_evaluation.studies.optimiser.curves import Curve, Point
from unirender_evaluation.studies.optimiser.study import Study, work_through
from unirender_evaluation.suites.suite import Scene
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Step

OURS = "ours"
CURVES = "curves.jsonl"


@dataclass(frozen=True)
class RaceSettings:
    """What runs; of the plain losses the one counts that is first at the best albedo of them all."""

    ours: OptimizeConfig
    iterations: int = 400  # of the plain loop
    losses: tuple[str, ...] = ("srgb", "linear")  # of the plain loop, a run each
    plain_every: int = 20  # iterations of the plain loop between two measures
    our_every: int = 5  # iterations of our refinement between two measures


@dataclass(frozen=True)
class ObjectRace:
    """The curves of one object."""

    key: str  # content key
    object: str  # its name
    start: float  # albedo of the grey start, dB
    ours: Curve  # its first point is the transport stage's result
    loops: tuple[Curve, ...]  # of the plain loops

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, line: str) -> "ObjectRace":
        """Inverse of `to_json`."""

        def curve(data: dict) -> Curve:
            return Curve(data["name"], tuple(Point(**point) for point in data["points"]))

        data = json.loads(line)
        return cls(data["key"], data["object"], data["start"], curve(data["ours"]), tuple(map(curve, data["loops"])))


class StopWatch:
    """Seconds of work; stands while something is measured."""

    def __init__(self) -> None:
        self._began, self._stood = time.perf_counter(), 0.0

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began - self._stood

    @contextlib.contextmanager
    def stands(self) -> Iterator[None]:
        """What is done in the block does not count."""
        began = time.perf_counter()
        yield
        self._stood += time.perf_counter() - began


def albedo_psnr(scene: MultiviewScene, solution: Solution) -> float:
    """PSNR of the albedo in dB as in the multi-view table: all cameras, masked, sRGB, one factor for the object."""
    found, truth = scene.buffers_of(solution.obj).albedo, scene.buffers
    assert found is not None  # every object has an albedo
    assert truth.albedo is not None
    assert truth.mask is not None
    values = score_colour("albedo", found, truth.albedo, truth.mask, truth.mask, ("aligned",))
    return values[metric_key("albedo", "psnr", Variant(scale="aligned"))]


def descend(
    name: str,
    scene: MultiviewScene,
    watch: StopWatch,
    start: Solution,
    config: RefineConfig,
    every: int,
    first: Sequence[Point] = (),
) -> tuple[Curve, Solution]:
    """Runs a refinement and measures it every so many iterations, and at its end; `first` was measured before."""
    from unirender_reference.optimize.refine.run import refine
    from unirender_reference.optimize.refine.state import RefineState

    state, points = RefineState.begin(start, config), list(first)

    def on_step(step: Step) -> bool:
        if state.iteration % every == 0 or state.iteration == config.iterations:
            seconds = watch.seconds
            with watch.stands():
                points.append(Point(state.iteration, seconds, albedo_psnr(scene, state.solution(start, config))))
        return True

    found = refine(scene.views, start, config, on_step, state)
    return Curve(name, tuple(points)), found


def run_ours(scene: MultiviewScene, settings: RaceSettings) -> tuple[Curve, Solution]:
    """Our curve: the transport stage, then refinement."""
    from unirender_reference.optimize.shape.uv import charted
    from unirender_reference.optimize.transport.solve import solve_appearance

    config = settings.ours
    views, mesh, _ = scene.views, scene.mesh, scene.buffers  # rendered before the clock starts
    watch = StopWatch()
    start = solve_appearance(
        views,
        charted(mesh, config.texture_size),
        config.transport,
        texture_size=config.texture_size,
        light_rows=config.light_rows,
        seed=config.seed,
    )
    seconds = watch.seconds
    with watch.stands():
        first = Point(0, seconds, albedo_psnr(scene, start))
    refinement = replace(config.refine, seed=config.refine.seed + config.seed)
    return descend(OURS, scene, watch, start, refinement, settings.our_every, [first])


def run_plain(scene: MultiviewScene, settings: RaceSettings, loss: str) -> tuple[Curve, float]:
    """A plain loop's curve, and the albedo of its start in dB."""
    from unirender_reference.optimize.shape.uv import charted
    from unirender_reference.optimize.transport.solve import start_solution

    views, mesh, _ = scene.views, scene.mesh, scene.buffers
    watch = StopWatch()
    start = start_solution(views, charted(mesh, PLAIN_TEXTURE), PLAIN_TEXTURE, LIGHT_SHAPE[0])
    with watch.stands():
        grey = albedo_psnr(scene, start)
    return descend(f"plain, {loss}", scene, watch, start, plain_config(settings, loss), settings.plain_every)[0], grey


def plain_config(settings: RaceSettings, loss: str) -> RefineConfig:
    """The plain loop with a loss."""
    return replace(RefineConfig.plain(settings.iterations), loss=loss, seed=settings.ours.seed)


def race_all(study: Study, settings: RaceSettings, folder: Path, console: Console) -> list[ObjectRace]:
    """The curves of all objects, in their order; those that the folder holds already are read."""
    keys = {scene.key: study.key(scene, "race", asdict(settings)) for scene in study.scenes}
    path = folder / CURVES
    known = {race.key: race for race in read_curves(path)}
    jobs: dict[str, Callable[[], None]] = {
        scene.object: partial(_add, path, known, study, settings, scene, keys[scene.key])
        for scene in study.scenes
        if keys[scene.key] not in known
    }
    work_through(jobs, console, "race")
    return [known[key] for key in keys.values()]


def _add(
    path: Path, known: dict[str, ObjectRace], study: Study, settings: RaceSettings, scene: Scene, key: str
) -> None:
    known[key] = race = run_race(study.scene(scene), settings, key, scene.object)
    with path.open("a", encoding="utf-8") as file:
        file.write(race.to_json() + "\n")


def run_race(scene: MultiviewScene, settings: RaceSettings, key: str, name: str) -> ObjectRace:
    """Ours, then the plain loops; `name` is the object's."""
    ours, _ = run_ours(scene, settings)
    loops = [run_plain(scene, settings, loss) for loss in settings.losses]
    return ObjectRace(key, name, loops[0][1], ours, tuple(curve for curve, _ in loops))


def read_curves(path: Path) -> list[ObjectRace]:
    """What earlier runs stored; half a line at the end, left by a killed run, is cut off."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    complete = text[: text.rfind("\n") + 1]
    if complete != text:
        path.write_text(complete, encoding="utf-8")
    try:
        return [ObjectRace.from_json(line) for line in complete.splitlines()]
    except (ValueError, KeyError, TypeError) as error:
        raise UnirenderError(f"{path}: got a line that is no race ({error}); delete the file to run again") from error
