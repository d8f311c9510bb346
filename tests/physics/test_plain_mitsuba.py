"""The truth against a scene that shares no code with it: Mitsuba reads the OBJ and its textures by its own plugins."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from reference_scenes import environment

from unirender.camera import Camera
from unirender_reference.backend import mitsuba
from unirender_reference.meshes.load import load_mesh_placed
from unirender_reference.passes import Estimate
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject, Sphere
from unirender_reference.statistics import ZTest, z_test

SIZE, SPP, BATCHES = 24, 1024, 16
CAMERA = Camera(50.0, (0.36, 0.57))
TEXTURES = {"map_Kd": (5, 7, 3), "map_Pr": (5, 7), "map_Pm": (5, 7)}
ACROSS, DOWN = 17, 9  # vertices of the ellipsoid


def ellipsoid() -> list[str]:
    """Lines of an OBJ: half axes 1, 0.4 and 0.7, off the origin, cut by a sheet that is seen from both sides."""
    u, v = np.meshgrid(np.linspace(0, 1, ACROSS), np.linspace(0, 1, DOWN))
    theta, phi = np.pi * (1 - v), 2 * np.pi * u
    ball = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], -1)
    sheet = np.array([(-1.2, 0.2, 0.9), (1.2, 0.2, 0.9), (1.2, 0.3, -0.9), (-1.2, 0.3, -0.9)])
    normal = np.cross(sheet[1] - sheet[0], sheet[3] - sheet[0])
    points = np.array([3, -2, 5]) + np.concatenate([(ball * [1, 0.4, 0.7]).reshape(-1, 3), sheet])
    normals = np.concatenate([(ball / [1, 0.4, 0.7]).reshape(-1, 3), np.tile(normal, (4, 1))])
    uv = np.concatenate([np.stack([u, v], -1).reshape(-1, 2), [(0, 0), (1, 0), (1, 1), (0, 1)]])
    index = np.arange(ACROSS * DOWN).reshape(DOWN, ACROSS) + 1
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    last = ACROSS * DOWN
    faces = [*zip(a, b, c, strict=True), *zip(a, c, d, strict=True)]
    faces += [(last + 1, last + 2, last + 3), (last + 1, last + 3, last + 4)]
    arrays = {"v": points, "vt": uv, "vn": normals}
    lines = [f"{key} {' '.join(map(str, row))}" for key, array in arrays.items() for row in array.tolist()]
    return [*lines, *(" ".join(["f", *(f"{i}/{i}/{i}" for i in face)]) for face in faces)]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, rng = tmp_path_factory.mktemp("model"), np.random.default_rng(1)
    for name, shape in TEXTURES.items():
        Image.fromarray(rng.integers(40, 240, shape).astype(np.uint8)).save(folder / f"{name}.png")
    (folder / "m.mtl").write_text("\n".join(["newmtl a", *(f"{name} {name}.png" for name in TEXTURES)]))
    (folder / "m.obj").write_text("\n".join(["mtllib m.mtl", "usemtl a", *ellipsoid()]))
    return folder / "m.obj"


def plain_scene(model: Path, placed: Sphere, camera: Camera, flip: bool) -> Any:
    """The same scene by Mitsuba's plugins; `flip` turns the textures upside down."""
    mi = mitsuba()
    transform = mi.ScalarTransform4f

    def bitmap(name: str, raw: bool) -> dict[str, Any]:
        return {"type": "bitmap", "filename": str(model.with_name(f"{name}.png")), "raw": raw}

    surface = {
        "type": "principled",
        "base_color": bitmap("map_Kd", raw=False),
        "roughness": bitmap("map_Pr", raw=True),
        "metallic": bitmap("map_Pm", raw=True),
    }
    away = 1 / np.sin(np.arctan(0.9 * np.tan(np.radians(camera.fov_deg / 2))))
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    sensor = {
        "type": "perspective",
        "fov": camera.fov_deg,
        "principal_point_offset_x": 0.5 - camera.principal[0],
        "principal_point_offset_y": 0.5 - camera.principal[1],
        "to_world": transform().look_at(origin=[0, 0, float(away)], target=[0, 0, 0], up=[0, 1, 0]),
        "film": {**film, "component_format": "float32"},
        "sampler": {"type": "independent"},
    }
    shape = {
        "type": "obj",
        "filename": str(model),
        "flip_tex_coords": not flip,
        "to_world": transform().scale(1 / placed.radius) @ transform().translate((-placed.center).tolist()),
        "bsdf": {"type": "twosided", "surface": surface},
    }
    light = {"type": "envmap", "bitmap": mi.Bitmap(environment())}
    return mi.load_dict({"type": "scene", "shape": shape, "light": light, "sensor": sensor})


def plain_image(scene: Any) -> Estimate:
    mi = mitsuba()
    path = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    passes = [
        np.array(mi.render(scene, integrator=path, spp=SPP // BATCHES, seed=100 + index)) for index in range(BATCHES)
    ]
    return Estimate(np.mean(passes, axis=0), np.var(passes, axis=0, ddof=1) / BATCHES)


def compared(ours: Estimate, plain: Estimate) -> ZTest:
    """All pixels and alpha: edges count."""
    assert ours.variance is not None
    assert plain.variance is not None
    four = (ours.mean, ours.variance, plain.mean, plain.variance)
    return z_test(*four, batches_a=BATCHES, batches_b=BATCHES, alpha=1e-3, rounding=2e-3)


def test_a_textured_obj_before_an_off_centre_camera_is_that_of_plain_mitsuba(model: Path) -> None:
    """Twins: textures upside down, the other principal point."""
    obj, placed = load_mesh_placed(model)
    ours = rendered(obj, CAMERA)
    plain = plain_image(plain_scene(model, placed, CAMERA, flip=False))
    result = compared(ours, plain)
    assert result.passed, result
    assert not compared(ours, plain_image(plain_scene(model, placed, CAMERA, flip=True))).passed
    assert not compared(rendered(obj, Camera(50.0, (0.64, 0.57))), plain).passed


def rendered(obj: MeshObject, camera: Camera) -> Estimate:
    return Renderer(obj, camera, SIZE).image(environment(), None, None, SPP, seed=5, batches=BATCHES)
