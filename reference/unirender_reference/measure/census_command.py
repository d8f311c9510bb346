"""`unirender reference census`: NaN, infinite and negative pixels over random scenes, as tables."""

import json
import math
import os
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from unirender_reference.option_checks import require_least
from unirender_reference.output_files import check_file, write_file

if TYPE_CHECKING:
    from unirender_reference.measure.census import BadPixel, ObjectCensus


@dataclass(frozen=True)
class Census:
    """Count the NaN, infinite and negative pixels of Mitsuba's renders; exit status 1 if one gets through."""

    renders: int = 2000
    """Images to render: eight an object, each with a light and a material of its own."""
    resolution: int = 64
    """Pixels along each side."""
    spp: int = 64
    """Samples per pixel."""
    seed: int = 0
    """Another seed draws other objects, lights and materials."""
    workers: int = 0
    """Processes; 0: one for each core."""
    json: Path | None = None
    """Also write every bad pixel to this file, with what it takes to render it again."""

    def run(self) -> int:
        """Returns the exit status: 1 where a bad value is in what the renderer hands out."""
        from rich.console import Console
        from rich.table import Table

        require_least(self, "", {"renders": 1, "resolution": 1, "spp": 1, "seed": 0, "workers": 0})
        check_file("--json", self.json)
        from unirender_reference.measure.census import KINDS, RENDERS_PER_OBJECT, run_census, timed

        workers = min(self.workers or os.cpu_count() or 1, math.ceil(self.renders / RENDERS_PER_OBJECT))
        censuses, seconds = timed(run_census(self.renders, self.resolution, self.spp, self.seed, workers))
        bad = [pixel for census in censuses for pixel in census.bad]
        written = sum(census.written for census in censuses)
        table = Table("", "pixels", "renders", title=f"before the repair, {self.resolution} px, {self.spp} spp")
        for kind in KINDS:
            found = [pixel for pixel in bad if pixel.kind == kind]
            table.add_row(kind, str(len(found)), str(len({(p.object_seed, p.material) for p in found})))
        console = Console()
        console.print(table)
        if bad:
            console.print(self._breakdown(bad))
        console.print(self._summary(censuses, written, seconds, workers), highlight=False)
        if self.json is not None:
            write_file("--json", self.json, json.dumps([asdict(pixel) for pixel in bad], indent=2) + "\n")
        return 1 if written else 0

    def _breakdown(self, bad: list["BadPixel"]) -> object:
        """A table of the bad pixels by each property of the render that they are in."""
        from rich.table import Table

        table = Table("where", "bad pixels", title="where they come from")
        properties = {
            "kind": lambda p: p.kind,
            "place": lambda p: p.place,
            "depth": lambda p: str(p.material.depth),
            "roughness": lambda p: band(p.material.roughness),
            "metallic": lambda p: band(p.material.metallic),
            "light": lambda p: p.light,
            "family": lambda p: p.family,
            "object": lambda p: str(p.object_seed),
        }
        for name, value in properties.items():
            for label, count in Counter(value(pixel) for pixel in bad).most_common(6):
                table.add_row(f"{name} {label}", str(count))
        return table

    def _summary(self, censuses: list["ObjectCensus"], written: int, seconds: float, workers: int) -> str:
        renders, calls = sum(c.renders for c in censuses), sum(c.calls for c in censuses)
        samples = renders * self.resolution**2 * self.spp
        return (
            f"{renders} renders of {len(censuses)} objects ({calls} calls of mi.render, {samples:.3g} camera paths) in "
            f"{seconds:.0f} s on {workers} worker{'s' * (workers != 1)}; "
            f"{sum(c.repaired for c in censuses)} pixels rendered again; {written} bad values in what was handed out"
        )


def band(value: float | None) -> str:
    """A roughness or metallic as a label: its own map, exactly 0 or 1, or a quarter of the range."""
    if value is None:
        return "map"
    if value in (0.0, 1.0):
        return f"= {value:g}"
    low = int(value * 4) / 4
    return f"{low:g} to {low + 0.25:g}"
