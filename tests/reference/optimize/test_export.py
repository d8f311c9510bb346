"""The result on disk, read back by three readers: ours, trimesh and Mitsuba."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from posed_views import textured_object
from reference_scenes import environment

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, image_channels, read_exr, write_exr
from unirender.light.environment import environment_directions, sample_environment
from unirender.light.for_mitsuba import middle_rows
from unirender.light.resampling import area_pixels
from unirender_reference.backend import mitsuba
from unirender_reference.envmap import envmap_data
from unirender_reference.lights import load_light
from unirender_reference.meshes import load_mesh, load_mesh_placed
from unirender_reference.optimize.files.export import FINER, write_solution
from unirender_reference.optimize.files.glb import glb_bytes, texture_pixels
from unirender_reference.optimize.solution import Solution
from unirender_reference.sensors import sensor_dict
from unirender_reference.shapes import MeshObject, Sphere


@pytest.fixture(scope="module")
def solution() -> Solution:
    return Solution(textured_object(3), environment(1))


@pytest.fixture(scope="module")
def folder(solution: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    write_solution(solution, folder)
    return folder


def bilinear(texels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """A lookup that repeats, as Mitsuba's `bitmap` makes it."""
    height, width = texels.shape[:2]
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - left)[:, None], (y - top)[:, None]
    texels = texels.reshape(height, width, -1)
    corner = lambda i, j: texels[(top + i) % height, (left + j) % width]  # noqa: E731 - a name for a formula used four times
    return (corner(0, 0) * (1 - a) + corner(0, 1) * a) * (1 - b) + (corner(1, 0) * (1 - a) + corner(1, 1) * a) * b


def surface_points(obj: MeshObject, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point of each face: position, uv and normal."""
    weights = np.random.default_rng(seed).dirichlet([1, 1, 1], len(obj.faces))[:, :, None]
    assert obj.uv is not None
    position, uv, normal = ((values[obj.faces] * weights).sum(1) for values in (obj.vertices, obj.uv, obj.normals))
    return position, uv, normal


def test_our_reader_sees_the_same_surface(solution: Solution, folder: Path):
    """Faces in order with their corners and normals, and every texel where it was."""
    obj, (back, place) = solution.obj, load_mesh_placed(folder / "mesh.glb")
    (points, uv, normals), (points_back, uv_back, normals_back) = surface_points(obj), surface_points(back)
    np.testing.assert_allclose(points_back * place.radius + place.center, points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(normals_back, normals, rtol=0, atol=1e-3)  # the reader joins corners that are this near
    assert np.abs(srgb_decode(texture_pixels(obj)["base_color"] / 255) - obj.albedo).max() < 1e-6  # on 8-bit steps
    for name in ("albedo", "roughness", "metallic"):
        one, other = bilinear(getattr(obj, name), uv), bilinear(getattr(back, name), uv_back)
        np.testing.assert_allclose(one, other, rtol=0, atol=3e-5)


def test_a_turned_picture_would_not_pass(solution: Solution, folder: Path):
    """The twin: v from the last row, as OBJ has it."""
    back = load_mesh(folder / "mesh.glb")
    (_, uv, _), (_, uv_back, _) = surface_points(solution.obj), surface_points(back)
    flipped = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)
    difference = bilinear(solution.obj.albedo, flipped) - bilinear(back.albedo, uv_back)
    assert np.abs(difference).mean() > 0.05


def test_trimesh_reads_every_texel(solution: Solution, folder: Path):
    scene = trimesh.load_scene(folder / "mesh.glb", process=False)
    (mesh,) = scene.geometry.values()
    obj = solution.obj
    np.testing.assert_array_equal(mesh.vertices, obj.vertices)
    np.testing.assert_array_equal(mesh.faces, obj.faces)
    np.testing.assert_array_equal(mesh.vertex_normals.astype(np.float32), obj.normals)
    assert obj.uv is not None
    np.testing.assert_allclose(mesh.visual.uv * [1, -1] + [0, 1], obj.uv, atol=1e-6)  # trimesh counts v from below
    material, pixels = mesh.visual.material, texture_pixels(obj)
    np.testing.assert_array_equal(np.asarray(material.baseColorTexture), pixels["base_color"])
    np.testing.assert_array_equal(np.asarray(material.metallicRoughnessTexture), pixels["metallic_roughness"])


@pytest.mark.parametrize("name", ["ball", "world"])  # trimesh's own frame is called world
def test_the_object_returns_to_where_its_mesh_stood(solution: Solution, tmp_path: Path, name: str):
    place = Sphere(np.array([10.0, -4.0, 0.5]), 2.5)
    solution = dataclasses.replace(solution, obj=dataclasses.replace(solution.obj, name=name))
    write_solution(solution, tmp_path, place)
    back, found = load_mesh_placed(tmp_path / "mesh.glb")
    points = surface_points(solution.obj)[0] * place.radius + place.center
    np.testing.assert_allclose(surface_points(back)[0] * found.radius + found.center, points, rtol=0, atol=5e-6)


def test_equal_solutions_give_equal_bytes(solution: Solution, folder: Path, tmp_path: Path):
    write_solution(dataclasses.replace(solution), tmp_path)
    for path in sorted(folder.rglob("*.*")):
        assert path.read_bytes() == (tmp_path / path.relative_to(folder)).read_bytes(), path.name


def read_environment(folder: Path) -> np.ndarray:
    return channels_rgb(read_exr(folder / "environment.exr")[0])


def test_light_is_kept_in_full(solution: Solution, folder: Path):
    np.testing.assert_array_equal(read_environment(folder), solution.environment)
    mi = mitsuba()
    loaded = mi.load_dict({"type": "envmap", "filename": str(folder / "environment.exr")})
    np.testing.assert_allclose(np.array(mi.traverse(loaded)["data"])[..., :3], envmap_data(solution.environment))


def test_the_scene_loads_with_one_thread(solution: Solution, folder: Path):
    """Over an EXR Mitsuba hangs then."""
    code = (
        "import sys; from unirender_reference.backend import mitsuba; mi = mitsuba(); import drjit as dr\n"
        "dr.set_thread_count(1); scene = mi.load_file(sys.argv[1])\n"
        "import numpy as np; np.save(sys.argv[2], np.array(mi.traverse(scene.environment())['data']))"
    )
    found = folder / "found.npy"
    command = [sys.executable, "-c", code, str(folder / "mitsuba" / "scene.xml"), str(found)]
    subprocess.run(command, check=True, timeout=60)
    data = np.load(found)
    found.unlink()
    np.testing.assert_array_equal(data[..., :3], envmap_data(solution.environment))


def test_the_map_for_other_programs_is_the_same_light(tmp_path: Path):
    """Read as areas by our own reader; taken for the poles' grid, or turned by a column, it would be off."""
    axes = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.36, 0.48]], np.float32)
    smooth = np.exp(3 * (environment_directions(32, 64) @ axes.T) - 2)
    channels = image_channels(area_pixels(smooth, FINER))
    write_exr(tmp_path / "latlong.exr", channels, half=False)
    found = load_light(tmp_path / "latlong.exr", normalise=False).environment
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    true = sample_environment(smooth, directions)
    errors = [
        float(np.abs(sample_environment(light, directions) - true).max())
        for light in (found, np.stack([channels[c] for c in "RGB"], axis=-1), np.roll(found, 1, axis=1))
    ]
    assert errors[0] < 0.012
    assert min(errors[1:]) > 0.02


@pytest.mark.parametrize("bumpy", [False, True])
def test_mitsuba_renders_the_folder_like_our_scene(solution: Solution, tmp_path: Path, bumpy: bool):
    """The same samples of the same scene: only the 8 bits of the pictures differ (and not even those without bumps)."""
    from unirender_reference import materials
    from unirender_reference.scene import mesh_shape

    obj = solution.obj
    if bumpy:
        x, y = np.meshgrid(np.linspace(-0.4, 0.4, 24), np.linspace(-0.3, 0.3, 24))
        normals = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1).astype(np.float32)
        obj = dataclasses.replace(obj, normal_map=normals)
    write_solution(Solution(obj, solution.environment), tmp_path)
    mi = mitsuba()
    loaded = mi.load_file(str(tmp_path / "mitsuba/scene.xml"))
    assert obj.roughness is not None
    assert obj.metallic is not None
    shape = mesh_shape(obj, materials.principled_bsdf(obj.albedo, obj.roughness, obj.metallic))
    if obj.normal_map is not None:
        shape.set_bsdf(materials.with_normal_map(shape.bsdf(), materials.normal_texture_of(obj.normal_map)))
    light = {"type": "envmap", "bitmap": mi.Bitmap(solution.environment)}
    ours = mi.load_dict({"type": "scene", "light": light, "object": shape})
    sensor = mi.load_dict(sensor_dict(Camera(), 32, 32))
    path = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    images = [np.array(mi.render(s, sensor=sensor, integrator=path, spp=64, seed=1)) for s in (loaded, ours)]
    difference = np.abs(images[0] - images[1])
    assert np.median(images[1][images[1][..., 3] > 0.5]) > 0.05
    assert np.quantile(difference, 0.99) < (0.02 if bumpy else 2e-3)


def test_mitsuba_can_draw_a_light_at_the_pole(solution: Solution, tmp_path: Path):
    light = np.full((16, 32, 3), 0.05, np.float32)
    light[0] = 2000
    write_solution(Solution(solution.obj, light), tmp_path)
    np.testing.assert_array_equal(read_environment(tmp_path), light)
    stored = np.array(mitsuba().Bitmap(str(tmp_path / "mitsuba" / "environment.pfm")))
    np.testing.assert_array_equal(stored, middle_rows(light))


def test_what_lacks_a_texture_is_refused():
    obj = textured_object()
    with pytest.raises(UnirenderError, match="no albedo, roughness or metallic texture"):
        glb_bytes(dataclasses.replace(obj, metallic=None))
