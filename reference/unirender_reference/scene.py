"""Mitsuba scenes of one object before the contract's camera, with one surface under one environment light.

World axes are the camera's (+x right, +y up, +z to the viewer) moved to the centre of the object: the camera stands on
the +z axis and looks along -z. An environment in camera axes is therefore Mitsuba's `envmap` without any rotation.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference import materials, sensors
from unirender_reference.arrays import aligned
from unirender_reference.backend import mitsuba
from unirender_reference.envmap import envmap_rows
from unirender_reference.shapes import MeshObject

LIGHT = "light"
OBJECT = "object"


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
    return object_scene(obj, bsdf, environment, sensors.sensor_dict(camera, resolution, resolution))


def parameter_name(parameters: Any, suffix: str) -> str:
    """The full name of the one parameter of a scene that ends in `suffix`.

    Raises:
        UnirenderError: none or several do.
    """
    names = [key for key in parameters.keys() if f".{key}".endswith(f".{suffix}")]  # noqa: SIM118  (iterates over pairs)
    if len(names) != 1:
        raise UnirenderError(f"Mitsuba scene: {len(names)} parameters end in {suffix!r}; an untested Mitsuba version?")
    return names[0]
