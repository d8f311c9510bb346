"""A Mitsuba scene of one object whose surface, material and light change in place."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference import envmap, materials
from unirender_reference.backend import mitsuba
from unirender_reference.scene import LIGHT, load_scene, parameter_name
from unirender_reference.shapes import MeshObject


class EditableScene:
    """A scene whose surface, material and light change in place.

    It loads once: building an acceleration structure takes up to half as long as a render of 64 x 64 pixels. The lobes
    load when they are first shown, and so does a surface with the object's own maps: scenes of scalars run the kernels
    of objects without maps.

    Args:
        obj: the object.
        camera: the contract's camera.
        resolution: height and width in pixels.

    Attributes:
        normal_texture: the object's normal map as a loaded texture (see `materials.normal_texture_of`), or None.
    """

    def __init__(self, obj: MeshObject, camera: Camera, resolution: int) -> None:
        mi = mitsuba()
        first = np.ones((3, 4, 3), np.float32)  # any light: `show` sets the one asked for
        self._obj = obj
        self._scene = load_scene(obj, materials.white_bsdf(), first, camera, resolution)
        self._light = mi.traverse(self._scene)
        self._fingerprint = _fingerprint(first)
        self.normal_texture = None if obj.normal_map is None else materials.normal_texture_of(obj.normal_map)
        self._surfaces: dict[tuple[str, frozenset[str]], _Surface] = {}
        # Dr.Jit compiles a kernel for all surfaces there are: those that every sample shows are there from the start.
        for surface in ("principled", "mirror", "white"):
            self._surface(surface, {})
        # Dr.Jit inlines a virtual call that has one candidate, and then computes it for the background, too. With a
        # second shape and emitter in the process it branches: the same values, 15 % sooner.
        self._bystanders = mi.load_dict({"type": "rectangle"}), mi.load_dict({"type": "constant"})

    def show(
        self,
        surface: materials.Surface,
        values: Mapping[str, float | None] | None = None,
        environment: Float[np.ndarray, "h w 3"] | None = None,
    ) -> Any:
        """The Mitsuba scene with a surface, its material and a light; valid until the next call.

        Args:
            surface: see `materials`.
            values: `roughness` (perceptual) and `metallic`, as far as the surface has them: in [0, 1], or None for
                the object's own map.
            environment: linear radiance, camera axes; None: whatever light the scene has.

        Raises:
            UnirenderError: a value lies outside [0, 1] or belongs to another surface, the object has no such map, or
                the light is black, negative, not finite or above `MOST_RADIANCE`.
        """
        shown = self._surface(surface, values or {})
        if environment is not None:
            self._relight(np.ascontiguousarray(environment, dtype=np.float32))
        self._scene.shapes()[0].set_bsdf(shown.bsdf)
        return self._scene

    def parameters(self, surface: materials.Surface, values: Mapping[str, float | None] | None = None) -> Any:
        """The surface without its normal map, through which Mitsuba's `eval_attribute` does not reach."""
        return self._surface(surface, values or {}).plain

    def _surface(self, surface: materials.Surface, values: Mapping[str, float | None]) -> "_Surface":
        """The surface with its values set, loaded if it is new."""
        for key, value in values.items():
            if key not in materials.surface_parameters(surface):
                raise UnirenderError(
                    f"surface {surface!r}: got {key}, expected {materials.surface_parameters(surface)}"
                )
            if value is None and getattr(self._obj, key) is None:
                raise UnirenderError(
                    f"{key}: got None, the object's own map, but {self._obj.name} has none; expected a value in [0, 1]"
                )
            if value is not None and not (isinstance(value, Real) and 0.0 <= value <= 1.0):
                raise UnirenderError(
                    f"{key}: got {value!r:.60}, expected a value in [0, 1]; a map belongs to the "
                    f"object (dataclasses.replace(obj, {key}=map)) and is None here"
                )
        mapped = frozenset(key for key, value in values.items() if value is None)
        found = self._surfaces.get((surface, mapped))
        if found is None:
            found = self._surfaces[surface, mapped] = self._load(surface, mapped)
        for key, value in values.items():
            if value is not None:
                found.parameters[parameter_name(found.parameters, f"{materials.INNER}.{key}.value")] = value
        found.parameters.update()
        return found

    def _load(self, surface: materials.Surface, mapped: frozenset[str]) -> "_Surface":
        mi = mitsuba()
        maps = {key: getattr(self._obj, key) for key in mapped}
        plain = mi.load_dict(materials.surface_bsdf(surface, self._obj.albedo, **maps))
        bumped = plain if self.normal_texture is None else materials.with_normal_map(plain, self.normal_texture)
        return _Surface(plain, bumped, mi.traverse(plain))

    def _relight(self, environment: Float[np.ndarray, "h w 3"]) -> None:
        fingerprint = _fingerprint(environment)
        if fingerprint != self._fingerprint:
            data = mitsuba().TensorXf(envmap.envmap_data(environment))
            self._light[parameter_name(self._light, f"{LIGHT}.data")] = data
            self._light.update()
            self._fingerprint = fingerprint


@dataclass(frozen=True)
class _Surface:
    """A loaded surface without and with the object's normal map (the same one where it has none)."""

    plain: Any
    bsdf: Any
    parameters: Any


def _fingerprint(array: Float[np.ndarray, "..."]) -> bytes:
    return hashlib.sha256(repr(array.shape).encode() + array.tobytes()).digest()
