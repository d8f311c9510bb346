"""Mitsuba's path tracer as a renderer of maps, so that the physics tests can ask it what they ask everybody.

A path tracer needs the object, not its maps: the tests change the maps in known ways (mirror, quarter turn, a mirror
for a surface, another material, another light), and what was changed is recognised and done to the object. Maps that it
does not recognise are refused.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.symmetries import mirror, quarter_turn, turn_rotation
from unirender_evaluation.methods.method import Image
from unirender_evaluation.physics.formulas import changed
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.truth.render import good_spp, item_seed
from unirender_reference.shapes import MeshObject

MIRROR_DEPTH = 64  # light that is reflected once more in a perfect mirror is not lost


@dataclass(frozen=True)
class Pose:
    """A change of the whole scene that a test makes: of its maps, and of the object's mesh."""

    name: str
    of_maps: Callable[[Intrinsics], Intrinsics]
    of_mesh: Callable[[MeshObject], MeshObject]


def moved(obj: MeshObject, matrix: Float[np.ndarray, "3 3"]) -> MeshObject:
    """The object under a rotation or reflection of space; faces stay counter-clockwise seen from outside."""
    faces = obj.faces if np.linalg.det(matrix) > 0 else np.ascontiguousarray(obj.faces[:, ::-1])
    vertices, normals = (np.ascontiguousarray(x @ matrix.T, np.float32) for x in (obj.vertices, obj.normals))
    return replace(obj, vertices=vertices, normals=normals, faces=faces)


MIRROR = np.diag([-1.0, 1.0, 1.0]).astype(np.float32)
POSES = (
    Pose("as it is", lambda maps: maps, lambda obj: obj),
    Pose("mirrored", lambda maps: changed(maps, mirror), lambda obj: moved(obj, MIRROR)),
    Pose("turned", lambda maps: changed(maps, quarter_turn), lambda obj: moved(obj, turn_rotation(1))),
)


class PathTracer:
    """Renders the maps that the physics tests make of one scene, all with one seed, as `shade` does: what is linear
    in the samples comes out exactly, the rest to within noise.
    """

    def __init__(self, stage: Stage, spp: int) -> None:
        self.stage, self.spp = stage, good_spp(spp, stage.suite.spec)
        self._renderers: dict[str, Any] = {}
        self._seed = item_seed("tracer", stage.scene.key)
        self._images: dict[tuple[Any, ...], Image] = {}

    @cached_property
    def _normals(self) -> dict[str, np.ndarray]:
        return {pose.name: pose.of_maps(self.stage.base).require("normal")["normal"] for pose in POSES}

    def render(self, maps: Intrinsics) -> Image:
        """The picture, linear and premultiplied."""
        found = maps.require("albedo", "normal", "metallic", "roughness", "environment", "mask")
        pose = next((p for p in POSES if np.array_equal(found["normal"], self._normals[p.name])), None)
        if pose is None:
            raise UnirenderError("path tracer: got other normals than those of the scene, its mirror image or turn")
        inside = found["mask"] > 0
        metallic, roughness = (_uniform(name, found[name][inside]) for name in ("metallic", "roughness"))
        environment = np.ascontiguousarray(found["environment"])
        digest = hashlib.sha256(environment.tobytes()).hexdigest()
        same = np.array_equal(found["albedo"], pose.of_maps(self.stage.base).require("albedo")["albedo"])
        if not same and not (metallic == 1 and np.all(found["albedo"][inside[..., 0]] == 1)):
            raise UnirenderError("path tracer: got another albedo than the scene's, expected it or a mirror's")
        key = (pose.name, metallic, roughness, same, digest)
        if key not in self._images:
            draw = self._surface if same else self._mirror
            self._images[key] = draw(self._renderer(pose), metallic, roughness, environment)
        return self._images[key]

    def _renderer(self, pose: Pose) -> Any:
        if pose is POSES[0]:
            return self.stage.mitsuba.renderer
        if pose.name not in self._renderers:
            from unirender_reference.render import Renderer

            spec, obj = self.stage.suite.spec, pose.of_mesh(self.stage.mitsuba.renderer.obj)
            self._renderers[pose.name] = Renderer(obj, camera=spec.camera, resolution=spec.resolution)
        return self._renderers[pose.name]

    def _surface(self, renderer: Any, metallic: float, roughness: float, environment: np.ndarray) -> Image:
        return renderer.image(environment, roughness, metallic, self.spp, self._seed).mean[..., :3]

    def _mirror(self, renderer: Any, _: float, roughness: float, environment: np.ndarray) -> Image:
        from unirender_reference.passes import TRUTH_BATCHES, mean_estimate, render_passes

        scene = renderer.lit("mirror", {"roughness": roughness}, environment)
        passes = render_passes(scene, MIRROR_DEPTH, self.spp, self._seed, TRUTH_BATCHES, renderer.counters)
        return mean_estimate(*passes, TRUTH_BATCHES).mean[..., :3]


def _uniform(name: str, values: np.ndarray) -> float:
    if np.ptp(values) != 0:
        raise UnirenderError(f"path tracer: got {name} from {values.min():g} to {values.max():g}, expected one value")
    return round(float(values.max()), 6)
