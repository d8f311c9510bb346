"""What `render_sample` costs beside the `mi.render` calls that it makes.

The denominator is measured in the same run: a bare loop of the same `mi.render` calls (same loaded scene, surfaces,
light, samples and seeds, each picture read back as an array), and nothing else inside the clock. Loading the scene,
which either of the two would pay once, and compiling the kernels are timed apart.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from unirender.errors import UnirenderError, UsageError

if TYPE_CHECKING:
    from unirender_reference.render import Renderer, SceneSpec


@dataclass(frozen=True)
class Overhead:
    """Time `render_sample` against the bare sum of its `mi.render` calls; a table by resolution."""

    resolutions: tuple[int, ...] = (64, 256, 512)
    """Pixels along each side."""
    spp: int = 64
    """Samples per pixel of the image, of s and of d."""
    repeats: int = 5
    """Timed rounds, each of the bare loop and of `render_sample`; the medians count."""
    object: int = 3
    """Seed of the procedural object."""
    maps: bool = False
    """Give the object roughness, metallic and normal maps."""

    def run(self) -> int:
        """Measures and prints; returns the exit status."""
        from rich.console import Console
        from rich.table import Table

        if self.repeats < 1 or not self.resolutions or min(self.resolutions) < 1:
            raise UsageError(f"got {self.repeats} repeats at {self.resolutions} px, expected at least 1 of each")
        results = [measure_overhead(self, resolution) for resolution in self.resolutions]
        table = Table("seconds", *(f"{result.resolution} px" for result in results))
        rows = {
            "render_sample": [f"{result.total:.3f}" for result in results],
            "bare mi.render calls": [f"{result.bare:.3f}" for result in results],
            "ratio (least-most)": [
                f"{result.ratio:.3f} ({min(result.ratios):.3f}-{max(result.ratios):.3f})" for result in results
            ],
            **{name: [f"{result.parts[name]:.4f}" for result in results] for name in results[0].parts},
            "loading the scene": [f"{result.load:.3f}" for result in results],
            "first call": [f"{result.first:.3f}" for result in results],
        }
        for name, cells in rows.items():
            table.add_row(name, *cells)
        console = Console()
        console.print(table)
        console.print(
            f"{self.spp} spp, {results[0].renders} mi.render calls a sample, medians of {self.repeats} rounds. "
            "geometry to hashing are parts of the rest, timed one by one. Loading the scene and the first "
            "call, which compiles, are in neither time."
        )
        return 0


@dataclass(frozen=True)
class Result:
    """Seconds at one resolution.

    Attributes:
        resolution: pixels along each side.
        totals: of `render_sample`, one for each round.
        bares: of the bare loop, likewise.
        parts: of what else `render_sample` does, by name; medians.
        load: loading the scene.
        first: the first `render_sample`, kernels compiled or read from Dr.Jit's cache.
        renders: `mi.render` calls in a sample.
    """

    resolution: int
    totals: list[float]
    bares: list[float]
    parts: dict[str, float]
    load: float
    first: float
    renders: int

    @property
    def total(self) -> float:
        """Median of `render_sample`."""
        return statistics.median(self.totals)

    @property
    def bare(self) -> float:
        """Median of the bare loop."""
        return statistics.median(self.bares)

    @property
    def ratios(self) -> list[float]:
        """`render_sample` over the bare loop of the same round."""
        return [total / bare for total, bare in zip(self.totals, self.bares, strict=True)]

    @property
    def ratio(self) -> float:
        """Median over the rounds."""
        return statistics.median(self.ratios)


def measure_overhead(config: Overhead, resolution: int) -> Result:
    """Times one resolution; the two are run in turns, so that a busy machine slows both.

    Raises:
        UnirenderError: the bare loop does not make the calls that `render_sample` makes.
    """
    from unirender_reference.lights import make_light
    from unirender_reference.render import Renderer, SceneSpec, render_sample
    from unirender_reference.shapes import make_object

    obj = make_object(config.object, "train", maps=config.maps)
    light = make_light(0, "train")
    value = None if config.maps else 0.4
    spec = SceneSpec(obj, light, value, value, resolution=resolution)
    load, renderer = timed(lambda: Renderer(obj, resolution=resolution))
    first, sample = timed(lambda: render_sample(spec, config.spp, 0, renderer))
    environment = sample.intrinsics.require("environment")["environment"]
    totals, bares, parts, renders = [], [], {}, 0
    for seed in range(1, config.repeats + 1):
        before = renderer.counters.renders
        totals.append(timed(lambda seed=seed: render_sample(spec, config.spp, seed, renderer))[0])
        renders = renderer.counters.renders - before
        seconds = list(bare_renders(renderer, spec, environment, config.spp, seed))
        if len(seconds) != renders:
            raise UnirenderError(f"bare loop: {len(seconds)} mi.render calls, expected render_sample's {renders}")
        bares.append(sum(seconds))
        for name, part in part_times(renderer, spec, config.spp, seed).items():
            parts.setdefault(name, []).append(part)
    medians = {name: statistics.median(times) for name, times in parts.items()}
    return Result(resolution, totals, bares, medians, load, first, renders)


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that a call takes, and what it returns."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def bare_renders(renderer: "Renderer", spec: "SceneSpec", environment: Any, spp: int, seed: int) -> Iterator[float]:
    """Seconds of each `mi.render` of a sample, in order: the exposure's d, the image, d and s."""
    import numpy as np

    from unirender_reference import exposure
    from unirender_reference.backend import mitsuba
    from unirender_reference.materials import Surface
    from unirender_reference.passes import SAMPLES_PER_PASS, TRUTH_BATCHES, derive_seed, pass_count
    from unirender_reference.render import DIRECT_DEPTH, IMAGE_DEPTH

    mi = mitsuba()
    material = {"roughness": spec.roughness, "metallic": spec.metallic}
    unexposed = spec.light.environment
    plan: tuple[tuple[str, Surface, dict[str, float | None], int, Any, int, int, int], ...] = (
        ("diffuse", "white", {}, DIRECT_DEPTH, unexposed, exposure.PASS_SPP, 1, exposure.PASS_SEED),
        ("image", "principled", material, IMAGE_DEPTH, environment, spp, TRUTH_BATCHES, seed),
        ("diffuse", "white", {}, DIRECT_DEPTH, environment, spp, TRUTH_BATCHES, seed),
        ("specular", "mirror", {"roughness": spec.roughness}, DIRECT_DEPTH, environment, spp, TRUTH_BATCHES, seed),
    )
    for name, surface, values, depth, light, samples, batches, base in plan:
        scene = renderer.scene.show(surface, values, light)
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
        count = pass_count(samples, batches, SAMPLES_PER_PASS // renderer.resolution**2)
        for index in range(count):
            own = derive_seed(derive_seed(base, name), "pass", index, 0)
            options = {"integrator": integrator, "spp": samples // count, "seed": own}
            yield timed(lambda scene=scene, options=options: np.array(mi.render(scene, **options)))[0]


def part_times(renderer: "Renderer", spec: "SceneSpec", spp: int, seed: int) -> dict[str, float]:
    """Seconds of what `render_sample` does besides rendering, each done once more by itself."""
    import numpy as np

    from unirender_reference import exposure
    from unirender_reference.passes import TRUTH_BATCHES, mean_estimate, ratio_estimate
    from unirender_reference.render import geometry_spp, scene_hash

    size, light = renderer.resolution, spec.light.environment
    passes = list(np.random.default_rng(seed).random((TRUTH_BATCHES, size, size, 4), dtype=np.float32))

    def average() -> None:
        mean_estimate(passes, 0, TRUTH_BATCHES)
        ratio_estimate(passes, 0, TRUTH_BATCHES)
        ratio_estimate(passes, 0, TRUTH_BATCHES)

    renderer.scene.show("white", {}, light)
    before = renderer.counters.render_seconds
    exposed = timed(lambda: exposure.scene_exposure(renderer, light, spec.exposure_seed))[0]
    return {
        "geometry": timed(lambda: renderer.geometry(geometry_spp(size, spp), seed, (spec.roughness, spec.metallic)))[0],
        "averaging": timed(average)[0],
        "exposure": exposed - (renderer.counters.render_seconds - before),
        "light": sum(timed(lambda scale=scale: renderer.scene.show("white", {}, light * scale))[0] for scale in (2, 1)),
        "hashing": timed(lambda: scene_hash(spec))[0],
    }
