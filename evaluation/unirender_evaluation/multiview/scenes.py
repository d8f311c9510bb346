"""The scenes of the multi-view table: one object of a suite seen from cameras around it, rendered when they are asked.

What a method is given are `views` (8-bit pictures, masks, cameras) and `mesh` (the true shape, without its looks).
What it is scored against: the object's own maps from all cameras, its picture from cameras that the method never saw,
and the same under another light.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import quantise
from unirender_evaluation.multiview.settings import STANDARD, MultiviewSettings
from unirender_evaluation.rows import evenly
from unirender_evaluation.suites.objects import bare_mesh, scene_object
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite
from unirender_evaluation.truth.render import item_seed
from unirender_reference.multiview import orbit
from unirender_reference.optimize.views import View, Views
from unirender_reference.passes import Estimate
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject

Pose = Float[np.ndarray, "4 4"]
Environment = Float[np.ndarray, "eh ew 3"]
HELD_OUT_START_DEG = 0.5  # of the step between seen cameras: the held-out ones stand midway between them


@dataclass(frozen=True)
class LitPictures:
    """Pictures from the held-out cameras under one light: premultiplied linear RGBA with their variance."""

    pictures: tuple[Estimate, ...]

    def rgb(self, index: int) -> Float[np.ndarray, "h w 3"]:
        return self.pictures[index].mean[..., :3]

    def variance(self, index: int) -> Float[np.ndarray, "h w 3"]:
        variance = self.pictures[index].variance
        assert variance is not None, "rendered in several batches"
        return variance[..., :3]

    def mask(self, index: int) -> Float[np.ndarray, "h w 1"]:
        return np.clip(self.pictures[index].mean[..., 3:4], 0, 1)


class MultiviewScene:
    """One object under one light with one material; everything is rendered once, when it is first asked for.

    Args:
        obj: the object with its albedo.
        material: (metallic, roughness).
        light: that of the pictures, world axes (the object's, +y up), display units.
        other_light: for relighting.
        camera: field of view of all cameras.
        resolution: height and width in pixels.
        settings: how many cameras and samples.
        seed: of the renders; every picture derives its own.
    """

    def __init__(
        self,
        obj: MeshObject,
        material: MetallicRoughness,
        light: Environment,
        other_light: Environment,
        camera: Camera,
        resolution: int,
        settings: MultiviewSettings = STANDARD,
        seed: int = 0,
    ) -> None:
        self.obj, self.material, self.light, self.other_light = obj, material, light, other_light
        self.camera, self.resolution, self.settings, self.seed = camera, resolution, settings, seed
        self.seen_poses = orbit(settings.seen, camera)
        start = HELD_OUT_START_DEG * 360 / settings.seen
        self.held_out_poses = orbit(settings.held_out, camera, start)
        self.mesh = bare_mesh(obj)

    @cached_property
    def _renderer(self) -> Renderer:
        return Renderer(self.obj, self.camera, self.resolution)

    @cached_property
    def views(self) -> Views:
        """What a method is given: pictures as a camera stores them, 8-bit sRGB, not premultiplied."""
        metallic, roughness = self.material
        seed = item_seed(self.seed, "seen")
        made = self._renderer.images(self.seen_poses, self.light, roughness, metallic, self.settings.spp, seed)
        views = []
        for index, (pose, picture) in enumerate(zip(self.seen_poses, made, strict=True)):
            mask = np.clip(picture.mean[..., 3:4], 0, 1)
            shown = quantise(picture.mean[..., :3], mask)
            views.append(View(shown, mask, self.camera, pose, f"view-{index}"))
        return Views(tuple(views))

    @cached_property
    def novel(self) -> LitPictures:
        """The truth from the held-out cameras under the light of the pictures."""
        return self._truth(self.light, "novel")

    @cached_property
    def relit(self) -> LitPictures:
        """The truth from the held-out cameras under the other light."""
        return self._truth(self.other_light, "relit")

    @cached_property
    def buffers(self) -> Intrinsics:
        """The true maps from all cameras, seen ones first, one picture below the other."""
        metallic, roughness = self.material
        return self.buffers_of(self.obj, (roughness, metallic))

    def buffers_of(self, obj: MeshObject, material: tuple[float | None, float | None] = (None, None)) -> Intrinsics:
        """Albedo, roughness, metallic, normal and mask of an object from all cameras, `[cameras * h, w, c]`.

        `material` is (roughness, metallic), each a value or None for the object's own map.
        """
        found = []
        for index, pose in enumerate((*self.seen_poses, *self.held_out_poses)):
            renderer = Renderer(turned(obj, pose), self.camera, self.resolution)
            seed = item_seed(self.seed, "buffers", index)
            found.append(renderer.geometry(self.settings.buffer_spp, seed, material))
        maps = {name: np.concatenate([getattr(one, name) for one in found]) for name in found[0].present}
        return Intrinsics(**maps, camera=self.camera)

    def pictures_of(self, obj: MeshObject, light: Environment, what: str) -> LitPictures:
        """An object with its own maps from the held-out cameras, with samples of their own."""
        renderer = Renderer(obj, self.camera, self.resolution)
        seed = item_seed(self.seed, "prediction", what)
        return LitPictures(tuple(renderer.images(self.held_out_poses, light, None, None, self.settings.spp, seed)))

    def _truth(self, light: Environment, what: str) -> LitPictures:
        metallic, roughness = self.material
        seed, spp = item_seed(self.seed, what), self.settings.truth_spp
        return LitPictures(tuple(self._renderer.images(self.held_out_poses, light, roughness, metallic, spp, seed)))


def turned(obj: MeshObject, pose: Pose) -> MeshObject:
    """The object as the contract's camera sees it when it stands at `pose`: vertices and normals in camera axes."""
    rotation = np.asarray(pose, np.float32)[:3, :3]
    vertices, normals = (np.ascontiguousarray(x @ rotation, np.float32) for x in (obj.vertices, obj.normals))
    return replace(obj, vertices=vertices, normals=normals)


def multiview_scenes(scenes: list[Scene], most: int | None) -> list[Scene]:
    """The table's scenes: the first of each object of the run, at most `most` of them, evenly spaced (None: all)."""
    firsts = list({scene.object: scene for scene in reversed(scenes)}.values())[::-1]
    return evenly(firsts, most)


def scene_material(suite: Suite, scene: Scene) -> MetallicRoughness:
    """One of the scene's stratified materials: they are sorted by metallic, and objects take them in turn, two each."""
    index = list(dict.fromkeys(other.object for other in suite.scenes)).index(scene.object)
    return scene.materials[index // 2 % len(scene.materials)]


def suite_scene(suite: Suite, scene: Scene, settings: MultiviewSettings = STANDARD) -> MultiviewScene:
    """A suite's scene seen from all around: its light for the pictures, the object's other light for relighting."""
    return MultiviewScene(
        scene_object(suite, scene),
        scene_material(suite, scene),
        suite.environment(scene),
        suite.environment(suite.other_light(scene)),
        suite.spec.camera,
        suite.spec.resolution,
        settings,
        item_seed(suite.spec.name, scene.key, "multi-view", "renders"),
    )
