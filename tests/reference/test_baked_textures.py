"""Colours at the corners and pictures without a common lookup: what is seen is what the file says; the rest is kept."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from gltf_files import GltfWriter, bilinear, quad_uv
from PIL import Image

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.bake import baked_tile
from unirender_reference.meshes.surface import Material, Texture
from unirender_reference.meshes.tiles import Patch
from unirender_reference.scene_spec import object_hash
from unirender_reference.shapes import MeshObject

TRIANGLE = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
WEIGHTS = np.random.default_rng(0).dirichlet(np.ones(3), 2000)
CHECKS = np.where(np.random.default_rng(1).random((16, 16, 1)) > 0.5, 255, 20).astype(np.uint8).repeat(3, -1)


def colored_triangle(path: Path, colors: list[list[float]], order: tuple[int, int, int] = (0, 1, 2)) -> MeshObject:
    writer = GltfWriter()
    attributes = {"POSITION": writer.accessor(TRIANGLE), "COLOR_0": writer.accessor(np.array(colors, np.float32))}
    writer.mesh({"attributes": attributes, "indices": writer.accessor(np.array(order, np.uint16))})
    return load_mesh(writer.glb(path / "triangle.glb"))


def worst(obj: MeshObject, colors: list[list[float]], order: tuple[int, int, int] = (0, 1, 2)) -> float:
    """The largest difference between what lookups in the triangle find and its corners' colours, interpolated."""
    assert obj.uv is not None
    (face,) = obj.faces
    found = bilinear(obj.albedo, WEIGHTS @ obj.uv[face].astype(float))
    return float(np.abs(found - WEIGHTS @ np.array(colors)[list(order)]).max())


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_colors_of_the_corners_are_interpolated_from_whatever_corner_a_face_begins(tmp_path, order):
    """From the black corner on, the fourth texel of a block of 2 x 2 would be 2."""
    colors = [[0.0, 0, 0], [1, 1, 1], [1, 1, 1]]
    obj = colored_triangle(tmp_path, colors, order)
    assert obj.albedo.shape == (2, 2, 3)
    assert worst(obj, colors, order) < 1e-4


def test_colors_that_are_clipped_from_every_corner_get_a_larger_block(tmp_path):
    colors = [[0.0, 1, 1], [1, 0, 1], [1, 1, 0]]
    obj = colored_triangle(tmp_path, colors)
    assert obj.albedo.shape[0] > 16
    assert worst(obj, colors) < 0.01


def textured_quad(path: Path, color: float | None, k: int = 8) -> MeshObject:
    """k x k squares with one picture; with a `color` at one corner they are baked."""
    side = np.linspace(-1, 1, k + 1)
    x, y = np.meshgrid(side, side[::-1])
    points = np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(np.float32)
    number = np.arange((k + 1) ** 2).reshape(k + 1, k + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    writer = GltfWriter()
    attributes = {
        "POSITION": writer.accessor(points),
        "TEXCOORD_0": writer.accessor(quad_uv(points[:, :2]).astype(np.float32)),
    }
    if color is not None:
        colors = np.ones((len(points), 3), np.float32)
        colors[0] = color
        attributes["COLOR_0"] = writer.accessor(colors)
    material = writer.material(
        pbrMetallicRoughness={"baseColorTexture": {"index": writer.texture(CHECKS, (33071, 33071))}}
    )
    indices = writer.accessor(faces.astype(np.uint16).reshape(-1))
    writer.mesh({"attributes": attributes, "indices": indices, "material": material})
    return load_mesh(writer.glb(path / "quad.glb"))


def seen(obj: MeshObject, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (x, y) of the quad and the albedo there."""
    assert obj.uv is not None
    weights = np.random.default_rng(seed).dirichlet(np.ones(3), (len(obj.faces), 100))
    uv, points = (np.einsum("mnk,mkc->mnc", weights, part[obj.faces].astype(float)) for part in (obj.uv, obj.vertices))
    return points[..., :2].reshape(-1, 2) * np.sqrt(2), bilinear(obj.albedo, uv.reshape(-1, 2))


def test_a_picture_times_colors_is_the_picture(tmp_path):
    """Sampled once for each texel, as it was, the mean difference is 0.09."""
    obj = textured_quad(tmp_path, 0.9)
    assert obj.provenance["textures_baked"] == "1"
    points, albedo = seen(obj)
    right = bilinear(srgb_decode(CHECKS / np.float32(255)), quad_uv(points), ("clamp", "clamp"))
    far = (points[:, 0] > -0.75) | (points[:, 1] < 0.75)  # from the corner with another colour
    assert np.abs(albedo - right)[far].mean() < 0.003
    assert np.abs(albedo - right)[~far].mean() > 0.003


def test_blocks_take_no_more_room_than_there_is():
    rng = np.random.default_rng(0)
    points = rng.random((50, 3, 3))
    colors = rng.integers(0, 2, (50, 3, 3)).astype(float)  # many are clipped from every corner
    patch = Patch(points, {}, colors, Material({"albedo": np.ones(3, np.float32)}))
    sizes = []
    for texels in (1, 400, 4_000, 40_000):
        tile = baked_tile(patch, texels)
        sizes.append(np.prod(tile.size))
        assert sizes[-1] <= max(texels, 2 * 2 * 8 * 7), "4 for each face at least, in rows of 8"
        assert tile.uv.min() > 0
        assert tile.uv.max() < 1
    assert sizes == sorted(sizes)
    assert sizes[-1] > 10_000


def test_texture_coordinates_that_are_not_finite_are_refused():
    uv = np.random.default_rng(0).random((50, 3, 2))
    uv[7, 1] = np.nan
    texture = Texture(np.ones((8, 8, 3), np.float32))
    patch = Patch(np.zeros((50, 3, 3)), {0: uv}, np.ones((50, 3, 3)), Material({"albedo": texture}))
    with pytest.raises(UnirenderError, match="texture coordinates are not finite"):
        baked_tile(patch, 400)


QUAD_OBJ = """mtllib quad.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 2 0
vt 2 1
vt 0 1
usemtl a
f 1/1 2/2 3/3
usemtl b
f 1/1 3/3 4/4
"""


def obj_file(folder: Path, materials: str) -> Path:
    Image.fromarray(np.where(CHECKS > 128, 255, 0).astype(np.uint8)).save(folder / "checks.png")
    (folder / "quad.mtl").write_text(materials)
    (folder / "quad.obj").write_text(QUAD_OBJ)
    return folder / "quad.obj"


def glb_file(folder: Path, textured: bool) -> Path:
    writer = GltfWriter()
    for shift in (0, 3):
        pbr = {"baseColorFactor": [0.25, 0.5, shift / 4, 1], "roughnessFactor": 0.5, "metallicFactor": 0.25}
        if textured and shift:
            pbr["baseColorTexture"] = {"index": writer.texture(np.where(CHECKS > 128, 255, 0).astype(np.uint8))}
        corners = TRIANGLE[[0, 1, 2, 0]] + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [-1, 2, 0]], np.float32)
        corners = corners + np.array([shift, 0, 0], np.float32)
        writer.mesh(writer.quad(writer.material(pbrMetallicRoughness=pbr), corners))
    return writer.glb(folder / "quads.glb")


KEPT: dict[str, tuple[Callable[[Path], Path], str]] = {
    "constant OBJ": (lambda folder: obj_file(folder, "newmtl a\nKd 1 0 1\nnewmtl b\nKd 0 1 1\n"), "9051e7cab0ba1d5a"),
    "textured OBJ": (
        lambda folder: obj_file(folder, "newmtl a\nmap_Kd checks.png\nnewmtl b\nKd 0 1 1\n"),
        "8fd2bb832810f200",
    ),
    "OBJ with PBR": (
        lambda folder: obj_file(folder, "newmtl a\nmap_Kd checks.png\nPr 0.5\nPm 1\nnewmtl b\n"),
        "12f49779f7b7737f",
    ),
    "constant GLB": (lambda folder: glb_file(folder, False), "f9ccb97747328980"),
    "textured GLB": (lambda folder: glb_file(folder, True), "6f52acf4de351ed3"),
}


@pytest.mark.parametrize("name", KEPT)
def test_what_is_not_baked_keeps_its_bytes(tmp_path, name):
    """The truth of the shipped suites is bound to them. All values here are exact on any machine."""
    write, sha256 = KEPT[name]
    obj = load_mesh(write(tmp_path))
    assert obj.provenance["textures_baked"] == "0"
    assert object_hash(obj)[:16] == sha256
