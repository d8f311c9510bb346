"""Mitsuba scenes of one object: the contract's camera, one environment light, one surface.

World axes are the camera's (+x right, +y up, +z to the viewer) moved to the centre of the object: the camera stands on
the +z axis and looks along -z. An environment in camera axes is therefore Mitsuba's `envmap` without any rotation.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba
from unirender_reference.shapes import MeshObject

LIGHT = "light"
OBJECT = "object"


def sensor_dict(camera: Camera, height: int, width: int) -> dict[str, Any]:
    """The pinhole camera at its framing distance, RGBA film, box filter (renders are bit-identical for equal seeds)."""
    mi = mitsuba()
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, camera.distance()], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "perspective",
        "fov": camera.fov_deg,
        "fov_axis": "y",
        "near_clip": 0.01,
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


def mesh_shape(obj: MeshObject, bsdf: dict[str, Any]) -> Any:
    """The object as a Mitsuba mesh with its shading normals and texture coordinates."""
    mi = mitsuba()
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
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
    parameters["vertex_texcoords"] = np.ascontiguousarray(uv, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(obj.faces, np.uint32).ravel()
    parameters.update()
    return mesh


def envmap_data(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w+2 3"]:
    """The environment as Mitsuba's `envmap` parameter stores it: one wrapped column on either side."""
    environment = np.asarray(environment, dtype=np.float32)
    if environment.ndim != 3 or environment.shape[-1] != 3 or environment.shape[0] < 3 or environment.shape[1] < 2:
        # Mitsuba resamples smaller maps when it loads them.
        raise UnirenderError(f"environment: got shape {environment.shape}, expected (height >= 3, width >= 2, 3)")
    if not np.isfinite(environment).all() or environment.min() < 0:
        raise UnirenderError("environment: got negative, infinite or NaN radiance, expected finite values >= 0")
    if environment.max() <= 0:
        raise UnirenderError("environment: all texels are black, expected some light")
    return np.concatenate([environment[:, -1:], environment, environment[:, :1]], axis=1)


def load_scene(
    obj: MeshObject, bsdf: dict[str, Any], environment: Float[np.ndarray, "h w 3"], camera: Camera, resolution: int
) -> Any:
    """A scene of the object with one surface, lit by `environment` (camera axes, +y up)."""
    mi = mitsuba()
    envmap_data(environment)  # checks
    light = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(environment, np.float32))}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor_dict(camera, resolution, resolution),
            LIGHT: light,
            OBJECT: mesh_shape(obj, bsdf),
        }
    )
