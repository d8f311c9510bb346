"""One scene of a suite as the physics tests see it: true maps, true pictures, and what Mitsuba makes of found maps."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender_evaluation.bounds import Shade
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.methods.mitsuba import MitsubaScene
from unirender_evaluation.physics.ambiguity import Explanations
from unirender_evaluation.physics.formulas import composite_shader
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite

Shader = Literal["shade", "composite"]
Light = Literal["input", "heldout"]
ROUGH = 0.3  # least roughness of the closed loop's primary figure: below, one point per pixel is no render (DESIGN 4)
SWEEP_SPP = 256  # of the pictures that a suite does not store
LEVELS = tuple(i / 10 for i in range(11))


def shade_under(maps: Intrinsics, environment: Any) -> Image:
    """Mitsuba's shading of maps under a light."""
    return Shade().render(maps.replace(environment=environment))


SHADERS: dict[str, Callable[[Intrinsics, Any], Image]] = {"shade": shade_under, "composite": composite_shader}


@dataclass
class Stage:
    """A scene with all that a test may ask of it."""

    suite: Suite
    scene: Scene  # the object under the light of its pictures ("input"); its other light is the held-out one
    _shaded: dict[str, Image] = field(default_factory=dict, repr=False)

    @cached_property
    def base(self) -> Intrinsics:
        """All true maps in the base material."""
        return self.suite.intrinsics(self.scene, self.suite.spec.base)

    @cached_property
    def other(self) -> Intrinsics:
        """The same under the held-out light."""
        return self.suite.intrinsics(self.suite.other_light(self.scene), self.suite.spec.base)

    @property
    def mask(self) -> Mask:
        return self.suite.mask(self.scene)

    @cached_property
    def mitsuba(self) -> MitsubaScene:
        """Renders what the suite does not store."""
        return MitsubaScene(self.suite, self.scene)

    @property
    def pictures(self) -> tuple[MetallicRoughness, ...]:
        """Materials whose pictures are stored under both lights."""
        return tuple(dict.fromkeys((self.suite.spec.base, *self.suite.spec.edits)))

    @property
    def own_material(self) -> MetallicRoughness:
        """One of the scene's stratified materials: over a suite's objects, roughly uniform on the unit square."""
        from unirender_evaluation.multiview.scenes import scene_material  # the optimiser

        return scene_material(self.suite, self.scene)

    @cached_property
    def explanations(self) -> Explanations:
        """Which materials explain the picture of `own_material`."""
        return Explanations(self.mitsuba, self.own_material)

    def true_maps(self, material: MetallicRoughness) -> Intrinsics:
        """The stored surface in a material, without light."""
        return self.suite.intrinsics(self.scene, material).replace(specular=None, diffuse=None, environment=None)

    def image(self, material: MetallicRoughness) -> Image:
        """The true picture: stored where the suite has it, else rendered."""
        if material in (*self.pictures, *self.scene.materials):
            return self.suite.image(self.scene, material)
        return self.mitsuba.image(self.scene, material, SWEEP_SPP)

    def shaded(self, maps: Intrinsics, shader: Shader, light: Light) -> Image:
        """Found maps shaded again under one of the lights, through the suite's camera.

        Pictures are kept, since several tests look at one.
        """
        camera = self.suite.spec.camera
        surface = maps.replace(specular=None, diffuse=None, environment=None, mask=self.mask, camera=camera)
        digest = hashlib.sha256(f"{shader} {light}".encode())
        for name in ("albedo", "normal", "roughness", "metallic"):
            digest.update(surface.require(name)[name].tobytes())
        key = digest.hexdigest()
        if key not in self._shaded:
            lit = self.scene if light == "input" else self.suite.other_light(self.scene)
            self._shaded[key] = SHADERS[shader](surface, self.suite.environment(lit))
        return self._shaded[key]

    def loop_values(
        self, maps: Intrinsics, shader: Shader, light: Light, material: MetallicRoughness, quantity: str
    ) -> dict[str, float]:
        """All image metrics of found maps, shaded again, against the true picture in the material that was shown."""
        lit = self.scene if light == "input" else self.suite.other_light(self.scene)
        truth: Float[np.ndarray, "h w 3"] = self.suite.image(lit, material)
        from unirender_evaluation.scoring import score_image  # torch

        return score_image(self.shaded(maps, shader, light), truth, self.mask, quantity=quantity)
