"""`unirender bench derived-light`. Light to import."""

from dataclasses import dataclass
from pathlib import Path

from unirender.command_line.option_checks import at_least
from unirender.errors import UsageError

LEAST_SIZE = 8


@dataclass(frozen=True)
class BenchDerivedLight:
    """Score s and d derived from normal, roughness and an HDRI against Mitsuba's unshadowed passes. A second run
    continues.

    A sphere and procedural objects under bundled lights; beside it the fast lookups that are usual instead. Takes
    about 3 minutes on 2 cores.
    """

    out: Path = Path("results/derived-light")
    """Folder of table and records."""
    lights: tuple[str, ...] = (
        "pmndrs-esplanade",
        "blender-interior",
        "blender-studio",
        "pmndrs-workshop",
        "pmndrs-city",
    )
    """Bundled lights by name: a sun, windows, lamps, a hall of small lights, a covered sky."""
    objects: tuple[int, ...] = (2, 5)
    """Seeds of procedural objects (training families) beside the sphere."""
    roughness: tuple[float, ...] = (0.1, 0.3, 0.5, 0.8)
    """Roughness values of s."""
    resolution: int = 64
    """Pixels along each side."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, or given twice.
        """
        at_least(LEAST_SIZE, resolution=self.resolution)
        given = {"lights": self.lights, "roughness": self.roughness, "objects": self.objects}
        for name, values in given.items():
            if len(set(values)) < len(values) or not (values or name == "objects"):
                raise UsageError(f"--{name} {' '.join(map(str, values))}: expected at least one, none of them twice")
        for value in self.roughness:
            if not 0 <= value <= 1:
                raise UsageError(f"--roughness {value:g}: expected numbers in [0, 1]")
        for seed in self.objects:
            at_least(0, objects=seed)

    def run(self) -> int:
        """Measures what is missing, prints and writes `derived_light.md` and `.json`; returns the exit status."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.studies.derived_light.measure import DerivedLight
        from unirender_evaluation.studies.derived_light.run import run
        from unirender_evaluation.versions import versions

        what = DerivedLight(self.out, self.lights, self.objects, self.roughness, self.resolution, versions())
        run(what, Console())
        return 0
