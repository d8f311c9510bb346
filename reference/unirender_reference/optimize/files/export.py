"""The result on disk: mesh and textures, the light, the same for Mitsuba, and a record.

write_solution(solution, folder)           # mesh.glb, environment.exr, latlong.exr, mitsuba/
mi.load_file("folder/mitsuba/scene.xml")   # the same object under the same light
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from unirender.camera import Camera
from unirender.exr import image_channels, write_environment, write_exr
from unirender.light.for_mitsuba import drawable, pfm_bytes
from unirender.light.resampling import area_pixels
from unirender_reference.optimize.files.glb import glb_bytes, png_bytes, texture_pixels
from unirender_reference.optimize.solution import Solution
from unirender_reference.shapes import MeshObject, Sphere

MESH_FILE, ENVIRONMENT_FILE, LATLONG_FILE = "mesh.glb", "environment.exr", "latlong.exr"
SOLUTION_FILE, MITSUBA_FOLDER = "solution.json", "mitsuba"
FINER = 4  # rows and columns of `LATLONG_FILE` beside those of the light


def write_solution(solution: Solution, folder: Path, place: Sphere | None = None) -> None:
    """Writes mesh, textures and light into an existing folder; equal solutions give equal bytes.

    Args:
        solution: what was found.
        folder: where; files of the same names are replaced.
        place: where the object stands in its own units, for `mesh.glb`; `mitsuba/` keeps to the unit sphere.
    """
    (folder / MESH_FILE).write_bytes(glb_bytes(solution.obj, place))
    write_environment(folder / ENVIRONMENT_FILE, solution.environment, {"object": solution.obj.name})
    write_exr(folder / LATLONG_FILE, image_channels(area_pixels(solution.environment, FINER)), half=False)
    _write_mitsuba(solution, folder / MITSUBA_FOLDER)


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Writes `solution.json`: figures, configuration, provenance."""
    text = json.dumps(record, indent=2, sort_keys=True, default=str)
    (folder / SOLUTION_FILE).write_text(text + "\n", encoding="utf-8")


def _write_mitsuba(solution: Solution, folder: Path) -> None:
    """The object for Mitsuba's XML loader: PLY, PNG textures, the light and the contract's camera."""
    folder.mkdir(exist_ok=True)
    obj, camera = solution.obj, Camera()
    pixels = texture_pixels(obj)
    pictures = {
        "base_color": pixels["base_color"],
        "roughness": pixels["metallic_roughness"][..., 1],
        "metallic": pixels["metallic_roughness"][..., 2],
    }
    pictures |= {"normal": pixels["normal"]} if "normal" in pixels else {}
    for name, values in pictures.items():
        (folder / f"{name}.png").write_bytes(png_bytes(np.ascontiguousarray(values)))
    (folder / "mesh.ply").write_bytes(ply_bytes(obj))
    (folder / "environment.pfm").write_bytes(pfm_bytes(drawable(solution.environment)))
    (folder / "scene.xml").write_text(_SCENE.format(**_scene_values(camera, "normal" in pictures)), encoding="utf-8")


def ply_bytes(obj: MeshObject) -> bytes:
    """Binary PLY with normals and texture coordinates, as Mitsuba's `ply` plugin reads it."""
    assert obj.uv is not None  # texture_pixels has looked
    names = [*(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t"))]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(obj.vertices)}",
        *names,
        f"element face {len(obj.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    corners = np.zeros(len(obj.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    corners["count"], corners["index"] = 3, obj.faces
    vertices = np.concatenate([obj.vertices, obj.normals, obj.uv], axis=1).astype("<f4")
    return "\n".join(header).encode() + vertices.tobytes() + corners.tobytes()


def _scene_values(camera: Camera, normal_map: bool) -> dict[str, str]:
    opened = f'<bsdf type="normalmap">{_texture("normalmap", "normal")}{_UNSHADOWED}' if normal_map else ""
    return {
        "fov": f"{camera.fov_deg:g}",
        "distance": repr(camera.distance()),
        "textures": "".join(map(_texture, ("base_color", "roughness", "metallic"))),
        "open": opened,
        "close": "</bsdf>" if normal_map else "",
    }


def _texture(name: str, file: str | None = None) -> str:
    """A picture of the folder; all but the base colour are stored as they are."""
    raw = "" if name == "base_color" else '<boolean name="raw" value="true"/>'
    return f'<texture name="{name}" type="bitmap"><string name="filename" value="{file or name}.png"/>{raw}</texture>'


_UNSHADOWED = '<boolean name="use_shadowing_function" value="false"/>'
_SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="4"/><boolean name="hide_emitters" value="true"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="{fov}"/>
    <string name="fov_axis" value="y"/>
    <transform name="to_world"><lookat origin="0, 0, {distance}" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm">
      <integer name="width" value="256"/><integer name="height" value="256"/>
      <string name="pixel_format" value="rgba"/><rfilter type="box"/>
    </film>
    <sampler type="multijitter"><integer name="sample_count" value="64"/></sampler>
  </sensor>
  <emitter type="envmap"><string name="filename" value="environment.pfm"/></emitter>
  <shape type="ply">
    <string name="filename" value="mesh.ply"/>
    {open}<bsdf type="twosided"><bsdf type="principled">{textures}</bsdf></bsdf>{close}
  </shape>
</scene>
"""
