"""Errors put into the reference on purpose: what the checks are for.

Each perturbation changes the scenes that are built and rendered in this process, and nothing of what is expected of
them. `perturbed(name)` holds while its block runs; renderers made before keep what they had loaded.

    roughness    12 % more roughness than asked for
    light-texel  the light turned by one of its texels about +y
    unwrapped    the light map written as (H, W, 3), without the wrapped borders of Mitsuba's `envmap`
    albedo       2 % more base colour
    normals      normals written in a mirrored frame (x reversed)
    gamma        pictures encoded for display once more than they should be: sRGB values where linear ones are meant
    fov          1 % more field of view
    metallic     metallic encoded for display, as if it were a colour
    bounces      no light from the second bounce on in the interreflection of `effects`
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from unirender.color import srgb_encode
from unirender.errors import UnirenderError
from unirender_reference import effects, envmap, materials, scene, sensors
from unirender_reference.backend import mitsuba
from unirender_reference.editable_scene import EditableScene
from unirender_reference.render import DIRECT_DEPTH

MORE_ROUGHNESS = 1.12
MORE_ALBEDO = 1.02
MORE_FOV = 1.01


@contextlib.contextmanager
def perturbed(name: str | None) -> Iterator[None]:
    """Breaks every scene of this process in one way while the block runs; None: leaves all as it is.

    Raises:
        UnirenderError: no such perturbation.
    """
    if name is None:
        yield
        return
    if name not in PERTURBATIONS:
        raise UnirenderError(f"perturbation: got {name!r}, expected one of {', '.join(PERTURBATIONS)}")
    owner, attribute, changed = PERTURBATIONS[name]()
    original = getattr(owner, attribute)
    setattr(owner, attribute, changed(original))
    try:
        yield
    finally:
        setattr(owner, attribute, original)


Patch = tuple[Any, str, Callable[[Callable[..., Any]], Callable[..., Any]]]


def _roughness() -> Patch:
    def changed(show: Callable[..., Any]) -> Callable[..., Any]:
        def wrong(self: Any, surface: str, values: Any = None, environment: Any = None) -> Any:
            given = dict(values or {})
            if given.get("roughness") is not None:
                given["roughness"] = min(given["roughness"] * MORE_ROUGHNESS, 1.0)
            return show(self, surface, given, environment)

        return wrong

    return EditableScene, "show", changed


def _light_texel() -> Patch:
    def changed(show: Callable[..., Any]) -> Callable[..., Any]:
        def wrong(self: Any, surface: str, values: Any = None, environment: Any = None) -> Any:
            turned = None if environment is None else np.roll(environment, 1, axis=1)
            return show(self, surface, values, turned)

        return wrong

    return EditableScene, "show", changed


def _unwrapped() -> Patch:
    return envmap, "envmap_data", lambda right: lambda environment: right(environment)[:, 1:-1]


def _albedo() -> Patch:
    def changed(bitmap: Callable[..., Any]) -> Callable[..., Any]:
        return lambda albedo: bitmap(np.minimum(np.asarray(albedo, np.float32) * np.float32(MORE_ALBEDO), 1))

    return materials, "base_color_bitmap", changed


def _normals() -> Patch:
    def changed(shape: Callable[..., Any]) -> Callable[..., Any]:
        flip = np.array([-1, 1, 1], np.float32)
        return lambda obj, *rest: shape(dataclasses.replace(obj, normals=obj.normals * flip), *rest)

    return scene, "mesh_shape", changed


def _gamma() -> Patch:
    mi = mitsuba()

    def changed(render: Callable[..., Any]) -> Callable[..., Any]:
        def wrong(*arguments: Any, **options: Any) -> Any:
            picture = np.array(render(*arguments, **options), dtype=np.float32)
            picture[..., :3] = srgb_encode(picture[..., :3])
            return mi.TensorXf(picture)

        return wrong

    return mi, "render", changed


def _fov() -> Patch:
    def changed(sensor: Callable[..., Any]) -> Callable[..., Any]:
        def wrong(*arguments: Any) -> dict[str, Any]:
            right = sensor(*arguments)
            return {**right, "fov": right["fov"] * MORE_FOV}

        return wrong

    return sensors, "sensor_dict", changed


def _metallic() -> Patch:
    def changed(show: Callable[..., Any]) -> Callable[..., Any]:
        def wrong(self: Any, surface: str, values: Any = None, environment: Any = None) -> Any:
            given = dict(values or {})
            if given.get("metallic") is not None:
                given["metallic"] = float(srgb_encode(np.array(given["metallic"], np.float32)))
            return show(self, surface, given, environment)

        return wrong

    return EditableScene, "show", changed


def _bounces() -> Patch:
    return effects, "interreflection_integrator", lambda right: lambda depth: right(DIRECT_DEPTH)


PERTURBATIONS: dict[str, Callable[[], Patch]] = {
    "roughness": _roughness,
    "light-texel": _light_texel,
    "unwrapped": _unwrapped,
    "albedo": _albedo,
    "normals": _normals,
    "gamma": _gamma,
    "fov": _fov,
    "metallic": _metallic,
    "bounces": _bounces,
}
