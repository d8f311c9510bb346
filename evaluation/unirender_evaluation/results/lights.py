"""Under which lights each sample of a suite is: what an interval over objects and lights is made from.

Of files that `bench run` wrote before it named them the commands take those of the suite, if it is installed. This
writes them into the files, which stay as they are otherwise:

    python -m unirender_evaluation.results.lights SUITE results.json ...
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from unirender.errors import UnirenderError
from unirender_evaluation.comparisons import Lights
from unirender_evaluation.results.check import suite_of
from unirender_evaluation.results.data import Results
from unirender_evaluation.results.file import read_results, write_results
from unirender_evaluation.results.merge import merged_lights
from unirender_evaluation.suites.suite import Suite, load_suite
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


def with_lights(results: Results, suite: Suite) -> Results:
    """Results with the lights of their samples.

    Raises:
        UnirenderError: they are of another suite, or of other truth.
    """
    if results.run.suite_hash != suite.sha256:
        raise UnirenderError(
            f"{results.source}: is of suite {results.run.suite} {results.run.suite_hash[:12]}, expected "
            f"{suite.spec.name} {suite.sha256[:12]}"
        )
    return replace(results, lights=sample_lights(suite))


def lights_of(files: Sequence[Results]) -> Lights:
    """The lights of the samples of all files, which are of one suite; of those that name none the suite's, if it is
    installed here."""
    named = merged_lights(files)
    older = [file for file in files if not file.lights]
    suite = suite_of(older[0].run) if older else None
    return named if suite is None else {**sample_lights(suite), **named}


def main(arguments: Sequence[str]) -> int:
    """Entry point; 0, or 1 with a line on standard error."""
    if len(arguments) < 2:
        print("usage: python -m unirender_evaluation.results.lights SUITE results.json ...", file=sys.stderr)
        return 1
    try:
        suite = load_suite(arguments[0])
        for path in map(Path, arguments[1:]):
            results = with_lights(read_results(path), suite)
            write_results(path, results.run, results.records, results.lights)
            print(f"{path}: the lights of {len({record.sample for record in results.records})} samples")
    except UnirenderError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
