"""Rows that render in closed form (`unirender.composite`): from true maps, and from another method's decomposition."""

import hashlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.composite import composite_image, split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light, specular_light
from unirender_evaluation.methods.method import Image, Mask, seen_linear, uniform_map


def with_derived_light(intrinsics: Intrinsics) -> Intrinsics:
    """Fills an unknown s and d from normal, roughness and environment (closed form, no shadows)."""
    if intrinsics.specular is not None and intrinsics.diffuse is not None:
        return intrinsics
    maps = intrinsics.require("normal", "roughness", "environment", "mask")
    inside = maps["mask"] > 0
    specular, diffuse = intrinsics.specular, intrinsics.diffuse
    if specular is None:
        derived = specular_light(maps["normal"], maps["roughness"], maps["environment"], intrinsics.camera)
        specular = np.where(inside, derived, 0.0)
    if diffuse is None:
        diffuse = np.where(inside, diffuse_light(maps["normal"], maps["environment"]), 0.0)
    return intrinsics.replace(specular=specular, diffuse=diffuse)


class Composite:
    """The closed-form image of the maps it is given; an unknown s or d is derived from normal, roughness and light
    without shadows."""

    name = "composite"
    config: Mapping[str, Any] = MappingProxyType({"composite": 1})

    def render(self, intrinsics: Intrinsics) -> Image:
        return composite_image(with_derived_light(intrinsics))


class SplitSum:
    """The composite with Schlick's reflectance averaged over the lobe (Karis), instead of that at normal incidence."""

    name = "composite (split-sum)"
    config: Mapping[str, Any] = MappingProxyType({"composite": "split-sum"})

    def render(self, intrinsics: Intrinsics) -> Image:
        return split_sum_image(with_derived_light(intrinsics))


class ShadowedSplitSum:
    """The split-sum composite with s and d derived as our pipeline derives them, with the shadows that the picture's
    own surfaces cast: what our renderer begins with where only the light is given."""

    name = "composite (split-sum, seen shadows)"
    config: Mapping[str, Any] = MappingProxyType({"composite": "split-sum", "shadows": "seen"})

    def render(self, intrinsics: Intrinsics) -> Image:
        from unirender.pipelines.rendered_maps import ready_to_render

        return split_sum_image(ready_to_render(intrinsics, shadows=True))


def set_material(intrinsics: Intrinsics, roughness: float | None, metallic: float | None) -> Intrinsics:
    """The same scene with another material; for a new roughness s changes by our pipeline's own rule."""
    from unirender.pipelines.editing import specular_for_roughness

    mask = intrinsics.require("mask")["mask"]
    edited = intrinsics
    if metallic is not None:
        edited = edited.replace(metallic=uniform_map(mask, metallic))
    if roughness is not None:
        target = uniform_map(mask, roughness)
        edited = edited.replace(roughness=target, specular=specular_for_roughness(intrinsics, target)[0])
    return edited


class CompositeOf:
    """Edits and relights with another method's decomposition and the closed-form composite: what its renderer has to
    beat.

    By our pipeline's own rules, from the maps alone that the method returns: under another light s and d keep a part of
    what they have beyond their own, and, where it is anchored, what the decomposition could not explain of the picture
    is carried over.
    """

    def __init__(self, base: Any, anchored: bool, edited: dict[str, Intrinsics] | None = None) -> None:
        self.base, self.anchored = base, anchored
        self._edited: dict[str, Intrinsics] = {} if edited is None else edited  # shared by plain and anchored
        self.name = f"composite of {base.name}{' (anchored)' if anchored else ''}"

    @property
    def config(self) -> dict[str, Any]:
        return {"composite_of": dict(self.base.config), "anchored": self.anchored}

    def edit(
        self,
        image_srgb: Image,
        mask: Mask,
        camera: Camera,
        roughness: float | None = None,
        metallic: float | None = None,
    ) -> Image:
        before = self.base.decompose(image_srgb, mask, camera).replace(mask=mask)
        key = f"{hashlib.sha256(image_srgb.tobytes()).hexdigest()}/{roughness}/{metallic}"
        if key not in self._edited:
            self._edited[key] = set_material(before, roughness, metallic)
        return self._answer(image_srgb, mask, before, self._edited[key])

    def relight(
        self,
        image_srgb: Image,
        mask: Mask,
        camera: Camera,
        environment: Float[np.ndarray, "eh ew 3"] | None = None,
        specular: Image | None = None,
        diffuse: Image | None = None,
    ) -> Image:
        from unirender.pipelines.carried_light import with_carried_light

        before = self.base.decompose(image_srgb, mask, camera).replace(mask=mask)
        after = with_derived_light(before.replace(environment=environment, specular=specular, diffuse=diffuse))
        derived = [name for name, given in (("specular", specular), ("diffuse", diffuse)) if given is None]
        after = with_carried_light(before, after, derived)
        return self._answer(image_srgb, mask, before, after)

    def _answer(self, image_srgb: Image, mask: Mask, before: Intrinsics, after: Intrinsics) -> Image:
        if not self.anchored:
            return composite_image(after)
        from unirender.pipelines.editing import anchor

        return anchor(seen_linear(image_srgb, mask), composite_image(before), composite_image(after))
