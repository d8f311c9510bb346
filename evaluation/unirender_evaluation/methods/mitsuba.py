"""Mitsuba as a row: what the tables say of a renderer and decomposer that is right.

A picture is the scene rendered again, all light transport, with a seed of its own and as many samples as the stored
truth has; a decomposition is the object's own buffers, traced again. It differs from *reference (other seed)* only in
what it fills: every table but that of the light, which it is given, the inverse one included. It is a bound, never
ranked: it knows the object, its material and the light, so it is asked by scene, past the interface of methods
(`engine.answer` is never handed a truth).

Where the generator gives another object here than the truth shows (a changed generator; a suite of foreign renders), it
says nothing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender_evaluation.bounds import KeyOf
from unirender_evaluation.engine import Prediction, record_of, score
from unirender_evaluation.methods.method import Image
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import evenly
from unirender_evaluation.store import Job
from unirender_evaluation.suites.objects import object_is_here, scene_object
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite, material_key
from unirender_evaluation.suites.truth_file import diffuse_member, image_member, specular_member
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import tasks
from unirender_evaluation.truth.geometry import GeometryTest, compare_geometry
from unirender_evaluation.truth.render import good_spp, item_seed
from unirender_evaluation.versions import LPIPS, REFERENCE

MITSUBA = MethodInfo(
    "mitsuba",
    "Mitsuba",
    "reference",
    note="renders of the true scene and the object's own buffers, other seeds, the truth's samples; a few scenes, in "
    "the physics table its closed loops (renderer tests: `unirender bench physics`)",
    config={"bound": "mitsuba"},
)


@dataclass
class MitsubaScene:
    """One object of a suite, rendered and traced on demand; what is rendered at the truth's samples is kept."""

    suite: Suite
    scene: Scene  # the object under one of its lights
    _images: dict[str, Image] = field(default_factory=dict, repr=False)

    @cached_property
    def renderer(self) -> Any:
        """`unirender_reference.render.Renderer` of the object."""
        from unirender_reference.render import Renderer

        spec = self.suite.spec
        return Renderer(scene_object(self.suite, self.scene), camera=spec.camera, resolution=spec.resolution)

    @cached_property
    def geometry(self) -> Intrinsics:
        """Mask, albedo and normal, traced again."""
        return self.renderer.geometry(self.suite.spec.geometry_spp, item_seed("mitsuba", self.scene.object))

    @cached_property
    def geometry_test(self) -> GeometryTest:
        """What was traced beside what is stored; their last bits differ where another CPU made the object."""
        spec = self.suite.spec
        return compare_geometry(self.suite.intrinsics(self.scene, spec.base), self.geometry, spec.geometry_spp)

    @property
    def shows_the_truth(self) -> bool:
        """Whether this is the object of the stored truth."""
        return self.geometry_test.passed

    def maps(self, material: MetallicRoughness) -> Intrinsics:
        """What a perfect decomposition says: traced buffers, the scene's material; no light."""
        inside = (self.geometry.require("mask")["mask"] > 0).astype(np.float32)
        metallic, roughness = (inside * np.float32(value) for value in material)
        return self.geometry.replace(metallic=metallic, roughness=roughness)

    def image(self, lit: Scene, material: MetallicRoughness, spp: int | None = None) -> Image:
        """The picture of the object, linear and premultiplied.

        Args:
            lit: the object under either light.
            material: metallic, roughness.
            spp: samples per pixel; None: those of the stored picture.
        """
        member = image_member(lit.key, material)
        name = f"{member} {spp}"
        if name not in self._images:
            samples = self._spp(member) if spp is None else good_spp(spp, self.suite.spec)
            seed = item_seed("mitsuba", member)
            made = self.renderer.image(self.suite.environment(lit), material[1], material[0], samples, seed)
            self._images[name] = made.mean[..., :3]
        return self._images[name]

    def light(self) -> dict[str, Float[np.ndarray, "h w 3"]]:
        """s and d of the scene in the base material."""
        roughness, environment = self.suite.spec.base[1], self.suite.environment(self.scene)
        inside = self.suite.mask(self.scene) > 0
        member = specular_member(self.scene.key, roughness)
        specular = self.renderer.specular(environment, roughness, self._spp(member), item_seed("mitsuba", member))
        member = diffuse_member(self.scene.key)
        diffuse = self.renderer.diffuse(environment, self._spp(member), item_seed("mitsuba", member))
        return {"specular": np.where(inside, specular.mean, 0), "diffuse": np.where(inside, diffuse.mean, 0)}

    def _spp(self, member: str) -> int:
        return good_spp(self.suite.provenance["quality"][member]["spp"], self.suite.spec)


def prediction(task: Task, mitsuba: MitsubaScene) -> Prediction:
    """What Mitsuba says to a task, whatever the task hands out."""
    spec, scene = mitsuba.suite.spec, task.scene
    if task.table == "relighting":
        image = mitsuba.image(mitsuba.suite.other_light(scene), spec.base)
        if task.truth_maps is None:
            return Prediction(image)
        return Prediction(image, Intrinsics(**mitsuba.light(), mask=task.mask, camera=spec.camera))
    known = {f"{scene.key}_{material_key(m)}": m for m in (*spec.edits, *scene.materials)}
    material = known[task.sample]
    if task.table == "inverse":
        return Prediction(maps=mitsuba.maps(material))
    return Prediction(mitsuba.image(scene, material))


def mitsuba_jobs(
    suite: Suite, scenes: Sequence[Scene], scene: Scene, key_of: KeyOf, backbones: Sequence[str], most: int | None
) -> Iterator[Job]:
    """Mitsuba's records of one scene, the physics table's aside; possible where the object is here."""
    if scene not in evenly(scenes, most):
        return
    mitsuba = MitsubaScene(suite, scene)
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, [scene]):
            if task.asks_light:
                continue  # which Mitsuba is given
            key = key_of(task.identity, MITSUBA, {REFERENCE, LPIPS})
            make = partial(_record, task, mitsuba, key, backbones)
            yield Job(key, MITSUBA.label, make, possible=object_is_here(suite, scene))


def _record(task: Task, mitsuba: MitsubaScene, key: str, backbones: Sequence[str]) -> Record:
    """One record; without values, which no table shows, where the object is another one."""
    values = score(task, prediction(task, mitsuba), backbones) if mitsuba.shows_the_truth else {}
    return record_of(task, MITSUBA, values, key)
