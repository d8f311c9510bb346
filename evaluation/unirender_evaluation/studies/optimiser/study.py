"""What the studies of the optimiser share: the objects of the multi-view table, content keys, the protocol."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from rich.console import Console

from unirender.system.run_progress import progress_bar
from unirender_evaluation.multiview.scenes import MultiviewScene, multiview_scenes, suite_scene
from unirender_evaluation.multiview.settings import STANDARD, MultiviewSettings
from unirender_evaluation.store import content_key
from unirender_evaluation.suites.suite import Scene, Suite, load_suite
from unirender_evaluation.versions import (
    MULTIVIEW,
    OPTIMIZER,
    REFERENCE,
    SEPARATOR,
    Versions,
    installed_version,
    modules_version,
    versions,
)

USES = frozenset({MULTIVIEW, OPTIMIZER, REFERENCE})


@dataclass(frozen=True)
class Study:
    """The objects of a study."""

    suite: Suite
    scenes: tuple[Scene, ...]  # one for each object
    settings: MultiviewSettings  # cameras and samples
    code: str  # versions of what its figures depend on
    seed: int  # of what is compared

    @classmethod
    def of(
        cls,
        suite: str,
        objects: int,
        seed: int,
        own: str,
        settings: MultiviewSettings = STANDARD,
        found: Versions | None = None,
    ) -> "Study":
        """The study of a suite's first scenes of `objects` objects, as the multi-view table has them.

        `own` is the module that measures, part of the code's version; `found`: versions of the code, if not those
        installed.
        """
        loaded = load_suite(suite)
        code = (found or versions()).of(USES) + f"{SEPARATOR}{own} {modules_version(own)}"
        return cls(loaded, tuple(multiview_scenes(list(loaded.scenes), objects)), settings, code, seed)

    def scene(self, scene: Scene) -> MultiviewScene:
        """The pictures of an object and its truth; rendered when they are asked for."""
        return suite_scene(self.suite, scene, self.settings)

    def key(self, scene: Scene, what: str, config: Mapping[str, Any]) -> str:
        """The content key of a measurement: truth, cameras, question, configuration and code."""
        question = f"{what}/{json.dumps(asdict(self.settings), sort_keys=True)}"
        return content_key(self.suite, scene, question, config, self.code)

    def protocol(self, **more: str) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs: everything one must know to compare a figure of the study with one's own."""
        settings, names = self.settings, ", ".join(scene.object for scene in self.scenes)
        size = self.suite.spec.resolution
        digest = content_key(self.suite, self.scenes[0], "protocol", {}, self.code)[:12]
        return (
            ("objects", f"{len(self.scenes)} ({names}), one light and one material each"),
            ("given", f"{settings.seen} pictures of {size} x {size} px (8-bit sRGB), masks, cameras, the true mesh"),
            (
                "maps",
                f"buffers of all {settings.seen + settings.held_out} cameras, {settings.buffer_spp} rays per pixel",
            ),
            ("mask", "inside the true mask, weighted by coverage"),
            ("seed", str(self.seed)),
            ("suite", f"{self.suite.spec.name} {self.suite.sha256[:12]}"),
            *more.items(),
            ("clock", f"wall clock of one process, {os.cpu_count()} cores, compilation of kernels included"),
            ("code", f"Mitsuba {installed_version('mitsuba')}, {digest}, {datetime.now(UTC).date().isoformat()}"),
        )


def work_through(jobs: Mapping[str, Callable[[], None]], console: Console, title: str) -> None:
    """Runs jobs in turn, with a bar that names the one at work."""
    with progress_bar(console) as progress:
        bar = progress.add_task(title, total=len(jobs), visible=bool(jobs))
        for label, job in jobs.items():
            progress.update(bar, description=f"{title}: {label}")
            job()
            progress.advance(bar)
