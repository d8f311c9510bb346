"""Methods: what a benchmark row is made of, and the rows that need no network.

A method is any object with a `name`, a JSON-able `config` (everything its results depend on; part of the cache key) and
any of the four capabilities below; the tables that it can fill follow from those that it has. It sees the 8-bit
picture, the mask and the camera, nothing else:

    decompose(image_srgb, mask, camera) -> Intrinsics                                  any subset of the maps
    edit(image_srgb, mask, camera, roughness=None, metallic=None) -> image_linear      with another material
    relight(image_srgb, mask, camera, environment=None, specular=None, diffuse=None) -> image_linear
    render(intrinsics) -> image_linear                                                 s and d may be unknown

`image_srgb` is float32 (h, w, 3) in {0, 1/255 .. 1}, straight as in a PNG with alpha (not premultiplied, 0 outside);
`mask` (h, w, 1) is the alpha. Results are linear and premultiplied by the mask, as everywhere. How other people's
methods come in: `plugins`.
"""

import hashlib
import inspect
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.color import image_srgb as encode_srgb
from unirender.color import srgb_decode, unpremultiply
from unirender.composite import composite_image, split_sum_image
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.surface_light import diffuse_light, specular_light
from unirender_evaluation.training_statistics import training_statistics

CAPABILITIES = ("decompose", "edit", "relight", "render")
SEEN = ("image_srgb", "mask", "camera")
ALWAYS_PASSED = {"decompose": SEEN, "edit": SEEN, "relight": SEEN, "render": ("intrinsics",)}  # by these names
Image = Float[np.ndarray, "h w 3"]
Mask = Float[np.ndarray, "h w 1"]


class Method(Protocol):
    """A benchmark row; see the module for the four optional capabilities."""

    name: str

    @property
    def config(self) -> Mapping[str, Any]: ...


def capabilities(method: Any) -> tuple[str, ...]:
    """Which of `decompose`, `edit`, `relight`, `render` the method has. Its `config` is not read."""
    return tuple(name for name in CAPABILITIES if callable(getattr(method, name, None)))


def check_method(method: Any) -> None:
    """Looks whether an object is a `Method`, without reading its name and config.

    Raises:
        UnirenderError: it has none of the capabilities, or no name or config; or a function does not take what it is
            passed.
    """
    absent = [f"no `{name}`" for name in ("name", "config") if not _has(method, name)]
    absent += [] if capabilities(method) else ["none of the functions"]
    if absent:
        raise UnirenderError(
            f"{type(method).__name__} is not a method: it has {' and '.join(absent)}; expected a `name`, a `config` "
            f"and at least one of the functions {', '.join(CAPABILITIES)}"
        )
    for name in capabilities(method):
        try:
            taken = inspect.signature(getattr(method, name))
        except (TypeError, ValueError):  # compiled code may not say
            continue
        try:
            taken.bind_partial(**dict.fromkeys(ALWAYS_PASSED[name]))
        except TypeError as error:
            raise UnirenderError(
                f"{type(method).__name__}.{name} takes {taken} ({error}), expected the arguments "
                f"{', '.join(ALWAYS_PASSED[name])}, which are passed by name; rename its own"
            ) from error


def _has(method: Any, attribute: str) -> bool:
    """Whether it is there, be it a property that fails."""
    return inspect.getattr_static(method, attribute, None) is not None or hasattr(method, attribute)


def quantise(image_linear: Image, mask: Mask) -> Image:
    """The picture that a method is shown: display values of the covered part, straight, rounded to 8 bits, in [0,
    1]."""
    return (np.round(encode_srgb(unpremultiply(image_linear, mask)) * 255.0) / 255.0).astype(np.float32)


def seen_linear(image_srgb: Image, mask: Mask) -> Image:
    """The picture that a method was shown as a linear image, premultiplied."""
    return (srgb_decode(image_srgb) * mask).astype(np.float32)


def _constant(mask: Mask, value: Any) -> Float[np.ndarray, "h w c"]:
    return ((mask > 0) * np.asarray(value, np.float32)).astype(np.float32)


class UneditedInput:
    """Answers every edit and every relighting with the picture it was given."""

    name = "unedited input"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "unedited"})

    def edit(self, image_srgb: Image, mask: Mask, camera: Camera, **_: Any) -> Image:
        return seen_linear(image_srgb, mask)

    def relight(self, image_srgb: Image, mask: Mask, camera: Camera, **_: Any) -> Image:
        return seen_linear(image_srgb, mask)


class InputAsAlbedo:
    """albedo = the picture, linear."""

    name = "input as albedo"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "input-as-albedo"})

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        return Intrinsics(albedo=srgb_decode(image_srgb), mask=mask, camera=camera)


class MeanAlbedo:
    """albedo = the training objects' mean, the mean taken of display values (the best constant for a PSNR in sRGB)."""

    name = "mean albedo"

    @property
    def config(self) -> dict[str, Any]:
        return {"trivial": "mean-albedo", "albedo_srgb": training_statistics()["albedo_srgb"]}

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        albedo = srgb_decode(np.array(training_statistics()["albedo_srgb"], np.float32))
        return Intrinsics(albedo=_constant(mask, albedo), mask=mask, camera=camera)


class MeanNormal:
    """normal = the training objects' mean direction, which faces the viewer."""

    name = "mean normal"

    @property
    def config(self) -> dict[str, Any]:
        return {"trivial": "mean-normal", "normal": training_statistics()["normal"]}

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        return Intrinsics(normal=_constant(mask, training_statistics()["normal"]), mask=mask, camera=camera)


class SphereNormal:
    """normal = that of the sphere around the mask: what a silhouette alone suggests."""

    name = "sphere normal"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "sphere-normal"})

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        rows, columns = np.nonzero(mask[..., 0] > 0)
        if not len(rows):
            return Intrinsics(normal=np.zeros_like(image_srgb), mask=mask, camera=camera)
        centre = (rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2
        half = (np.ptp(rows) + 1) / 2, (np.ptp(columns) + 1) / 2
        y, x = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float32)
        x, y = (x - centre[1]) / half[1], -(y - centre[0]) / half[0]
        radius = np.sqrt(x**2 + y**2)
        x, y = x / np.maximum(radius, 1.0), y / np.maximum(radius, 1.0)
        normal = np.stack([x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], axis=-1)
        return Intrinsics(normal=np.where(mask > 0, normal, 0.0), mask=mask, camera=camera)


class ConstantMaterial:
    """metallic = roughness = 0.5."""

    name = "constant 0.5"
    config: Mapping[str, Any] = MappingProxyType({"trivial": "constant", "value": 0.5})

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        half = _constant(mask, 0.5)
        return Intrinsics(metallic=half, roughness=half, mask=mask, camera=camera)


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
        from unirender.pipelines.inputs import ready_to_render

        return split_sum_image(ready_to_render(intrinsics, shadows=True))


def set_material(intrinsics: Intrinsics, roughness: float | None, metallic: float | None) -> Intrinsics:
    """The same scene with another material; for a new roughness s changes by our pipeline's own rule."""
    from unirender.pipelines.editing import specular_for_roughness

    mask = intrinsics.require("mask")["mask"]
    edited = intrinsics
    if metallic is not None:
        edited = edited.replace(metallic=_constant(mask, metallic))
    if roughness is not None:
        target = _constant(mask, roughness)
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
