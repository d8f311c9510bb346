"""Measures what a learned prediction is worth as the start of single-view optimisation: the same pictures with and
without it, the same steps.

    geometry            cold                                        warm
    known-mesh          grey start; normals and shadows of the      the prediction's maps and light; the same mesh
                        true mesh
    predicted-normals   grey start; the prediction's normals        the prediction, its normals included
    true-normals        grey start; the true normals as a map       the prediction with the true normals

Beside both stands the prediction as it is. Every result is rendered again by Mitsuba (`shade`): under the light that
was found (`fit`) and under the object's other light (`relit`).
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender_evaluation.light_metrics import light_values
from unirender_evaluation.methods.method import seen_linear
from unirender_evaluation.methods.optimized import SHADE_SPP
from unirender_evaluation.metrics import LOWER, Metric, metric_key
from unirender_evaluation.multiview.scenes import scene_material
from unirender_evaluation.multiview.tables import SECONDS
from unirender_evaluation.records import Record
from unirender_evaluation.scoring import score_image, score_maps
from unirender_evaluation.store import Store, content_key
from unirender_evaluation.suites.objects import known_mesh, scene_object
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tasks import picture
from unirender_evaluation.truth.render import item_seed
from unirender_evaluation.versions import MODEL, MULTIVIEW, OPTIMIZER, REFERENCE, SEPARATOR, Versions, modules_version
from unirender_reference.optimize.single.config import SingleConfig

Geometry = Literal["known-mesh", "predicted-normals", "true-normals"]
COLD, WARM, PREDICTION = "cold", "warm", "prediction"
TABLE, PICTURE = "warm-start", "picture"  # the prediction's protocol: it is told no geometry
USES = frozenset({MODEL, MULTIVIEW, OPTIMIZER, REFERENCE})
TRUTH_SPP = 1024
STEPS = Metric(
    "steps", "steps", "", LOWER, 0.0, (), 1, "Levenberg-Marquardt steps taken; a stage ends when it gains little"
)


@dataclass(frozen=True)
class WarmStart:
    """What is measured."""

    suite: Suite  # whose scenes
    out: Path  # folder of the records
    base: Any  # a method with `decompose`: the prediction
    config: SingleConfig  # of the optimisation, cold and warm
    geometries: tuple[Geometry, ...]  # those that are given
    versions: Versions  # of the code, for the content keys

    def questions(self) -> Iterator[tuple[str, str]]:
        """(protocol, method) of every record of a scene."""
        yield PICTURE, PREDICTION
        for geometry in self.geometries:
            yield from ((geometry, COLD), (geometry, WARM))

    @property
    def code(self) -> str:
        """Versions of what the figures depend on."""
        return f"{self.versions.of(USES)}{SEPARATOR}{modules_version('studies/warm_start/measure')}"

    def key(self, scene: Scene, protocol: str, method: str) -> str:
        """The content key of a record."""
        config: dict[str, Any] = {} if protocol == PICTURE else {"optimize_image": asdict(self.config)}
        if method != COLD or protocol == "predicted-normals":
            config["prediction"] = dict(self.base.config)
        what = f"{TABLE}/{scene.key}/{protocol}/{method}"  # the scene's hash is its object's
        return content_key(self.suite, scene, what, config, self.code)


def measure(what: WarmStart, scenes: Sequence[Scene]) -> Iterator[tuple[Record, bool]]:
    """The records of scenes, and whether each was measured now; those that are stored are not measured again."""
    store = Store.open(what.out / "records.jsonl")
    for scene in scenes:
        case = Case(what, scene)
        for protocol, method in what.questions():
            key = what.key(scene, protocol, method)
            new = not store.has(key)
            if new:
                values, seconds = case.values(protocol, method)
                store.add(Record(TABLE, protocol, method, scene.key, scene.object, values, key, seconds=seconds))
            yield store.used[key], new
    store.close()


class Case:
    """One picture; what its records share is made when the first asks for it.

    The material is one of the scene's own, spread over the grid: a grey start at 0.5 would be right on the suite's base
    material.
    """

    def __init__(self, what: WarmStart, scene: Scene) -> None:
        self.what, self.suite, self.scene = what, what.suite, scene
        self.material = scene_material(what.suite, scene)

    def values(self, protocol: str, method: str) -> tuple[dict[str, float], float]:
        """Metric key -> value of one result, and the seconds of its optimisation (or prediction)."""
        if method == PREDICTION:
            found, seconds = self.prediction
            return self.scores(found, None) | {metric_key("time", SECONDS): seconds}, seconds
        steps, options = 0, self._options(protocol, method)

        def count(step: Any) -> None:
            nonlocal steps
            steps = step.iteration

        from unirender_reference.optimize.single.run import optimize_image

        start = time.perf_counter()
        found = optimize_image(**self._seen, config=self.what.config, on_step=count, **options)
        seconds = time.perf_counter() - start
        values = self.scores(found, options.get("geometry"))
        return values | {metric_key("time", SECONDS): seconds, metric_key("time", STEPS): float(steps)}, seconds

    def _options(self, protocol: str, method: str) -> dict[str, Any]:
        options: dict[str, Any] = {"init": self.prediction[0]} if method == WARM else {}
        if protocol == "known-mesh":
            options["geometry"] = self._mesh
        else:
            source = self._truth if protocol == "true-normals" else self.prediction[0]
            options["normal"] = source.require("normal")["normal"]
        return options

    def scores(self, found: Intrinsics, geometry: Any) -> dict[str, float]:
        """Maps, light, and the renders under both lights, with the shadows of a mesh (`geometry`) or without."""
        from unirender_reference.shade import shade

        mask, camera = self._seen["mask"], self._seen["camera"]
        found = found.replace(mask=mask, camera=camera)
        values = score_maps(found.replace(mask=None, specular=None, diffuse=None), self._truth)
        values |= light_values(found.require("environment")["environment"], self.suite.environment(self.scene))
        image = seen_linear(self._seen["image"], mask)
        for quantity, light, truth in (("fit", None, image), ("relit", self._other_light, self._relit)):
            made = shade(found, environment=light, spp=SHADE_SPP, geometry=geometry)
            values |= score_image(made, truth, mask, quantity=quantity)
        return values

    @cached_property
    def _seen(self) -> Mapping[str, Any]:
        """Picture, mask and camera."""
        seen = picture(self.suite, self.scene, self.material)
        return {"image": seen["image_srgb"], "mask": seen["mask"], "camera": seen["camera"]}

    @cached_property
    def prediction(self) -> tuple[Intrinsics, float]:
        """Of the picture, and its seconds once the model is there."""
        seen = picture(self.suite, self.scene, self.material)
        grey = np.full_like(seen["image_srgb"], 0.5)
        self.what.base.decompose(grey, seen["mask"], seen["camera"])  # loads the model
        start = time.perf_counter()
        found = self.what.base.decompose(**seen)
        return found, time.perf_counter() - start

    @cached_property
    def _truth(self) -> Intrinsics:
        return self.suite.intrinsics(self.scene, self.material).replace(specular=None, diffuse=None)

    @cached_property
    def _mesh(self) -> Any:
        return known_mesh(self.suite, self.scene)

    @cached_property
    def _other_light(self) -> Float[np.ndarray, "eh ew 3"]:
        return self.suite.environment(self.suite.other_light(self.scene))

    @cached_property
    def _relit(self) -> Float[np.ndarray, "h w 3"]:
        """The truth under the other light, which the suite stores for its base material alone."""
        from unirender_reference.render import Renderer

        renderer = Renderer(scene_object(self.suite, self.scene), self.suite.spec.camera, self.suite.spec.resolution)
        seed = item_seed(self.suite.spec.name, self.scene.key, TABLE, "relit")
        metallic, roughness = self.material
        return renderer.image(self._other_light, roughness, metallic, TRUTH_SPP, seed).mean[..., :3]
