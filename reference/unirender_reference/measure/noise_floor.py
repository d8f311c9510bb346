"""`unirender reference noise-floor`: is the noise floor that was asked for there, measured by far longer renders?

Every image is rendered to the floor (`noise.render_to_floor`), and once more with `factor` times its samples and a seed
of its own. The masked sRGB error between the two, less what noise the long render has left by its own batches, is what
a noise-free prediction would score.
"""

import itertools
import math
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from unirender.errors import UsageError
from unirender_reference.measure.size import check_size
from unirender_reference.option_checks import require_least
from unirender_reference.processes import start_worker

if TYPE_CHECKING:
    from rich.table import Table

SHORTFALL_DB = 1.0  # below the floor asked for, in one image, that fails
BIAS_DB = 0.3  # of the estimate over all images, that fails
MOST_SKIPPED = 5  # candidates for every image
MASK_SPP = 1024  # of the coverage, which weights the pixels


@dataclass(frozen=True)
class FloorJob:
    """One image to measure; drawn from `number`: object, light, roughness and metallic uniform in [0, 1]."""

    number: int
    floor_db: float
    factor: int
    resolution: int
    limit: int


@dataclass(frozen=True)
class FloorRow:
    """What one image showed; `measured_db` is None where it takes more samples than the limit."""

    number: int
    roughness: float
    metallic: float
    spp: int
    floor_db: float
    sure_db: float
    measured_db: float | None
    seconds: float
    check_seconds: float


def measure_floor(job: FloorJob) -> FloorRow:
    """Renders and measures one image; what a worker process does."""
    import time

    import numpy as np

    from unirender_reference import exposure
    from unirender_reference.lights import make_light
    from unirender_reference.noise import FLOOR_BATCHES, full_spp, measured_floor_db, render_to_floor
    from unirender_reference.passes import Estimate, derive_seed
    from unirender_reference.render import Renderer
    from unirender_reference.shapes import make_object

    seed = derive_seed("noise-floor", job.number)
    rng = np.random.default_rng(seed)
    light = make_light(int(rng.integers(1 << 31)), "train")
    roughness, metallic = (float(value) for value in rng.random(2))
    renderer = Renderer(make_object(job.number, "train"), resolution=job.resolution)
    factor = exposure.scene_exposure(renderer, light.environment, seed)
    environment = (light.environment * factor).astype(np.float32)
    mask = renderer.geometry(MASK_SPP, seed).require("mask")["mask"]

    def image(spp: int, own: int) -> Estimate:
        return renderer.image(environment, roughness, metallic, spp, own, batches=FLOOR_BATCHES)

    start = time.perf_counter()
    found = render_to_floor(image, mask, job.floor_db, premultiplied=True, max_spp=job.limit, seed=seed)
    seconds, measured, start = time.perf_counter() - start, None, time.perf_counter()
    if found.reached:
        long = image(full_spp(job.factor * found.spp, FLOOR_BATCHES, mask.size), derive_seed(seed, "check"))
        measured = measured_floor_db(found.estimate, long, mask, premultiplied=True)
    return FloorRow(
        job.number,
        roughness,
        metallic,
        found.spp,
        found.floor_db,
        found.sure_db,
        measured,
        seconds,
        time.perf_counter() - start,
    )


@dataclass(frozen=True)
class NoiseFloor:
    """Render images to a noise floor and measure it with many times the samples.

    Objects, lights and materials are drawn by seed, one after the other. An image that does not reach the floor
    within about `--limit` samples per pixel is left out, and listed: the measurement takes `--factor` times as many.
    """

    images: int = 20
    """Images to measure."""
    floor: float = 45.0
    """Masked sRGB PSNR (dB) that a noise-free prediction is to score."""
    factor: int = 64
    """Samples of the measurement, times those of the image."""
    resolution: int = 64
    """Pixels along each side."""
    limit: int = 1024
    """About where sampling an image ends; those that have not reached the floor by then are left out."""
    seed: int = 0
    """Number of the first image drawn."""
    workers: int = 0
    """Processes; 0: one for each core."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
            UnirenderError: the machine has not the memory for the resolution.
        """
        counts = dict.fromkeys(("images", "factor", "resolution", "limit"), 1)
        require_least(self, "", counts | {"workers": 0, "seed": 0})
        if not 0 < self.floor < 100:
            raise UsageError(f"--floor {self.floor:g}: expected decibels above 0 and below 100")
        check_size(self.resolution)

    def run(self) -> int:
        """Returns the exit status: 1 where a floor was missed or the estimates are biased."""
        self.check()
        from rich.console import Console

        from unirender.system.run_progress import progress_bar

        rows: list[FloorRow] = []
        with progress_bar(Console(stderr=True)) as bar:
            task = bar.add_task("images", total=self.images)
            for row in self._rows():
                rows.append(row)
                bar.update(task, advance=row.measured_db is not None)
        console = Console()
        console.print(self._table(rows))
        measured = [row for row in rows if row.measured_db is not None]
        if not measured:
            console.print(
                f"no image reaches {self.floor:g} dB within about {self.limit} samples; give a higher --limit"
            )
            return 1
        lines, status = summary(measured, self.floor)
        skipped = len(rows) - len(measured)
        missed = f"do not reach {self.floor:g} dB within about {self.limit} samples"
        console.print(f"{skipped} of {len(rows)} images {missed}: not measured (-)")
        for line in lines:
            console.print(line)
        return status

    def _rows(self) -> Iterator[FloorRow]:
        """Rows in the order of their numbers, until enough are measured or all candidates have been tried."""
        from concurrent.futures import Future

        from unirender.system.worker_pool import WorkerPool

        workers = min(self.workers or os.cpu_count() or 1, self.images)
        jobs = (
            FloorJob(self.seed + i, self.floor, self.factor, self.resolution, self.limit)
            for i in range(MOST_SKIPPED * self.images)
        )
        with WorkerPool(workers, start_worker) as pool:
            under_way: deque[Future[FloorRow]] = deque()
            measured = 0
            while measured < self.images:
                free = min(workers, self.images - measured) - len(under_way)
                under_way.extend(pool.submit(measure_floor, job) for job in itertools.islice(jobs, max(free, 0)))
                if not under_way:
                    break  # no candidate is left
                row = under_way.popleft().result()
                measured += row.measured_db is not None
                yield row
            for future in under_way:
                future.cancel()

    def _table(self, rows: list[FloorRow]) -> "Table":
        from rich.table import Table

        table = Table(
            title=f"Noise floor, masked sRGB, dB; {self.resolution} px; measured with {self.factor} times the samples"
        )
        for name in ("image", "rough", "metal", "asked", "reached", "sure", "measured", "spp", "s", "check s"):
            table.add_column(name, justify="right")
        for row in rows:
            table.add_row(
                str(row.number),
                f"{row.roughness:.2f}",
                f"{row.metallic:.2f}",
                f"{self.floor:g}",
                f"{row.floor_db:.2f}",
                f"{row.sure_db:.2f}",
                "-" if row.measured_db is None else f"{row.measured_db:.2f}",
                str(row.spp),
                f"{row.seconds:.1f}",
                f"{row.check_seconds:.1f}",
            )
        return table


def summary(measured: list[FloorRow], floor_db: float) -> tuple[list[str], int]:
    """Lines about all measured images, and the exit status."""
    values = [row.measured_db for row in measured if row.measured_db is not None]
    differences = [value - row.floor_db for value, row in zip(values, measured, strict=True)]
    mean, n = sum(differences) / len(differences), len(values)
    spread = math.sqrt(sum((d - mean) ** 2 for d in differences) / max(n - 1, 1))
    lines = [
        f"measured: mean {sum(values) / n:.2f} dB, min {min(values):.2f} dB; "
        f"{sum(v >= floor_db for v in values)} of {n} at or above {floor_db:g} dB",
        f"measured less reached: mean {mean:+.2f} dB, standard deviation {spread:.2f} dB, "
        f"min {min(differences):+.2f} dB",
    ]
    short, biased = min(values) < floor_db - SHORTFALL_DB, abs(mean) > BIAS_DB + spread / math.sqrt(n)
    lines.append(
        f"floor {'MISSED' if short else 'reached'} (no image may lie more than {SHORTFALL_DB:g} dB below); estimate "
        f"{'BIASED' if biased else 'unbiased'} (mean difference within {BIAS_DB:g} dB and its standard error)"
    )
    return lines, int(short or biased)
