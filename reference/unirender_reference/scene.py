"""Mitsuba scenes of one object: the contract's camera, one environment light, one surface at a time.

World axes are the camera's (+x right, +y up, +z to the viewer) moved to the centre of the object: the camera stands on
the +z axis and looks along -z. An environment in camera axes is therefore Mitsuba's `envmap` without any rotation.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import as_numbers, as_radiance
from unirender.light.for_mitsuba import drawable
from unirender_reference import materials
from unirender_reference.arrays import aligned
from unirender_reference.backend import mitsuba
from unirender_reference.shapes import MeshObject

LIGHT = "light"
OBJECT = "object"
NEAR_CLIP, FAR_CLIP = 0.01, 1e4  # the second is Mitsuba's own
ROTATION_TOLERANCE = 1e-3  # of a pose
MOST_RADIANCE = 1e12  # the sun's luminance is 1.6e9 cd/m^2; squares of far more leave the range of float32


def sensor_dict(camera: Camera, height: int, width: int) -> dict[str, Any]:
    """The pinhole camera at its framing distance, RGBA film, box filter (renders are bit-identical for equal seeds)."""
    mi = mitsuba()
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, camera.distance()], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "perspective",
        "fov": camera.fov_deg,
        "fov_axis": "y",
        **clips(camera.distance()),
        "principal_point_offset_x": 0.5 - camera.principal[0],
        "principal_point_offset_y": 0.5 - camera.principal[1],
        "to_world": to_world,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter"},
    }


def check_pose(pose: Any, name: str = "pose") -> None:
    """Looks at a pose that somebody handed in.

    Raises:
        UnirenderError: it is no (4, 4) matrix of a rotation and a position.
    """
    matrix = as_numbers(name, pose).astype(np.float64)
    matrix = matrix if matrix.shape == (4, 4) and np.isfinite(matrix).all() else np.zeros((4, 4))
    turn, off = matrix[:3, :3], np.abs(matrix[3] - [0, 0, 0, 1]).max()
    if max(off, np.abs(turn.T @ turn - np.eye(3)).max()) >= ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        raise UnirenderError(
            f"{name}: the pose is no rotation and position; expected a (4, 4) camera-to-world matrix without scale or "
            "mirroring, and the position in its last column"
        )


def sensor_at(pose: Float[np.ndarray, "4 4"], camera: Camera, height: int, width: int) -> dict[str, Any]:
    """The contract's sensor, moved to a pose: (4, 4) camera to world.

    Raises:
        UnirenderError: as `check_pose`.
    """
    check_pose(pose)
    mi = mitsuba()
    turned = np.array(pose, np.float64)
    turned[:3, [0, 2]] *= -1  # Mitsuba's camera looks along its +z, with +x to the left
    sensor = sensor_dict(camera, height, width)
    sensor.pop("far_clip", None)
    return {**sensor, **clips(float(np.linalg.norm(turned[:3, 3]))), "to_world": mi.ScalarTransform4f(turned)}


def clips(distance: float) -> dict[str, float]:
    """The depths between which a camera at this distance sees the unit sphere.

    Mitsuba's rays begin at the near one. Cameras that these depths suit keep `NEAR_CLIP` and Mitsuba's own far one,
    so that their pictures stay the same to the bit; inside the sphere there is no better one.
    """
    gap = distance - 1
    found = {"near_clip": gap / 2 if 0 < gap <= NEAR_CLIP else NEAR_CLIP}
    return found if distance + 1 < FAR_CLIP else {**found, "far_clip": 2 * distance}


def mesh_shape(obj: MeshObject, bsdf: Any) -> Any:
    """The object as a Mitsuba mesh with its shading normals and texture coordinates; `bsdf` loaded, or its dict."""
    mi = mitsuba()
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf) if isinstance(bsdf, dict) else bsdf
    mesh = mi.Mesh(
        OBJECT,
        vertex_count=len(obj.vertices),
        face_count=len(obj.faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    uv = np.zeros((len(obj.vertices), 2), np.float32) if obj.uv is None else obj.uv
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(obj.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(obj.normals, np.float32).ravel()
    parameters["vertex_texcoords"] = aligned(uv.astype(np.float32)).ravel()  # read in pairs
    parameters["faces"] = np.ascontiguousarray(obj.faces, np.uint32).ravel()
    parameters.update()
    return mesh


def envmap_data(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w+2 3"]:
    """The environment as Mitsuba's `envmap` parameter stores it (`envmap_rows`): one wrapped column on either side."""
    environment = envmap_rows(environment)
    return np.concatenate([environment[:, -1:], environment, environment[:, :1]], axis=1)


def envmap_rows(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w 3"]:
    """The environment, checked, as Mitsuba can sample it: itself, or with a row between each two (`drawable`).

    Raises:
        UnirenderError: it is too small, black, negative, not finite or above `MOST_RADIANCE`.
    """
    environment = as_radiance("environment", environment)
    if environment.ndim != 3 or environment.shape[-1] != 3 or environment.shape[0] < 3 or environment.shape[1] < 2:
        # Mitsuba resamples smaller maps when it loads them.
        raise UnirenderError(
            f"environment: got shape {environment.shape}, expected (height >= 3, width >= 2, 3); "
            "move the channels last, or resample it (unirender.light.resampling.resample_environment)"
        )
    if not np.isfinite(environment).all() or environment.min() < 0:
        raise UnirenderError(
            "environment: got negative, infinite or NaN radiance, expected finite values >= 0; "
            "np.maximum(light, 0) is what to do with a filter's ringing"
        )
    if environment.max() > MOST_RADIANCE:
        raise UnirenderError(
            f"environment: got radiance up to {environment.max():.3g}, expected at most {MOST_RADIANCE:g}; scale it"
        )
    if environment.max() <= 0:
        raise UnirenderError("environment: all texels are black, expected some light; give another one")
    return drawable(environment)


def object_scene(
    obj: MeshObject,
    bsdf: Any = None,
    environment: Float[np.ndarray, "h w 3"] | None = None,
    sensor: dict[str, Any] | None = None,
) -> Any:
    """A scene of the object.

    Args:
        obj: the mesh.
        bsdf: its surface, loaded or as a dict; None: any, for scenes that rays are only traced in.
        environment: the light (world axes, +y up); None: none.
        sensor: of renders that name no other; None: they all do.
    """
    mi = mitsuba()
    scene: dict[str, Any] = {"type": "scene"}
    if sensor is not None:
        scene["sensor"] = sensor
    if environment is not None:
        bitmap = mi.Bitmap(np.require(envmap_rows(environment), requirements=["C", "W"]))  # writable: it takes no other
        scene[LIGHT] = {"type": "envmap", "bitmap": bitmap}
    scene[OBJECT] = mesh_shape(obj, materials.white_bsdf() if bsdf is None else bsdf)
    return mi.load_dict(scene)


def load_scene(
    obj: MeshObject, bsdf: dict[str, Any], environment: Float[np.ndarray, "h w 3"], camera: Camera, resolution: int
) -> Any:
    """A scene of the object with one surface before the contract's camera, lit by `environment` (camera axes)."""
    return object_scene(obj, bsdf, environment, sensor_dict(camera, resolution, resolution))


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
            data = mitsuba().TensorXf(envmap_data(environment))
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


def parameter_name(parameters: Any, suffix: str) -> str:
    """The full name of the one parameter of a scene that ends in `suffix`.

    Raises:
        UnirenderError: none or several do.
    """
    names = [key for key in parameters.keys() if f".{key}".endswith(f".{suffix}")]  # noqa: SIM118  (iterates over pairs)
    if len(names) != 1:
        raise UnirenderError(f"Mitsuba scene: {len(names)} parameters end in {suffix!r}; an untested Mitsuba version?")
    return names[0]
