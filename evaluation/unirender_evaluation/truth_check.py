"""Nobody has to believe a file: a random part of a suite's truth, rendered again on the spot with other seeds, and
z-tested.

The same renders, at the suite's own samples per pixel, are the row *reference (other seed)*. A twin rendered with a
roughness 12 % off has to fail, or the test is blind.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_evaluation.suites import Material, Scene, Suite, material_key
from unirender_evaluation.truth import item_seed, object_hash

HALF_ROUNDING = 5e-4  # relative rounding of half floats
TWIN_FACTOR = 1.12
FALSE_ALARM = 0.01  # chance that a sound truth fails the whole check; each member gets its share
GEOMETRY_LIMITS = {
    "mask": 0.01,
    "albedo": 0.01,
    "normal": 0.02,
}  # root mean square: several times what two traces differ by


@dataclass(frozen=True)
class Check:
    """One member rendered again: `mean` is linear (an image premultiplied), `test` its z-test against the shipped
    member."""

    scene: Scene
    kind: str  # "image", "specular" or "diffuse"
    material: Material
    mean: Float[np.ndarray, "h w 3"]
    test: Any  # unirender_reference.statistics.ZTest

    @property
    def name(self) -> str:
        what = material_key(self.material) if self.kind == "image" else self.kind
        return f"{self.scene.key}.{what}"


@dataclass(frozen=True)
class GeometryCheck:
    """Mask, albedo and normal of an object, traced again with another seed.

    Attributes:
        object: its key.
        rms: root mean square difference by map; mask over the frame, the others where both masks exceed 0.99.
        twin_rms: the same of the normals with x flipped, which has to exceed the limit.
    """

    object: str
    rms: dict[str, float]
    twin_rms: float

    @property
    def name(self) -> str:
        return f"{self.object}.shared"

    @property
    def passed(self) -> bool:
        sound = all(value <= GEOMETRY_LIMITS[name] for name, value in self.rms.items())
        return sound and self.twin_rms > GEOMETRY_LIMITS["normal"]

    def __str__(self) -> str:
        values = ", ".join(f"{name} {value:.4f} (limit {GEOMETRY_LIMITS[name]})" for name, value in self.rms.items())
        return f"root mean square difference: {values}; twin {self.twin_rms:.2f}"


@dataclass(frozen=True)
class TruthCheck:
    """All re-renders of a run. `passed`: every member agrees with the shipped truth and the twin does not.

    `other_objects` names checked objects whose generator gives another mesh here than where the truth was made:
    rounding on another CPU, or (when their members fail) a changed generator.
    """

    checks: tuple[Check, ...]
    twin: Any
    seed: int
    other_objects: tuple[str, ...] = ()
    geometry: tuple[GeometryCheck, ...] = ()

    @property
    def passed(self) -> bool:
        sound = all(check.test.passed for check in self.checks) and all(check.passed for check in self.geometry)
        return sound and not self.twin.passed

    def summary(self) -> dict[str, Any]:
        """JSON: counts, worst member, twin."""
        worst = min(self.checks, key=lambda c: (c.test.passed, c.test.min_p / c.test.threshold))
        failed = [f"{c.name}: {c.test}" for c in self.checks if not c.test.passed]
        failed += [f"{c.name}: {c}" for c in self.geometry if not c.passed]
        return {
            "passed": self.passed,
            "seed": self.seed,
            "members": len(self.checks) + len(self.geometry),
            "geometry": {c.object: c.rms for c in self.geometry},
            "scenes": sorted({c.scene.key for c in self.checks}),
            "failed": failed,
            "other_objects": list(self.other_objects),
            "worst": f"{worst.name}: {worst.test}",
            "smallest_pass_share": min(c.test.pass_share for c in self.checks),
            "twin": f"roughness {TWIN_FACTOR - 1:.0%} off: {self.twin}",
            "twin_detected": not self.twin.passed,
        }


def chosen_scenes(suite: Suite, count: int, seed: int) -> list[Scene]:
    """`count` scenes at random, of different objects as long as there are enough."""
    if count < 1:
        raise UnirenderError(f"truth check: got {count} scenes, expected at least 1")
    rng = np.random.default_rng([seed, 0x7E57])
    scenes = [suite.scenes[i] for i in rng.permutation(len(suite.scenes))]
    first = {scene.object: scene for scene in reversed(scenes)}
    order = [s for s in scenes if first[s.object] is s] + [s for s in scenes if first[s.object] is not s]
    return order[: min(count, len(order))]


def check_truth(suite: Suite, count: int = 4, seed: int = 0) -> Iterator[Check | GeometryCheck | TruthCheck]:
    """Renders `count` random scenes again: the maps, the edited images, one stratified image, the image under the other
    light, s and d.

    Args:
        suite: the suite.
        count: scenes.
        seed: chooses scenes and render seeds; never the truth's own.

    Yields:
        Every check as it is done; at last the :class:`TruthCheck`.
    """
    from unirender_reference.render import Renderer
    from unirender_reference.shapes import make_object

    checks: list[Check] = []
    geometry: list[GeometryCheck] = []
    others: list[str] = []
    twin = None
    spec = suite.spec
    scenes = chosen_scenes(suite, count, seed)
    alpha = FALSE_ALARM / (len(scenes) * (len(spec.edits) + 4))  # edits, stratified, other light, s, d
    for scene in scenes:
        made = suite.provenance["objects"][scene.object]
        obj = make_object(int(made["seed"]), spec.split)
        if object_hash(obj) != made["sha256"]:
            others.append(scene.object)
        renderer = Renderer(obj, camera=spec.camera, resolution=spec.resolution)
        if scene.object not in {check.object for check in geometry}:
            geometry.append(_check_geometry(suite, renderer, scene, seed))
            yield geometry[-1]
        other = suite.other_light(scene)
        stratified = scene.materials[seed % len(scene.materials)] if scene.materials else spec.base
        images = dict.fromkeys(
            [*((scene, material) for material in spec.edits), (scene, stratified), (other, spec.base)]
        )
        for lit, material in images:
            checks.append(_check_image(suite, renderer, lit, material, material, seed, alpha))
            yield checks[-1]
        if twin is None:
            off = (spec.base[0], spec.base[1] * TWIN_FACTOR)
            twin = _check_image(suite, renderer, scene, spec.base, off, seed).test
        environment, mask = suite.environment(scene), suite.mask(scene)
        for kind in ("specular", "diffuse"):
            checks.append(_check_light(suite, renderer, scene, kind, environment, mask, seed, alpha))
            yield checks[-1]
    yield TruthCheck(tuple(checks), twin, seed, tuple(others), tuple(geometry))


def _check_geometry(suite: Suite, renderer: Any, scene: Scene, seed: int) -> GeometryCheck:
    again = renderer.geometry(suite.spec.geometry_spp, item_seed("check", seed, scene.object)).require(
        "mask", "albedo", "normal"
    )
    stored = suite.intrinsics(scene, suite.spec.base).require("mask", "albedo", "normal")
    inside = np.minimum(again["mask"], stored["mask"])[..., 0] > 0.99

    def rms(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.square(a - b))))

    differences = {name: rms(again[name][inside], stored[name][inside]) for name in ("albedo", "normal")}
    flipped = again["normal"][inside] * np.array([-1, 1, 1], np.float32)
    mask = {"mask": rms(again["mask"], stored["mask"])}
    return GeometryCheck(scene.object, mask | differences, rms(flipped, stored["normal"][inside]))


def _check_image(
    suite: Suite,
    renderer: Any,
    scene: Scene,
    stored: Material,
    rendered: Material,
    seed: int,
    alpha: float = FALSE_ALARM,
) -> Check:
    from unirender_reference.statistics import z_test

    member = f"{scene.key}.{material_key(stored)}.exr"
    spp = int(suite.provenance["quality"][member]["spp"])
    again = renderer.image(suite.environment(scene), rendered[1], rendered[0], spp, item_seed("check", seed, member))
    test = z_test(
        again.mean[..., :3],
        again.variance[..., :3],
        suite.image(scene, stored),
        suite.image_variance(scene, stored),
        suite.mask(scene),
        rounding=HALF_ROUNDING,
        alpha=alpha,
    )
    return Check(scene, "image", stored, again.mean[..., :3], test)


def _check_light(
    suite: Suite,
    renderer: Any,
    scene: Scene,
    kind: str,
    environment: Float[np.ndarray, "eh ew 3"],
    mask: Float[np.ndarray, "h w 1"],
    seed: int,
    alpha: float,
) -> Check:
    from unirender_reference.statistics import z_test

    material = suite.spec.base
    maps = suite.intrinsics(scene, material).require("diffuse", "specular")
    if kind == "diffuse":
        member, variance = f"{scene.key}.diffuse.exr", suite.diffuse_variance(scene)
        spp = int(suite.provenance["quality"][member]["spp"])
        again = renderer.diffuse(environment, spp, item_seed("check", seed, member))
        stored = maps["diffuse"]
    else:
        member = f"{scene.key}.r{round(100 * material[1]):03d}.specular.exr"
        variance = suite.specular_variance(scene, material[1])
        spp = int(suite.provenance["quality"][member]["spp"])
        again = renderer.specular(environment, material[1], spp, item_seed("check", seed, member))
        stored = maps["specular"]
    test = z_test(again.mean, again.variance, stored, variance, mask, rounding=HALF_ROUNDING, alpha=alpha)
    return Check(scene, kind, material, again.mean, test)
