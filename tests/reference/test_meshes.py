"""Users' meshes: what is read, in which colour space, and what is refused.

Every file is written here, most of them byte by byte: the loader must not be tested with its own library alone.
"""

import re

import numpy as np
import pytest
import trimesh
from gltf_files import CORNERS, QUAD_FACES, QUAD_UV, GltfWriter
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.limits import texture_side
from unirender_reference.shapes import MeshObject, signed_volume
from unirender_reference.shapes.surface import face_normals

COLORS = {
    "top-left": (255, 0, 0),
    "top-right": (0, 255, 0),
    "bottom-left": (0, 0, 255),
    "bottom-right": (188, 188, 188),
}


def four_colors(size: int = 8) -> Image.Image:
    """Red, green / blue, grey quarters, seen with the first row on top."""
    picture = np.zeros((size, size, 3), np.uint8)
    half = size // 2
    picture[:half, :half], picture[:half, half:] = COLORS["top-left"], COLORS["top-right"]
    picture[half:, :half], picture[half:, half:] = COLORS["bottom-left"], COLORS["bottom-right"]
    return Image.fromarray(picture)


def lookup(obj: MeshObject, x: float, y: float) -> np.ndarray:
    """The albedo at a point of the (scaled) quad, through uv and nearest texel, as a renderer would find it."""
    assert obj.uv is not None
    scale = 1 / np.sqrt(2)
    for face in obj.faces:
        a, b, c = obj.vertices[face][:, :2]
        weights = np.linalg.solve(np.stack([b - a, c - a], 1), np.array([x, y]) * scale - a)
        if weights.min() >= 0 and weights.sum() <= 1:
            uv = np.array([1 - weights.sum(), *weights]) @ obj.uv[face]
            h, w, _ = obj.albedo.shape
            return obj.albedo[int(uv[1] * h), int(uv[0] * w)]
    raise AssertionError("outside the quad")


def assert_four_colors(obj: MeshObject):
    for name, (x, y) in {
        "top-left": (-0.5, 0.6),
        "top-right": (0.5, 0.6),
        "bottom-left": (-0.5, -0.6),
        "bottom-right": (0.5, -0.6),
    }.items():
        linear = srgb_decode(np.array(COLORS[name], np.float32) / 255)
        assert lookup(obj, x, y) == pytest.approx(linear, abs=5e-3), name


def write_textured(path, uv):
    writer = GltfWriter()
    base = {"index": writer.texture(np.asarray(four_colors()))}
    writer.mesh(writer.quad(writer.material(pbrMetallicRoughness={"baseColorTexture": base}), uv=uv))
    return writer.glb(path)


def write_obj(tmp_path, uv, material: str) -> None:
    lines = ["mtllib quad.mtl", *[f"v {x} {y} {z}" for x, y, z in CORNERS], *[f"vt {u} {v}" for u, v in uv]]
    (tmp_path / "quad.obj").write_text("\n".join([*lines, "usemtl m", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4", ""]))
    (tmp_path / "quad.mtl").write_text(f"newmtl m\n{material}\n")


def test_obj_with_texture_counts_v_from_below_and_ignores_kd(tmp_path):
    four_colors().save(tmp_path / "texture.png")
    write_obj(tmp_path, [[0, 0], [1, 0], [1, 1], [0, 1]], "Kd 0.2 0.2 0.2\nmap_Kd texture.png")
    assert_four_colors(load_mesh(tmp_path / "quad.obj"))


def test_obj_kd_is_srgb(tmp_path):
    write_obj(tmp_path, [[0, 0]] * 4, "Kd 0.5 1.0 0.0")
    assert load_mesh(tmp_path / "quad.obj").albedo == pytest.approx([0.214, 1.0, 0.0], abs=3e-3)


def test_repeating_texture_is_unrolled(tmp_path):
    obj = load_mesh(write_textured(tmp_path / "quad.v2.glb", QUAD_UV * 3 - 1))  # nine copies, from -1 to 2
    assert (obj.name, obj.family) == ("quad-v2", "mesh")
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            point = np.array([x, y]) * 2 / 3 + np.array([-1, 1]) / 6  # the red quarter of each copy
            assert lookup(obj, *point) == pytest.approx([1, 0, 0], abs=5e-3)
    far = load_mesh(write_textured(tmp_path / "far.glb", QUAD_UV * 50))
    assert far.provenance["textures_averaged"] == "1"
    assert far.albedo == pytest.approx(load_linear_mean(), abs=5e-3)


def test_textures_are_smaller_where_many_share_the_atlas():
    """A count of texels for all of them together."""
    assert [texture_side(count) for count in (0, 1, 4, 5, 16, 400)] == [1024, 1024, 1024, 915, 512, 102]


def load_linear_mean() -> np.ndarray:
    return srgb_decode(np.asarray(four_colors(), np.float32) / 255).mean((0, 1))


def test_ply_round_trip_with_vertex_colors(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    grey = np.full((len(ball.vertices), 4), 188, np.uint8)
    trimesh.Trimesh(ball.vertices * 7 + 3, ball.faces, vertex_colors=grey, process=False).export(tmp_path / "ball.ply")
    obj = load_mesh(tmp_path / "ball.ply")
    assert obj.albedo == pytest.approx(np.full(3, 0.503), abs=2e-3)
    assert signed_volume(obj.vertices, obj.faces) == pytest.approx(ball.volume, rel=0.03)
    assert (obj.normals * obj.vertices).sum(1).min() > 0.98


def test_scene_graph_is_flattened_and_materials_stay_apart(tmp_path):
    scene = trimesh.Scene()
    for shift, color in ((-1.5, (255, 0, 0)), (1.5, (0, 0, 255))):  # the right one is mirrored by its node
        material = PBRMaterial(baseColorFactor=[*color, 255])
        box = trimesh.creation.box()
        box.visual = TextureVisuals(uv=np.zeros((len(box.vertices), 2)), material=material)
        transform = np.diag([1.0, 1.0, -np.sign(shift), 1.0])
        transform[0, 3] = shift
        scene.add_geometry(box, transform=transform)
    scene.export(tmp_path / "two.glb")
    obj = load_mesh(tmp_path / "two.glb")
    assert obj.provenance["meshes"] == "2"
    assert obj.uv is not None
    h, w, _ = obj.albedo.shape
    color = obj.albedo[(obj.uv[:, 1] * h).astype(int), (obj.uv[:, 0] * w).astype(int)]
    left = obj.vertices[:, 0] < 0
    assert color[left] == pytest.approx(np.tile([1, 0, 0], (left.sum(), 1)), abs=1e-6)
    assert color[~left] == pytest.approx(np.tile([0, 0, 1], ((~left).sum(), 1)), abs=1e-6)
    assert signed_volume(obj.vertices, obj.faces) > 0
    # boxes keep their edges: shading normals are the faces'
    flat = face_normals(obj.vertices, obj.faces)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert np.einsum("ij,ikj->ik", flat, obj.normals[obj.faces]).min() > 0.999


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.obj", None, "no such file"),
        ("mesh.xyz", "1 2 3", "expected one of"),
        ("text.glb", "this is no mesh", "no GLB file"),
        ("points.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
         "end_header\n0 0 0\n", "no faces"),
        ("empty.obj", "# nothing\n", "no faces"),
        ("letter.obj", "Dear reader,\nthis is a letter.\n", "has no faces.* is it an OBJ file"),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no faces.*: 3 lines of v, none of f"),
        ("nan.obj", "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
        ("point.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "zero extent"),
    ],
)  # fmt: skip
def test_errors(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(UnirenderError, match=message):
        load_mesh(tmp_path / name)


CORNER_LINES = ["-1 -1 0", "1 -1 0", "1 1 0", "-1 1 0"]
PURPLE = srgb_decode(np.array([128, 64, 255]) / 255)
OFF_FILES = {  # the header, what stands behind each vertex and each face, the colours, what is ignored
    "whole numbers": ("COFF", " 128 64 255 255", "", PURPLE, ""),
    "floats": ("COFF", " 0.50196 0.25098 1.0", "", PURPLE, ""),
    "floats without points": ("COFF", " 1 0 0 1", "", np.array([1, 0, 0]), ""),
    "nearly black": ("COFF", " 1 0 1 255", "", srgb_decode(np.array([1, 0, 1]) / 255), ""),
    "floats beside an alpha of 255": ("COFF", " 0.50196 0.25098 1.0 255", "", PURPLE, ""),
    "of faces": ("OFF", "", " 128 64 255", PURPLE, ""),
    "none": ("OFF", "", "", np.full(3, 0.5), ""),
    "an index of a table": ("OFF", "", " 3", np.full(3, 0.5), "colours"),
    "words": ("OFF", "", " a b c", np.full(3, 0.5), "colours"),
    "words of vertices": ("COFF", " a b c", "", np.full(3, 0.5), "colours"),
    "not in the header": ("OFF", " 128 64 255", "", np.full(3, 0.5), "colours"),
    "half transparent": ("COFF", " 128 64 255 128", "", PURPLE, "alpha"),
    "half transparent faces": ("OFF", "", " 0.50196 0.25098 1.0 0.5", PURPLE, "alpha"),
    "beside normals": ("NCOFF", " 0 0 1 128 64 255 255", "", PURPLE, ""),
    "before coordinates": ("STCOFF", " 128 64 255 0.5 0.5", "", PURPLE, ""),
}


@pytest.mark.parametrize("kind", OFF_FILES)
def test_colors_of_off_files(tmp_path, kind):
    """They were never read, and nothing said so."""
    head, of_vertex, of_face, expected, ignored = OFF_FILES[kind]
    lines = [head, "4 2 0", *(line + of_vertex for line in CORNER_LINES)]
    lines += ["3 0 1 2" + of_face, "3 0 2 3" + of_face]
    (tmp_path / "a.off").write_text("\n".join(lines) + "\n")
    obj = load_mesh(tmp_path / "a.off")
    assert obj.albedo.reshape(-1, 3) == pytest.approx(
        np.broadcast_to(expected, obj.albedo.reshape(-1, 3).shape), abs=1e-4
    )
    assert obj.provenance["ignored"] == ignored


def write_colored_ply(path, types, color):
    names = ["x", "y", "z", "red", "green", "blue", "alpha"]
    kinds = ["float"] * 3 + types
    head = ["ply", "format ascii 1.0", "element vertex 4"]
    head += [f"property {kind} {name}" for kind, name in zip(kinds, names, strict=False)]
    head += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    path.write_text("\n".join([*head, *(f"{line} {color}" for line in CORNER_LINES), "3 0 1 2", "3 0 2 3"]))
    return path


@pytest.mark.parametrize(
    ("types", "color"),
    [
        (["uchar"] * 3, "128 64 255"),
        (["uchar"] * 3 + ["float"], "128 64 255 1"),
        (["uchar"] * 3 + ["float"], "128 64 255 0.5"),
        (["uchar"] * 4, "128 64 255 255"),
        (["float"] * 3, "128 64 255"),
        (["float"] * 3, "0.50196 0.25098 1.00001"),
        (["ushort"] * 3, "32896 16448 65535"),
        (["ushort"] * 3, "32900 16450 65500"),
    ],
)
def test_colors_of_a_ply_are_in_the_range_of_their_type(tmp_path, types, color):
    """They were white where one number was a float and of 255, and their low bytes where they had 16 bits."""
    obj = load_mesh(write_colored_ply(tmp_path / "a.ply", types, color))
    assert obj.provenance["ignored"] == ("alpha" if color.endswith(" 0.5") else "")
    found = obj.albedo.reshape(-1, 3)
    np.testing.assert_allclose(found, np.broadcast_to(PURPLE, found.shape), rtol=0, atol=2e-3)


def test_colors_of_an_obj_that_miss_one_by_rounding(tmp_path):
    """They counted as of 255: the object was black."""
    lines = [*(f"v {line} 0.50196 0.25098 1.00001" for line in CORNER_LINES), "f 1 2 3 4"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    found = load_mesh(tmp_path / "a.obj").albedo.reshape(-1, 3)
    np.testing.assert_allclose(found, np.broadcast_to(PURPLE, found.shape), rtol=0, atol=1e-4)


def test_stl_that_goes_on_behind_its_facets(tmp_path):
    """It was called a point cloud; colours in the facets were left out, and nothing said so."""
    trimesh.creation.box().export(tmp_path / "a.stl")
    data = (tmp_path / "a.stl").read_bytes()
    (tmp_path / "a.stl").write_bytes(data + bytes(10))
    obj = load_mesh(tmp_path / "a.stl")
    assert (len(obj.faces), obj.provenance["ignored"]) == (12, "")
    (tmp_path / "a.stl").write_bytes(data[:-2] + b"\x1f\x80")
    assert load_mesh(tmp_path / "a.stl").provenance["ignored"] == "attributes of facets"
    (tmp_path / "a.stl").write_bytes(data + data[-50:])
    assert load_mesh(tmp_path / "a.stl").provenance["ignored"] == "facets beyond the count"


@pytest.mark.parametrize("padding", ["in capitals", "a name", "the end", "ends of lines"])
def test_stl_of_words_in_capitals_or_with_zeros(tmp_path, padding):
    """It was taken for a binary one that is cut off; one whose lines end in CR, for none."""
    text = str(trimesh.creation.box().export(file_type="stl_ascii")).upper()
    text = text.replace("\n", "\0\n", 1) if padding == "a name" else text
    text = text.replace("\n", "\r") if padding == "ends of lines" else text
    (tmp_path / "a.stl").write_text(text + "\0" * 4096 * (padding == "the end"), newline="")
    assert len(load_mesh(tmp_path / "a.stl").faces) == 12


@pytest.mark.parametrize(
    "broken", [r"(?<=outer loop)\n", r"\n(?=vertex)", r"\n(?=endloop)", r"(?<=0)\n(?=outer)", r"(?<=endfacet)\n", r"\n"]
)
def test_stl_of_words_whose_lines_end_elsewhere(tmp_path, broken):
    """Everything may stand in one line; a solid may be named by any words."""
    text = re.sub(" *\n *", "\n", str(trimesh.creation.box().export(file_type="stl_ascii"))).strip() + "\n"
    text = re.sub("^(end)?solid.*", r"\1solid facet of a vertex", text, flags=re.MULTILINE)
    named = re.sub(broken, " ", text)
    assert named.count("\n") < text.count("\n")
    (tmp_path / "a.stl").write_text(named, newline="")
    assert len(load_mesh(tmp_path / "a.stl").faces) == 12


def test_solids_of_an_stl_may_have_any_names(tmp_path):
    """A name with the word vertex was taken for a point."""
    text = str(trimesh.creation.box().export(file_type="stl_ascii"))
    named = re.sub("^solid.*", "solid a vertex of a facet", text, flags=re.MULTILINE)
    (tmp_path / "a.stl").write_text(named + "\n" + text.replace("0.5", "1.5"))
    obj = load_mesh(tmp_path / "a.stl")
    assert (len(obj.faces), obj.provenance["meshes"]) == (24, "2")


def test_each_face_of_an_off_file_has_its_color(tmp_path):
    body = "\n".join(["OFF", "4 2 0", *CORNER_LINES, "3 0 1 2 255 0 0", "3 0 2 3 0 0 255 # blue"])
    (tmp_path / "a.off").write_text(body)
    found = {tuple(texel) for texel in load_mesh(tmp_path / "a.off").albedo.reshape(-1, 3).tolist()}
    assert found == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}


def test_normals_of_an_off_file(tmp_path):
    """They were left out, and nothing said so."""
    lines = ["NOFF", "4 2 0", *(line + " 0.6 0 0.8" for line in CORNER_LINES), "3 0 1 2", "3 0 2 3"]
    (tmp_path / "a.off").write_text("\n".join(lines))
    np.testing.assert_allclose(load_mesh(tmp_path / "a.off").normals, [[0.6, 0, 0.8]] * 4, rtol=0, atol=1e-6)


@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), "rgb"])
@pytest.mark.parametrize("binary", [False, True])
def test_names_of_colors_in_ply_files(tmp_path, names, binary):
    form = "binary_little_endian" if binary else "ascii"
    head = [f"ply\nformat {form} 1.0\nelement vertex 4", *(f"property float {axis}" for axis in "xyz")]
    head += [*(f"property uchar {name}" for name in names), "element face 2"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    if binary:
        body = b"".join(point.tobytes() + bytes([128, 64, 255]) for point in CORNERS)
        body += b"".join(b"\3" + face.astype("<i4").tobytes() for face in QUAD_FACES.reshape(2, 3))
    else:
        body = "\n".join([*(f"{line} 128 64 255" for line in CORNER_LINES), "3 0 1 2", "3 0 2 3", ""]).encode()
    (tmp_path / "a.ply").write_bytes("\n".join(head).encode() + body)
    albedo = load_mesh(tmp_path / "a.ply").albedo.reshape(-1, 3)
    assert albedo == pytest.approx(np.broadcast_to(PURPLE, albedo.shape), abs=1e-4)
