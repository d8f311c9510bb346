"""What a data set costs: seconds of one core and bytes for each picture, and what that makes for a whole set.

Every resolution is measured in a process of its own with one Dr.Jit thread, as the workers of a data set run. Seconds
are CPU seconds of that process (a busy machine does not add to them), compilation left out.

    brute force, a light each     pairs x (image, s, d), groups of 8 lights: `--vary paper`
    brute force, one light        pairs images, 11 s, one d
    sweep, one light              33 whole images stand for the 121: `--vary sweep`, which needs the samples of 25.5
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from unirender.errors import UsageError
from unirender.system.wording import counted
from unirender_reference.option_checks import require_least

if TYPE_CHECKING:
    from unirender_reference.render import Renderer

GRID_LEVELS, SWEEP_RENDERS = 11, 33
PAIRS = GRID_LEVELS**2
PARTS = ("image", "s", "d", "geometry", "exposure", "load", "encode")
FILES = ("image", "s", "d", "shared", "light")


@dataclass(frozen=True)
class Cost:
    """CPU seconds and bytes per picture by resolution, and the core-hours and bytes of a whole data set."""

    resolutions: tuple[int, ...] = (64, 128, 256, 512, 1024)
    """Pixels along each side."""
    spp: int = 64
    """Samples per pixel of an image, of s and of d."""
    scenes: int = 2
    """Procedural objects, each under a light of its own; figures are means over them."""
    objects: int = 200_000
    """Objects of the data set on paper, 121 pairs each."""

    def run(self) -> int:
        """Measures and prints; returns the exit status."""
        from rich.console import Console
        from rich.table import Table

        from unirender.system.worker_pool import WorkerPool
        from unirender_reference.plan import SHARD_GROUPS

        require_least(self, "", {"spp": 1, "scenes": 1, "objects": 1})
        if min(self.resolutions, default=0) < 1:
            shown = " ".join(map(str, self.resolutions))
            raise UsageError(f"--resolutions {shown}: expected one or more, each of 1 pixel or more")
        console = Console(width=160)
        names = {"s": "specular", "d": "diffuse"}  # beside seconds
        columns = [f"{names.get(name, name)} ({unit})" for unit, of in (("s", PARTS), ("kB", FILES)) for name in of]
        parts = Table("px", *columns, "peak (MB)")
        whole = Table("px", "data set", "core-hours", "TB", "groups", "shards", "GB a shard")
        for resolution in self.resolutions:
            with WorkerPool(1) as pool:
                found = pool.submit(measure, resolution, self.spp, self.scenes).result()
            parts.add_row(
                str(resolution),
                *(f"{found.seconds[part]:.3f}" for part in PARTS),
                *(f"{found.bytes[file] / 1e3:.1f}" for file in FILES),
                f"{found.peak_bytes / 1e6:.0f}",
            )
            for name, plan in plans().items():
                size, groups = plan.bytes(found), plan.groups * self.objects
                shard_groups = min(SHARD_GROUPS, groups)
                whole.add_row(
                    str(resolution),
                    name,
                    f"{plan.seconds(found) * self.objects / 3600:,.0f}",
                    f"{size * self.objects / 1e12:,.2f}",
                    f"{groups:,}",
                    f"{math.ceil(groups / SHARD_GROUPS):,}",
                    f"{size / plan.groups * shard_groups / 1e9:.2f}",
                )
            whole.add_section()
        console.print(parts)
        console.print(
            f"CPU seconds of one core at {self.spp} spp, kilobytes of an EXR file; "
            f"means over {self.scenes} scene{'s' * (self.scenes != 1)}."
        )
        console.print(whole)
        console.print(f"{counted(self.objects, 'object')} x {PAIRS} pairs, {SHARD_GROUPS} groups a shard.")
        return 0


@dataclass(frozen=True)
class Figures:
    """Of one resolution: CPU seconds by `PARTS` (encode: one file), bytes by `FILES`, peak memory of the process."""

    seconds: Mapping[str, float]
    bytes: Mapping[str, float]
    peak_bytes: float


@dataclass(frozen=True)
class Plan:
    """How often one object needs each part, and how many files of each kind it stores."""

    groups: int
    renders: Mapping[str, int]
    files: Mapping[str, int]

    def seconds(self, figures: Figures) -> float:
        return (
            sum(count * figures.seconds[part] for part, count in self.renders.items())
            + sum(self.files.values()) * figures.seconds["encode"]
        )

    def bytes(self, figures: Figures) -> float:
        return sum(count * figures.bytes[file] for file, count in self.files.items())


def plans() -> dict[str, Plan]:
    """The three ways to make the 121 pairs of an object."""
    groups = math.ceil(PAIRS / 8)
    each = {"image": PAIRS, "s": PAIRS, "d": PAIRS}
    one = {"s": GRID_LEVELS, "d": 1}
    once = {"geometry": 1, "exposure": 1, "load": 1}
    stored = {"image": PAIRS, **one, "shared": 1, "light": 1}
    return {
        "brute force, a light each": Plan(
            groups,
            {**each, "geometry": groups, "exposure": PAIRS, "load": groups},
            {**each, "shared": groups, "light": PAIRS},
        ),
        "brute force, one light": Plan(1, {"image": PAIRS, **one, **once}, stored),
        "sweep, one light": Plan(1, {"image": SWEEP_RENDERS, **one, **once}, stored),
    }


def measure(resolution: int, spp: int, scenes: int) -> Figures:
    """Figures of a resolution, in this process with one thread."""
    import statistics

    from unirender.system.machine import peak_bytes
    from unirender_reference import backend
    from unirender_reference.lights import make_light
    from unirender_reference.render import Renderer
    from unirender_reference.shapes import make_object

    backend.set_threads(1)
    measured = []
    for seed in range(scenes):
        load, renderer = cpu_seconds(lambda seed=seed: Renderer(make_object(seed, "train"), resolution=resolution))
        light = make_light(seed, "train").environment
        first, _ = one_scene(renderer, light, spp, seed)  # compiles some kernels
        seconds, sizes = one_scene(renderer, light, spp, seed + 1)
        measured.append(({part: min(spent, first[part]) for part, spent in seconds.items()} | {"load": load}, sizes))
    return Figures(
        {part: statistics.fmean(seconds[part] for seconds, _ in measured) for part in PARTS},
        {file: statistics.fmean(sizes[file] for _, sizes in measured) for file in FILES},
        peak_bytes(),
    )


def one_scene(renderer: "Renderer", light: Any, spp: int, seed: int) -> tuple[dict[str, float], dict[str, int]]:
    """CPU seconds of every part and bytes of every file of one object under one light."""
    import numpy as np

    from unirender.exr import exr_bytes, image_channels, intrinsics_channels
    from unirender_reference import exposure
    from unirender_reference.members import GEOMETRY_SPP

    seconds: dict[str, float] = {}

    def timed(part: str, work: Callable[[], Any]) -> Any:
        seconds[part], result = cpu_seconds(work)
        return result

    factor = timed("exposure", lambda: exposure.scene_exposure(renderer, light, seed))
    lit = (light * np.float32(factor)).astype(np.float32)
    maps = timed("geometry", lambda: renderer.geometry(GEOMETRY_SPP, seed))
    files = {
        "image": image_channels(timed("image", lambda: renderer.image(lit, 0.4, 0.5, spp, seed, batches=1)).mean),
        "s": image_channels(timed("s", lambda: renderer.specular(lit, 0.4, spp, seed, batches=1)).mean),
        "d": image_channels(timed("d", lambda: renderer.diffuse(lit, spp, seed, batches=1)).mean),
        "shared": intrinsics_channels(maps),
        "light": image_channels(lit),
    }
    sizes = {}
    for file, channels in files.items():
        data = timed("encode", lambda channels=channels, file=file: exr_bytes(channels, half=file != "light"))
        sizes[file] = len(data)
        seconds["encodes"] = seconds.get("encodes", 0) + seconds["encode"] / len(files)
    return {**seconds, "encode": seconds["encodes"]}, sizes


def cpu_seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds that a call takes, and what it returns."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result
