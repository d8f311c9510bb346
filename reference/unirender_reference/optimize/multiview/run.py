"""An optimisation from several views, stage by stage: [shape] -> transport [-> shape -> transport] -> refinement.

With a folder it can be killed at any time and goes on where it was (`files.state`); what it finds is the same, bit for
bit, as far as the renderer is: `docs/optimization.md` says how far.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from unirender.arguments import as_instance, as_path
from unirender.errors import UnirenderError
from unirender.system.whole_files import file_sha256
from unirender_reference.backend import renderer_threads
from unirender_reference.optimize.exposure import divided_views, exposure_of_views, lit
from unirender_reference.optimize.files.solution import read_solution_file, write_solution_file
from unirender_reference.optimize.files.state import RunFolder, fingerprint, open_run
from unirender_reference.optimize.machine import require_memory_for_pictures
from unirender_reference.optimize.multiview.config import PIXEL_BYTES, OptimizeConfig
from unirender_reference.optimize.multiview.result import write_result
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.refine.run import HeldOut, refine
from unirender_reference.optimize.refine.state import RefineState
from unirender_reference.optimize.refine.watch import FIGURE, Watch
from unirender_reference.optimize.shape.uv import charted
from unirender_reference.optimize.show.report import OnReport, Report
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Step, Views
from unirender_reference.shapes import MeshObject, Sphere
from unirender_reference.versions import versions

SHAPE, CARVE, TRANSPORT, REFINE, RESHAPE = "shape", "carve", "transport", "refine", "reshape"
COMPARED_SPP = 64  # twice, of the pictures that tell the better solution


def optimize(
    views: Views,
    obj: MeshObject | None,
    config: OptimizeConfig,
    out: str | Path | None = None,
    init: Solution | None = None,
    progress: OnReport | None = None,
    place: Sphere | None = None,
    pictures: bool = True,
    threads: int = 0,
    began: float | None = None,
) -> Solution:
    """Finds textures, light and, where it is not given, the shape of an object from pictures of it.

    Args:
        views: pictures with cameras; the object lies in the unit sphere of their world
            (`shape.placement.placed`). Linear ones may have any scale: the work is done at one exposure, and the light
            that is found has their scale.
        obj: the mesh; None: it is reconstructed from the masks. Its own textures do not count. A mesh without
            texture coordinates of its own for each point of the surface gets new ones.
        config: the stages.
        out: folder of the run, which goes on where an earlier process left it; None: nothing is written.
        init: a start instead of the transport stage (and of `obj`); its light has the scale of the pictures.
        progress: called after every step.
        place: where the object stands in its own units, for the mesh file.
        pictures: whether to render strips to look at, too.
        began: clock (`time.perf_counter`) when the work on `init` began, which counts among the seconds; None: now.
        threads: of the renderer; 0: as many as it has. With one, equal runs give equal bytes; with more, sums of
            derivatives round in another order each time.

    Raises:
        UnirenderError: the folder holds another run, all pictures are black, the masks do not bound an object that has
            no mesh, the pictures or the transport stage take more memory than the machine has, or what a stage says.
    """
    out = None if out is None else as_path(out, "out")
    as_instance(views, Views, "optimize: views")
    if obj is not None:
        as_instance(obj, MeshObject, "optimize: obj")
    as_instance(config, OptimizeConfig, "optimize: config").check()
    if init is not None and obj is not None:
        raise UnirenderError(
            "optimize: got a mesh and a start with a mesh of its own, expected one of them; leave obj or init out"
        )
    views.require_light()
    count = len(views.seen) + len(views.held_out)
    require_memory_for_pictures(count, views.height, views.width, PIXEL_BYTES)
    if init is None and config.transport.enabled:
        config.require_memory(sum(int((view.mask > 0).sum()) for view in views.seen))
    if obj is None and init is None:
        from unirender_reference.optimize.shape.bounds import check_masks

        check_masks(views, config.shape.cells)
    exposure = exposure_of_views(views)
    header = {
        "config": {name: value for name, value in dataclasses.asdict(config).items() if name != "save_seconds"},
        "inputs": fingerprint(views, obj, init) | {"place": _described(place), "exposure": exposure},
        "versions": versions(denoise=False),
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(renderer_threads(threads))
        folder = None if out is None else stack.enter_context(open_run(out, header))
        show = progress or (lambda report: None)
        run = _Run(divided_views(views, exposure), config, folder, show, _plan(obj, init, config), began)
        solution = lit(run.solution(obj, None if init is None else lit(init, 1 / exposure)), exposure)
        if folder is not None and not _written(folder, pictures):
            finished = folder.progress.seconds if folder.progress.live.get("written") else None  # files were lost since

            def seconds() -> float:
                return run.seconds if finished is None else finished

            files = write_result(solution, views, folder, header, place, pictures=pictures, clock=seconds)
            folder.save(seconds(), {"written": files, "pictures": pictures})
    return solution


def _described(place: Sphere | None) -> str:
    return "unit sphere" if place is None else f"center {place.center.tolist()} radius {float(place.radius)!r}"


def _written(folder: RunFolder, pictures: bool) -> bool:
    """Whether the result is there with all its files as they were written, and with pictures where they are wanted."""
    live = folder.progress.live
    drawn = live.get("pictures", False) or not pictures
    files = live.get("written")  # name -> hash
    return isinstance(files, dict) and drawn and all(_is(folder.out / name, hashed) for name, hashed in files.items())


def _is(path: Path, sha256: str) -> bool:
    """Whether a file is there with the content of that hash."""
    return path.is_file() and file_sha256(path) == sha256


def _plan(obj: MeshObject | None, init: Solution | None, config: OptimizeConfig) -> list[str]:
    """The names of the stages.

    On a mesh that was moved all is solved for anew: materials found on the wrong one explain its errors, and descent
    does not leave them. Without the transport stage only the refinement tells what shading a mesh should have.
    """
    if init is not None:
        return [REFINE]
    if obj is not None:
        return [TRANSPORT, REFINE]
    again = TRANSPORT if config.transport.enabled else REFINE
    rounds = [name for k in range(1, config.shape_rounds + 1) for name in (f"{RESHAPE}-{k}", f"{again}-{k}")]
    if again == REFINE:
        return [SHAPE, TRANSPORT, REFINE, *rounds]
    return [SHAPE, TRANSPORT, *([CARVE] if config.shape.carve else []), *rounds, REFINE]


class _Run:
    """The stages of one process."""

    def __init__(
        self,
        views: Views,
        config: OptimizeConfig,
        folder: RunFolder | None,
        show: OnReport,
        plan: list[str],
        began: float | None = None,
    ) -> None:
        self.views, self.config, self.folder, self.plan = views, config, folder, plan
        self._show = show
        self._began = time.perf_counter() if began is None else began
        self._before = 0.0 if folder is None else folder.progress.seconds

    @property
    def seconds(self) -> float:
        """Of all processes of the run."""
        return self._before + time.perf_counter() - self._began

    def solution(self, obj: MeshObject | None, init: Solution | None) -> Solution:
        """The result of all stages."""
        found: Solution | MeshObject | None = obj if init is None else init
        if isinstance(found, MeshObject):
            found = charted(found, self.config.texture_size)
        for name in self.plan:
            done = None if self.folder is None else self.folder.result(name)
            found = self._stage(name, found) if done is None else done
            if done is None and self.folder is not None:
                self.folder.finish(name, found, self.seconds)
        assert isinstance(found, Solution)  # every plan has a refinement
        return found

    def _stage(self, name: str, found: Solution | MeshObject | None) -> Solution | MeshObject:
        """What a stage makes of what the stages before it found."""
        kind, config = name.split("-")[0], self.config
        shape = dataclasses.replace(config.shape, seed=config.shape.seed + config.seed)
        if kind == SHAPE:
            from unirender_reference.optimize.shape.reconstruct import reconstruct

            return reconstruct(self.views, shape, self._on_step(name, shape.mask_steps))
        if kind == TRANSPORT:
            mesh = found.obj if isinstance(found, Solution) else found
            assert mesh is not None  # given, or found by the stage before
            return self._solved(name, mesh)
        assert isinstance(found, Solution)
        if kind == CARVE:
            from unirender_reference.optimize.shape.carve import carved_object

            hollow = carved_object(self.views, found.obj, shape)
            if hollow is not None:
                return self._better(found, self._solved(name, hollow))
            self._on_step(name, 1)(Step(name, 1, 0.0, {"hollows": 0.0}))
            return found
        if kind == RESHAPE:
            from unirender_reference.optimize.shape.refine_shape import refine_shape

            return refine_shape(self.views, found, shape, self._on_step(name, shape.image_steps))
        return self._refine(name, found)

    def _solved(self, name: str, mesh: MeshObject) -> Solution:
        from unirender_reference.optimize.transport.progress import solve_shares
        from unirender_reference.optimize.transport.solve import STARTS, solve_appearance

        config = self.config
        shares = solve_shares(config.transport, len(STARTS))
        on_step = self._on_step(name, len(shares), shares=shares)
        return solve_appearance(
            self.views, mesh, config.transport, on_step, config.texture_size, config.light_rows, config.seed
        )

    def _better(self, *solutions: Solution) -> Solution:
        """The one that explains the pictures best."""
        from unirender_reference.optimize.refine.losses import ImageLoss
        from unirender_reference.optimize.solution_scene import solution_images

        seen, loss = self.views.seen, ImageLoss(self.views)

        def explained(solution: Solution) -> float:
            one, other = (solution_images(solution, seen, COMPARED_SPP, seed)[..., :3] for seed in (0, 1))
            return loss.psnr(one, other)

        return max(solutions, key=explained)

    def _on_step(
        self, name: str, total: int, first: int = 0, shares: Sequence[float] | None = None
    ) -> Callable[[Step], bool]:
        """Records and shows every step of a stage, under its name and with the clock of the run.

        Args:
            name: of the stage.
            total: its steps.
            first: its steps in earlier processes.
            shares: of the stage's work that is done after each step; None: all take alike.
        """
        began = time.perf_counter()

        def on_step(step: Step) -> bool:
            step = dataclasses.replace(step, stage=name, seconds=round(self.seconds, 3))
            if self.folder is not None:
                self.folder.record(step)
            index = step.iteration - first
            done = index / max(total - first, 1) if shares is None else shares[min(index, len(shares)) - 1]
            remaining = (time.perf_counter() - began) * (1 - done) / done if done else None
            self._show(Report(step, self.plan.index(name) + 1, len(self.plan), total, remaining))
            return True

        return on_step

    def _refine(self, name: str, start: Solution) -> Solution:
        """The solution refined by descent, from the saved state where there is one."""
        config = dataclasses.replace(self.config.refine, seed=self.config.refine.seed + self.config.seed)
        if not config.enabled:
            return start
        state, watch = RefineState.begin(start, config), Watch(self.config.patience)
        if self.folder is not None and self.folder.progress.live.get("stage") == name:
            state, watch = self._restored(start, self.folder, config)
        note = self._on_step(name, config.iterations, state.iteration)
        saved = time.perf_counter()

        def on_step(step: Step) -> bool:
            nonlocal saved
            note(step)
            if FIGURE in step.values and watch.look(step.iteration, step.values[FIGURE]):
                watch.best = state.solution(start, config)
            if self.folder is not None and time.perf_counter() - saved >= self.config.save_seconds:
                self._save(name, self.folder, state, watch)
                saved = time.perf_counter()
            return not watch.enough

        if watch.best_db is None and not state.iteration and config.held_out_every and self.views.held_out:
            on_step(Step(name, 0, 0.0, {FIGURE: HeldOut(self.views, start, config).psnr(state)}))  # of the start
        if not watch.enough:
            refine(self.views, start, config, on_step, state)
        return watch.best if watch.patience and watch.best is not None else state.solution(start, config)

    def _save(self, name: str, folder: RunFolder, state: RefineState, watch: Watch) -> None:
        live: dict[str, Any] = {"stage": name, "state": f"{name}-{state.iteration}.npz", "best": None}
        state.save(folder.state / live["state"])
        if watch.best is not None:
            live["best"] = f"{name}-best-{watch.best_iteration}.npz"
            if not (folder.state / live["best"]).exists():
                write_solution_file(folder.state / live["best"], watch.best)
        live |= {"best_db": watch.best_db, "best_iteration": watch.best_iteration, "stale": watch.stale}
        folder.save(self.seconds, live)

    def _restored(self, start: Solution, folder: RunFolder, config: RefineConfig) -> tuple[RefineState, Watch]:
        live = folder.progress.live
        state = RefineState.load(folder.state / live["state"], start, config)
        watch = Watch(self.config.patience, live["best_db"], live["best_iteration"], live["stale"])
        if live["best"] is not None:
            best = read_solution_file(folder.state / live["best"])
            watch.best = best if isinstance(best, Solution) else None
        return state, watch
