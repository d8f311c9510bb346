"""Scores of a pipeline on a few scenes of a suite: what a training run is told about itself.

The questions are those of the benchmark, one of each kind for every scene: the maps of a picture (`inverse`), the
render of true maps with s and d (`rendering`, given) and one anchored edit of a picture (`rendering`, from the image).
So are the metrics, masked and in sRGB. They are means over a handful of scenes of the *test* suite: a curve to look at,
not a result to print.
"""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from unirender.errors import UsageError
from unirender.score import Score
from unirender_evaluation.metrics import DEFAULT_VARIANT, METRICS, metric_key
from unirender_evaluation.scoring import score_image, score_maps
from unirender_evaluation.suites.suite import Scene, Suite, load_suite
from unirender_evaluation.tasks import scene_ids, tasks

MAP_SCORES = (("albedo", "psnr"), ("normal", "cosine"), ("metallic", "mse"), ("roughness", "mse"))
IMAGE_SCORES = (("render", "psnr"), ("edit", "psnr"))
SCORES = tuple(f"{name}.{metric}" for name, metric in (*MAP_SCORES, *IMAGE_SCORES))


def suite_validation(suite: str = "tiny", scenes: int = 4) -> Callable[[Any], dict[str, Score]]:
    """The function that scores a `UniRenderPipeline`: name -> mean over the scenes, with its direction.

    Args:
        suite: a bundled suite, or the path of a suite's TOML file.
        scenes: how many of its scenes, evenly spaced.

    Raises:
        UnirenderError: no such suite, or no scene.
        UsageError: it has fewer scenes.
    """
    loaded = load_suite(suite)
    if scenes > (there := len(loaded.scenes)):
        raise UsageError(f"--validate {scenes}: the suite {suite} has {there} scenes, expected at most as many")
    chosen = scene_ids(loaded, scenes)

    def validate(pipeline: Any) -> dict[str, Score]:
        values: dict[tuple[str, str], list[float]] = defaultdict(list)
        for number, scene in enumerate(chosen):
            for key, value in score_scene(pipeline, loaded, scene, number).items():
                values[key].append(value)
        return {
            f"{name}.{metric}": Score(float(np.mean(found)), METRICS[metric].higher_is_better)
            for (name, metric), found in values.items()
        }

    return validate


def score_scene(pipeline: Any, suite: Suite, scene: Scene, number: int) -> dict[tuple[str, str], float]:
    """The scores of one scene by (quantity, metric); `number` chooses among its questions of a kind."""

    def question(table: str, protocol: str) -> Any:
        found = list(tasks(suite, table, protocol, [scene]))
        return found[number % len(found)]

    inverse, given, edit = (
        question("inverse", "single-image"),
        question("rendering", "given"),
        question("rendering", "from-image"),
    )
    maps = pipeline.decompose(**inverse.inputs["decompose"]).intrinsics
    scores = score_maps(maps, inverse.truth_maps)
    values = {(name, metric): scores[metric_key(name, metric, DEFAULT_VARIANT)] for name, metric in MAP_SCORES}
    images = {
        "render": (pipeline.render(given.inputs["render"]["intrinsics"]), given),
        "edit": (pipeline.edit(**edit.inputs["edit"]).image_linear, edit),
    }
    for name, metric in IMAGE_SCORES:
        image, task = images[name]
        scores = score_image(image, task.truth_image, task.mask, quantity=name)
        values[name, metric] = scores[metric_key(name, metric, DEFAULT_VARIANT)]
    return values
