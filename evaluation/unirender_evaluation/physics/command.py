"""`unirender bench physics`: the physics tests, and proof that each of them can fail. Light to import."""

from dataclasses import dataclass
from pathlib import Path

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.errors import UnirenderError
from unirender.system.writing import check_out


@dataclass(frozen=True)
class BenchPhysics:
    """Run every physics test on Mitsuba, our model, the composite and a broken twin that the test must refuse."""

    out: Path = Path("physics")
    """Folder for `physics.md` and `physics.json`."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    scenes: int = 4
    """Scenes, evenly spaced."""
    spp: int = 1024
    """Samples per pixel of Mitsuba's path tracer: its noise is the floor of the tests' values."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: the shipped one for pictures of the
    suite's size."""
    device: Device = "cpu"
    """Where our model runs."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, scenes=self.scenes, spp=self.spp)

    def run(self) -> int:
        """Returns 1 where a test does not refuse its twin."""
        self.check()
        check_out(self.out)
        from rich.progress import track

        from unirender_evaluation.claims import OURS
        from unirender_evaluation.physics.ambiguity import POSTERIOR
        from unirender_evaluation.physics.run import markdown, measure, write
        from unirender_evaluation.physics.stage import SWEEP_SPP, Stage
        from unirender_evaluation.physics.tests import TESTS
        from unirender_evaluation.rows import SAMPLE_STEPS
        from unirender_evaluation.runs.config import BenchConfig, build_rows
        from unirender_evaluation.statistics import CONFIDENCE, METHOD
        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.tasks import scene_ids
        from unirender_evaluation.versions import versions

        config = BenchConfig(suite=self.suite, checkpoint=self.checkpoint, methods=("ours",), device=self.device)
        ours = next(row.method for row in build_rows(config) if row.info.key == OURS)
        suite = load_suite(self.suite)
        scenes = scene_ids(suite, self.scenes)
        foreign = [scene.key for scene in scenes if not Stage(suite, scene).mitsuba.shows_the_truth]
        if foreign:
            raise UnirenderError(
                f"bench physics: the generator gives other objects here than the truth of {suite.spec.name!r} shows "
                f"({', '.join(foreign)}): Mitsuba cannot render them; check with `unirender bench check`"
            )
        steps = measure(suite, scenes, ours, self.spp)
        values = [v for step in track(steps, "physics", total=len(scenes) * len(TESTS)) for v in step]
        settings = {
            "suite": f"{suite.spec.name} {suite.sha256[:12]}",
            "resolution": f"{suite.spec.resolution} x {suite.spec.resolution}",
            "scenes": ", ".join(scene.key for scene in scenes),
            "path tracer": f"{self.spp} spp",
            "pictures that the suite does not store": f"{SWEEP_SPP} spp",
            "ours": f"mode mean; ambiguity: {POSTERIOR} samples of {SAMPLE_STEPS} steps",
            "truth": f"Mitsuba {suite.provenance['mitsuba']}",
            "interval": f"{CONFIDENCE:.0%} over objects: {METHOD}",
            "code": versions().code[:12],
        }
        found = write(self.out, values, settings)
        print(markdown(found, settings))
        return 0 if all(finding.refused for finding in found) else 1
