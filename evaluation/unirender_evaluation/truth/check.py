"""The check of a suite's truth: a random part of it is rendered again on this machine, with other seeds, and z-tested.

The same renders, at the suite's own samples per pixel, are the row *reference (other seed)*. Mask, albedo and normal
are traced again and compared within stated tolerances. Twins have to fail on one of the scenes, or the test is blind:
an image rendered with a roughness 12 % off, an albedo 2 % off, a normal turned by some degrees (`twin_roughness` and
`twin_geometry` say what takes their place where they would change nothing).

All z-tests together raise a false alarm in at most `FAMILY_ALPHA` (1 %) of checks: each of the n members has the level
`FAMILY_ALPHA` / n, half of it for the smallest p (one wrong pixel) and half for the share of passing values (a small
error everywhere), where the pixels but not their three channels count as independent. A member that fails is rendered
once more, under another seed, and fails if it does again.
"""

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UsageError
from unirender_evaluation.suites.objects import object_is_here, scene_object
from unirender_evaluation.suites.suite import Material, Scene, Suite, material_key
from unirender_evaluation.suites.truth_file import diffuse_member, image_member, specular_member
from unirender_evaluation.truth.geometry import GeometryTest, compare_geometry, twin_geometry
from unirender_evaluation.truth.render import good_spp, item_seed
from unirender_reference.scene_spec import object_hash

logger = logging.getLogger(__name__)

LIGHTS = ("specular", "diffuse")
HALF_ROUNDING = 5e-4  # relative rounding of half floats
SECOND_LOOK = 1  # added to the seed for a member that failed
TWIN_FACTOR = 1.12
TWIN_LEAST = 0.25  # near-mirrors differ less than their samples' noise; this much rougher is seen
MORE_SAMPLES = "raise the suite's spp or target_db, or check more scenes"
MORE_SCENES = "check more scenes: the objects of these hardly cover a whole pixel"


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
    """One object's shared maps traced again."""

    name: str
    test: GeometryTest


@dataclass(frozen=True)
class TruthCheck:
    """All re-renders of a run. `passed`: every member and geometry agrees with the shipped truth and no twin does.

    `other_objects` names checked objects whose generator or mesh reader gives another mesh here than where the truth
    was made: rounding on another CPU, or (when their members fail) changed code.
    """

    checks: tuple[Check, ...]
    twin: Any
    seed: int
    other_objects: tuple[str, ...] = ()
    geometry: tuple[GeometryCheck, ...] = ()
    geometry_twins: Mapping[str, GeometryTest] = field(default_factory=dict)
    chosen_from: tuple[int, int] = (0, 0)
    twin_name: str = "roughness"

    @property
    def missed(self) -> dict[str, str]:
        """The deliberate errors that were not found, each with what may help."""
        found = {self.twin_name: MORE_SAMPLES} if self.twin.passed else {}
        return found | {name: MORE_SCENES for name, test in self.geometry_twins.items() if test.passed}

    @property
    def twins_detected(self) -> bool:
        return not self.missed

    @property
    def passed(self) -> bool:
        return all(check.test.passed for check in (*self.checks, *self.geometry)) and self.twins_detected

    def summary(self) -> dict[str, Any]:
        """JSON: counts, worst member, twin."""
        worst = min(self.checks, key=lambda c: (c.test.passed, c.test.min_p / c.test.threshold))
        failed = [f"{c.name}: {c.test}" for c in (*self.checks, *self.geometry) if not c.test.passed]
        return {
            "passed": self.passed,
            "seed": self.seed,
            "members": len(self.checks),
            "geometries": len(self.geometry),
            "geometry": {c.name: str(c.test) for c in self.geometry},
            "scenes": sorted({c.scene.key for c in self.checks}),
            "failed": failed,
            "other_objects": list(self.other_objects),
            "chosen_from": list(self.chosen_from),
            "worst": f"{worst.name}: {worst.test}",
            "smallest_pass_share": min(c.test.pass_share for c in self.checks),
            "twin": f"{self.twin_name}: {self.twin}",
            "geometry_twins": {name: str(twin) for name, twin in self.geometry_twins.items()},
            "twin_detected": self.twins_detected,
            "missed": self.missed,
        }


def scenes_here(suite: Suite) -> list[Scene]:
    """The scenes whose objects can be made or read here."""
    return [scene for scene in suite.scenes if object_is_here(suite, scene)]


def where_meshes_belong(suite: Suite) -> str:
    """The folder where a suite looks for its meshes, and where to get them or how to name another."""
    source = suite.spec.objects_from or f"name their folder as `objects` under [folders] in {suite.spec.path}"
    return f"{suite.spec.folder('objects') or 'any folder'} ({source})"


def chosen_scenes(suite: Suite, count: int, seed: int) -> list[Scene]:
    """`count` scenes at random, of different objects as long as there are enough.

    Objects whose mesh file is not here cannot be rendered again and are left out; where that leaves none they are not.

    Raises:
        UsageError: none are asked for.
    """
    if count < 1:
        raise UsageError(f"truth check: got {count} scenes, expected at least 1")
    rng = np.random.default_rng([seed, 0x7E57])
    here = scenes_here(suite) or list(suite.scenes)
    scenes = [here[i] for i in rng.permutation(len(here))]
    first = {scene.object: scene for scene in reversed(scenes)}
    order = [s for s in scenes if first[s.object] is s] + [s for s in scenes if first[s.object] is not s]
    return order[: min(count, len(order))]


def checked_images(suite: Suite, scene: Scene, seed: int) -> list[tuple[Scene, Material]]:
    """The images of a scene that are rendered again: edits, a stratified one, the base under the other light."""
    stratified = scene.materials[seed % len(scene.materials)] if scene.materials else suite.spec.base
    edits = [(scene, material) for material in suite.spec.edits]
    return list(dict.fromkeys([*edits, (scene, stratified), (suite.other_light(scene), suite.spec.base)]))


def check_truth(suite: Suite, count: int, seed: int) -> Iterator[Check | GeometryCheck | TruthCheck]:
    """Renders `count` random scenes again: :func:`checked_images`, s and d; and traces their objects' shared maps.

    Args:
        suite: the suite.
        count: scenes.
        seed: chooses scenes and render seeds; never the truth's own.

    Yields:
        Every check as it is done; at last the :class:`TruthCheck`.
    """
    from unirender_reference.render import Renderer
    from unirender_reference.statistics import FAMILY_ALPHA

    chosen_from = (len(scenes_here(suite)), len(suite.scenes))
    if chosen_from[0] < chosen_from[1]:
        logger.warning(
            "the truth check chooses from %d of %d scenes: the meshes of the others are not in %s",
            *(*chosen_from, where_meshes_belong(suite)),
        )
    checks: list[Check] = []
    others: list[str] = []
    geometry: list[GeometryCheck] = []
    geometry_twins: dict[str, GeometryTest] = {}
    twin = None
    spec, chosen = suite.spec, chosen_scenes(suite, count, seed)
    wrong = twin_roughness(spec.base[1])
    alpha = FAMILY_ALPHA / sum(len(checked_images(suite, scene, seed)) + len(LIGHTS) for scene in chosen)
    for scene in chosen:
        made = suite.provenance["objects"][scene.object]
        obj = scene_object(suite, scene)
        if object_hash(obj) != made["sha256"]:
            others.append(scene.object)
        renderer = Renderer(obj, camera=spec.camera, resolution=spec.resolution)
        if scene.object not in {c.name for c in geometry}:
            stored = suite.intrinsics(scene, spec.base)
            again = renderer.geometry(spec.geometry_spp, item_seed("check", seed, scene.object, "geometry"))
            geometry.append(GeometryCheck(scene.object, compare_geometry(stored, again, spec.geometry_spp)))
            yield geometry[-1]
            if not geometry_twins or any(test.passed for test in geometry_twins.values()):
                twins = twin_geometry(again).items()
                geometry_twins = {n: compare_geometry(stored, maps, spec.geometry_spp) for n, maps in twins}
        for lit, material in checked_images(suite, scene, seed):
            check = partial(_check_image, suite, renderer, lit, material, material, alpha=alpha)
            checks.append(look_twice(check, seed))
            yield checks[-1]
        if twin is None or twin.passed:
            twin = _check_image(suite, renderer, scene, spec.base, (spec.base[0], wrong), seed, alpha).test
        for kind in LIGHTS:
            checks.append(look_twice(partial(_check_light, suite, renderer, scene, kind, alpha=alpha), seed))
            yield checks[-1]
    name = f"roughness {wrong:.3g} for {spec.base[1]:g}"
    yield TruthCheck(tuple(checks), twin, seed, tuple(others), tuple(geometry), geometry_twins, chosen_from, name)


def twin_roughness(roughness: float) -> float:
    """A wrong roughness in [0, 1]: 12 % rougher, or smoother where that would be above 1; of near-mirrors 0.25."""
    rougher = max(roughness * TWIN_FACTOR, TWIN_LEAST)
    return rougher if rougher <= 1 else roughness / TWIN_FACTOR


def member_test(
    mean_a: Float[np.ndarray, "h w 3"],
    variance_a: Float[np.ndarray, "h w 3"],
    mean_b: Float[np.ndarray, "h w 3"],
    variance_b: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    alpha: float,
) -> Any:
    """z-test of (mean, variance, mean, variance) with a chance of a false alarm of at most `alpha` in all."""
    from unirender_reference.statistics import z_test

    return z_test(mean_a, variance_a, mean_b, variance_b, mask, rounding=HALF_ROUNDING, alpha=alpha / 2)


def _samples(suite: Suite, member: str) -> int:
    """Samples per pixel of a member rendered again: its own, or the next number that divides into batches."""
    return good_spp(suite.provenance["quality"][member]["spp"], suite.spec)


def look_twice(check: Callable[[int], Check], seed: int) -> Check:
    """A check; where it fails, that under another seed: a wrong truth fails again, a false alarm hardly ever."""
    first = check(seed)
    return first if first.test.passed else check(seed + SECOND_LOOK)


def _check_image(
    suite: Suite, renderer: Any, scene: Scene, stored: Material, rendered: Material, seed: int, alpha: float
) -> Check:
    member = image_member(scene.key, stored)
    again = renderer.image(
        suite.environment(scene), rendered[1], rendered[0], _samples(suite, member), item_seed("check", seed, member)
    )
    test = member_test(
        again.mean[..., :3],
        again.variance[..., :3],
        suite.image(scene, stored),
        suite.image_variance(scene, stored),
        mask=suite.mask(scene),
        alpha=alpha,
    )
    return Check(scene, "image", stored, again.mean[..., :3], test)


def _check_light(suite: Suite, renderer: Any, scene: Scene, kind: str, seed: int, alpha: float) -> Check:
    material, environment = suite.spec.base, suite.environment(scene)
    maps = suite.intrinsics(scene, material).require("diffuse", "specular")
    if kind == "diffuse":
        member, variance = diffuse_member(scene.key), suite.diffuse_variance(scene)
        again = renderer.diffuse(environment, _samples(suite, member), item_seed("check", seed, member))
    else:
        member, variance = specular_member(scene.key, material[1]), suite.specular_variance(scene, material[1])
        again = renderer.specular(environment, material[1], _samples(suite, member), item_seed("check", seed, member))
    test = member_test(again.mean, again.variance, maps[kind], variance, mask=suite.mask(scene), alpha=alpha)
    return Check(scene, kind, material, again.mean, test)
