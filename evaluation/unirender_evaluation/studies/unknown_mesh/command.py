"""`unirender bench unknown-mesh`. Light to import."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from unirender.command_line.option_checks import at_least
from unirender.errors import UsageError
from unirender_reference.optimize.multiview.config import OptimizeConfig

LEAST_VIEWS = 4


@dataclass(frozen=True)
class BenchUnknownMesh:
    """Score meshes, materials and light found from posed pictures with masks, without a mesh. A second run continues.

    The complete `unirender optimize FOLDER` on objects of a suite: shape, light and materials, shape and these
    again, refinement; scored against the true objects from cameras that it has not seen. Takes about 20
    minutes on 2 cores.
    """

    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    out: Path = Path("results/unknown-mesh")
    """Folder of tables, records and results: a folder for each object, with mesh, light and a picture to look at."""
    objects: int = 4
    """Objects, evenly spaced, as in the multi-view table."""
    views: int = 24
    """Pictures of each object."""
    progress: bool = True
    """Show progress."""
    config: Annotated[OptimizeConfig, tyro.conf.arg(name="")] = field(default_factory=OptimizeConfig)

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, objects=self.objects)
        if self.views < LEAST_VIEWS:
            raise UsageError(
                f"--views {self.views}: expected at least {LEAST_VIEWS}: fewer silhouettes enclose no object"
            )
        self.config.check()

    def run(self) -> int:
        """Measures what is missing, prints and writes `unknown_mesh.md` and `.json`; returns the exit status."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.multiview.scenes import multiview_scenes
        from unirender_evaluation.multiview.settings import STANDARD
        from unirender_evaluation.studies.unknown_mesh.measure import UnknownMesh
        from unirender_evaluation.studies.unknown_mesh.run import run
        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.versions import versions

        suite = load_suite(self.suite)
        settings = replace(STANDARD, seen=self.views)
        what = UnknownMesh(suite, self.out, settings, self.config, versions())
        scenes = multiview_scenes(list(suite.scenes), self.objects)
        run(what, scenes, Console(), self.progress)
        return 0
