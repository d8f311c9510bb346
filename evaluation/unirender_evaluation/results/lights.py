"""Under which lights each sample of a suite is: what an interval over objects and lights is made from."""

from collections.abc import Sequence

from unirender_evaluation.comparisons import Lights
from unirender_evaluation.results.check import suite_of
from unirender_evaluation.results.data import Results
from unirender_evaluation.results.merge import merged_lights
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.tasks import tasks


def sample_lights(suite: Suite) -> Lights:
    """The lights that the values of each sample depend on: that of its scene; then that of the target of a relighting.

    What is asked of a scene as a whole (many views, physics) is named as the scene, and relights it as well.
    """
    found: dict[str, tuple[str, ...]] = {}
    for scene in suite.scenes:
        found[scene.key] = (scene.light, suite.other_light(scene).light)
    for question in PROTOCOLS:
        for task in tasks(suite, *question, list(suite.scenes)):
            target = (suite.other_light(task.scene).light,) if question[0] == "relighting" else ()
            found[task.sample] = (task.scene.light, *target)
    return found


def lights_of(files: Sequence[Results]) -> Lights:
    """The lights of the samples of all files, which are of one suite; of those that name none, as of a run that was
    stopped, the suite's, if it is installed here."""
    named = merged_lights(files)
    unnamed = [file for file in files if not file.lights]
    suite = suite_of(unnamed[0].run) if unnamed else None
    return named if suite is None else {**sample_lights(suite), **named}
