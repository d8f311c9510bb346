"""The global start: light, base colour, roughness and metallic from pictures of a known mesh, in a few dozen steps.

    1. transport matrices of the pixels that the views show, large ones reduced            (`matrices`)
    2. from several materials, on a coarse light: light and one material                   (`light_solve`)
    3. the best of them on the full light, and, where lobes are narrower than its cells, on a finer one; then, if asked
       for, materials of every patch                                                       (`material_search`)
    4. the base-colour texture, by sparse least squares                                    (`surface.textures`)
    5. a path-traced image of the estimate: what it has and the matrices lack (interreflection, fine light) is taken
       from the pictures, and light, materials and texture are solved for again

Descent by gradients (`refine.run`) goes on from there, and stalls where it starts from grey (docs/optimization.md).
"""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from unirender_reference.optimize.numerics.robust import cauchy
from unirender_reference.optimize.reduction import reduced
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.solution_scene import solution_images
from unirender_reference.optimize.surface.points import SurfacePoints, blocker, trace_points
from unirender_reference.optimize.surface.textures import best_smoothness, fit_texels, footprint, spread
from unirender_reference.optimize.transport.config import TransportConfig
from unirender_reference.optimize.transport.light_grid import LightGrid, interpolated_light
from unirender_reference.optimize.transport.light_solve import LightPrior, Solved, solve_light
from unirender_reference.optimize.transport.material_search import search_materials
from unirender_reference.optimize.transport.matrices import light_transport, refined
from unirender_reference.optimize.transport.pixel_fit import Appearance, PixelFit, observe, patches
from unirender_reference.optimize.views import Step, Views
from unirender_reference.passes import derive_seed
from unirender_reference.shapes import MeshObject

GREY = 0.4
STARTS = tuple(itertools.product((0.25, 0.7), (0.15, 0.85)))  # (roughness, metallic)
POINTS = 16  # in a pixel
LATER_ITERATIONS = 3  # after a correction
FINE = LightGrid(24, 48)  # what mirrors need
LEAST_SCALE = 0.2  # of the residuals under Cauchy's loss, in units of SIGMA
LEAST_SHARE = 1.5  # pixels for each of its texels
LEAST_SIDE = 64  # pixels of a reduced picture: fewer do not tell metallic

OnStep = Callable[[Step], bool]  # whether to go on


def start_solution(views: Views, obj: MeshObject, texture_size: int, light_rows: int) -> Solution:
    """Grey, roughness and metallic 0.5, and a constant light, about as bright as the pictures."""
    light = np.full((light_rows, 2 * light_rows, 3), _brightness(views) / GREY, np.float32)
    size = (texture_size, texture_size)
    half = np.full(size, 0.5, np.float32)
    return Solution(
        replace(obj, albedo=np.full((*size, 3), GREY, np.float32), roughness=half, metallic=half, normal_map=None),
        light,
    )


def solve_appearance(
    views: Views,
    obj: MeshObject,
    config: TransportConfig,
    on_step: OnStep | None = None,
    texture_size: int = 128,
    light_rows: int = 16,
    seed: int = 0,
) -> Solution:
    """Textures and light of a mesh from pictures of it.

    Args:
        views: the pictures; the object lies in the unit sphere of their world.
        obj: the mesh, with texture coordinates of its own for each point of the surface; its textures do not count.
        config: see there; not `enabled`: `start_solution`.
        on_step: called with stage "transport" after every solve; once there is a solution on the full light,
            False ends it with what there is.
        texture_size: texels along each side.
        light_rows: even; the light has twice as many columns.
        seed: equal seeds draw equal samples.

    Raises:
        UsageError: the configuration has a value outside its range.
    """
    config.check()
    if not config.enabled:
        return start_solution(views, obj, texture_size, light_rows)
    work = _Work(views, obj, config, on_step or (lambda step: True), texture_size, light_rows, seed)
    return work.run()


class _Work:
    """The steps of one solve."""

    def __init__(
        self,
        views: Views,
        obj: MeshObject,
        config: TransportConfig,
        on_step: OnStep,
        texture_size: int,
        light_rows: int,
        seed: int,
    ) -> None:
        self.views = shrunk(views, config.pixels)
        self.obj, self.config, self.size, self.seed = obj, config, texture_size, seed
        self._on_step, self._began, self._steps = on_step, time.perf_counter(), 0
        self.prior = LightPrior(config.smooth_light, config.neutral_light)
        self.scene = blocker(obj)
        self.grid = LightGrid(light_rows, 2 * light_rows)
        self._look(trace_points(self.scene, self.views.seen, POINTS, seed, config.pixels))

    def _look(self, points: SurfacePoints, fine: bool = False) -> None:
        """What is known of some pixels: matrices and what they show."""
        views = self.views
        self.points, self.texels = points, footprint(points, self.size)
        self.shown = points.of([views.linear(view) for view in views.seen])
        coverage = points.of([view.mask for view in views.seen])[:, 0]
        clipped = points.of([views.saturated(view) for view in views.seen])
        seen = observe(self.shown, coverage, patches(points.mean_position(), _footprint_edge(views)), clipped)
        samples = {"bilinear": True, "cell_samples": 1} if fine else {}
        transport = light_transport(self.scene, points, self.grid, self.seed, coverage, **samples)
        self.fit = PixelFit(transport, seen, np.ones_like(self.shown), GREY)

    def run(self) -> Solution:
        """The solution of all steps."""
        solved = self._first()
        wanted = self._note(solved)
        if wanted and self.config.materials == "maps":
            moved = search_materials(self.fit, solved.appearance, self.points.mean_position())
            solved = solve_light(self.fit, moved, self.prior, LATER_ITERATIONS)
            wanted = self._note(solved)
        solution = self._solution(solved)
        for index in range(self.config.rounds if wanted else 0):
            rendered = self._rendered(solution, index)
            base = self.texels @ solution.obj.albedo.reshape(-1, 3)
            explained = base * (solved.prediction.gain / self.fit.pattern) + solved.mixed.v @ solved.appearance.radiance
            target = (self.shown - (rendered - explained)).astype(np.float32)
            pattern = np.clip(base, 0.01, 1).astype(np.float32)
            self.fit = replace(self.fit, seen=replace(self.fit.seen, radiance=target), pattern=pattern, scale_prior=1.0)
            solved = solve_light(self.fit, solved.appearance, self.prior, LATER_ITERATIONS)
            solution = self._solution(solved)
            if not self._note(solved):
                break
        return solution

    def _first(self) -> Solved:
        """The best of `STARTS` on a coarse light, on the full light."""
        coarse, count = self.fit.coarse(), len(self.points)
        level = np.full((coarse.transport.grid.count, 3), np.log(_brightness(self.views) / GREY))
        found = []
        for roughness, metallic in STARTS:
            start = Appearance(level, np.full(count, roughness), np.full(count, metallic))
            found.append(solve_light(coarse, start, self.prior, self.config.iterations))
            self._note(found[-1])
        best = min(found, key=lambda solved: solved.cost).appearance
        full = replace(best, light=refined(best.light, coarse.transport.grid))
        solved = solve_light(self.fit, full, self.prior, self.config.iterations)
        narrow = solved.appearance.roughness[0] < self.config.fine_below and self.grid.rows < FINE.rows
        enough = min(len(self.points), self.config.fine_pixels) >= LEAST_SHARE * FINE.count
        if narrow and enough:
            solved = self._finer(solved.appearance)
        return self._sharp(solved) if self.config.sharpen else solved

    def _sharp(self, solved: Solved) -> Solved:
        """Solved again under a loss at the residuals' own scale."""
        size = np.abs(solved.prediction.residual)[~self.fit.seen.clipped]
        self.fit = replace(self.fit, loss=cauchy(size, LEAST_SCALE))
        return solve_light(self.fit, solved.appearance, self.prior, self.config.iterations)

    def _finer(self, found: Appearance) -> Solved:
        """A solution of one material, solved on for a finer light."""
        light = interpolated_light(self.grid.environment(found.radiance), FINE.rows)
        self.grid = FINE
        self._look(self.points.some(self.config.fine_pixels, self.seed), fine=True)
        start = Appearance(
            np.log(light.reshape(-1, 3)),
            *(np.full(len(self.points), values[0]) for values in (found.roughness, found.metallic)),
        )
        return solve_light(self.fit, start, self.prior, self.config.iterations)

    def _solution(self, solved: Solved) -> Solution:
        """Textures and light of an estimate."""
        seen, prediction, appearance = self.fit.seen, solved.prediction, solved.appearance
        weight = seen.weight * np.sqrt(prediction.robust)
        start = spread(prediction.base, seen.coverage, self.texels)
        gain = prediction.gain / self.fit.pattern
        rest = prediction.radiance - prediction.base * gain
        known = self.texels, gain, seen.radiance - rest, weight, start
        smooth = self.config.smooth_albedo
        albedo = fit_texels(*known, best_smoothness(*known, self.seed) if smooth is None else smooth)
        ones = np.ones((len(seen.patch), 1), np.float32)
        scalars = {}
        for name in ("roughness", "metallic"):
            values = getattr(appearance, name)[:, None]
            texels = spread(values, seen.coverage, self.texels)
            scalars[name] = fit_texels(self.texels, ones, values, ones * seen.coverage[:, None], texels, 0.3)
        shape = (self.size, self.size)
        obj = replace(
            self.obj,
            albedo=albedo.reshape(*shape, 3),
            normal_map=None,
            **{name: texture.reshape(shape) for name, texture in scalars.items()},
        )
        return Solution(obj, self.fit.transport.grid.environment(appearance.radiance))

    def _rendered(self, solution: Solution, index: int) -> Float[np.ndarray, "n 3"]:
        """The pixels of a path-traced image of a solution."""
        spp, seed = self.config.correction_spp, derive_seed(self.seed, "correction", index)
        return self.points.of(solution_images(solution, self.views.seen, spp, seed)[..., :3])

    def _note(self, solved: Solved) -> bool:
        self._steps += 1
        appearance = solved.appearance
        values = {
            "cost": solved.cost,
            "roughness": float(appearance.roughness.mean()),
            "metallic": float(appearance.metallic.mean()),
        }
        return self._on_step(Step("transport", self._steps, time.perf_counter() - self._began, values))


def shrunk(views: Views, pixels: int) -> Views:
    """Views reduced by a whole factor, so that about `pixels` of theirs show the object; others as they are.

    Of pixels drawn at random from large pictures hardly two show the same place of the surface. Each would have a base
    colour of its own, and nothing but the light's smoothness would tell that from the light.

    Args:
        views: the pictures.
        pixels: that are wanted of all seen views together; more are left where the shorter side would have less than
            `LEAST_SIDE`.
    """
    covered = sum(int((view.mask > 0).sum()) for view in views.seen)
    shorter, longer = sorted((views.height, views.width))
    factor = min(math.isqrt(covered // pixels), shorter // LEAST_SIDE)
    if factor < 2:
        return views
    side = max(longer // factor, -(-LEAST_SIDE * longer // shorter))  # rounded down it may leave one pixel too few
    return replace(views, seen=tuple(reduced(view, side, views.hdr) for view in views.seen), held_out=())


def _brightness(views: Views) -> float:
    """Mean radiance of the object in the pictures."""
    total = sum(float(views.linear(view).sum()) for view in views.seen)
    return max(total / (3 * sum(float(view.mask.sum()) for view in views.seen)), 1e-3)


def _footprint_edge(views: Views) -> float:
    """About the edge of a pixel on the surface: of the view whose pixels are largest."""
    edges = []
    for view in views.seen:
        distance = float(np.linalg.norm(view.pose[:3, 3]))
        edges.append(2 * distance * np.tan(np.radians(view.camera.fov_deg) / 2) / views.height)
    return 1.1 * max(edges)
