"""OBJ and MTL files: polygons, indices, options of maps, the PBR keywords."""

import codecs
import struct

import numpy as np
import pytest
import trimesh
from gltf_files import bilinear, png, quad_uv, random_pixels
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.mtl import parse_mtl
from unirender_reference.scene_spec import object_hash
from unirender_reference.shapes import MeshObject, signed_volume

QUAD = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
POINTS = np.random.default_rng(0).uniform(-0.95, 0.95, (40, 2))


def write(tmp_path, material: str, faces: str = "f 1/1 2/2 3/3 4/4", head: str = QUAD):
    (tmp_path / "quad.obj").write_text(f"mtllib my materials.mtl\n{head}usemtl red paint\n{faces}\n")
    (tmp_path / "my materials.mtl").write_text(f"newmtl red paint\n{material}\n")
    return load_mesh(tmp_path / "quad.obj")


def shown(obj: MeshObject, texels: np.ndarray | None) -> np.ndarray:
    """A map at the points, through the uv of the quad's corners (it is affine over a quad)."""
    assert obj.uv is not None
    assert texels is not None
    design = np.column_stack([obj.vertices[:, :2] * np.sqrt(2), np.ones(len(obj.vertices))])
    affine = np.linalg.lstsq(design, obj.uv.astype(float), rcond=None)[0]
    uv = np.column_stack([POINTS, np.ones(len(POINTS))]) @ affine
    return bilinear(texels if texels.ndim == 3 else texels[..., None], uv)


def test_no_pbr_keywords_no_maps(tmp_path):
    obj = write(tmp_path, "Kd 0.5 0.5 0.5\nNs 100\nKs 1 1 1")
    assert obj.roughness is None
    assert obj.metallic is None
    assert obj.uv is None


def test_lines_points_and_curves_are_listed(tmp_path):
    """Nothing said that they are left out."""
    obj = write(tmp_path, "Kd 0.5 0.5 0.5", "f 1/1 2/2 3/3 4/4\nl 1 2 3\np 1\ncurv 0 1 1 2")
    assert obj.provenance["ignored"] == "curves and their surfaces, points and lines"


def test_pbr_keywords(tmp_path):
    pictures = {name: random_pixels(i, 8, 8) for i, name in enumerate(("color", "rough", "metal", "bumps"))}
    pictures["bumps"][..., 2] = 255
    for name in ("rough", "metal"):
        pictures[name][..., 1:] = pictures[name][..., :1]
    for name, pixels in pictures.items():
        (tmp_path / f"{name} map.png").write_bytes(png(pixels))
    lines = "map_Kd color map.png\nPr 0.9\nmap_Pr rough map.png\nmap_Pm metal map.png\nnorm -bm 0.5 bumps map.png"
    obj = write(tmp_path, lines)
    uv = quad_uv(POINTS)
    assert shown(obj, obj.albedo) == pytest.approx(bilinear(srgb_decode(pictures["color"] / 255), uv), abs=2e-5)
    assert shown(obj, obj.roughness) == pytest.approx(bilinear(pictures["rough"][..., :1] / 255, uv), abs=2e-5)
    assert shown(obj, obj.metallic) == pytest.approx(bilinear(pictures["metal"][..., :1] / 255, uv), abs=2e-5)
    assert obj.normal_map is not None
    tilt = (pictures["bumps"] / 255 * 2 - 1) * [0.5, 0.5, 1]
    tilt /= np.linalg.norm(tilt, axis=-1, keepdims=True)
    assert obj.normal_map[1:-1, 1:-1] == pytest.approx(tilt, abs=1e-5)


def test_a_library_whose_materials_no_face_uses_may_be_missing(tmp_path):
    (tmp_path / "here.mtl").write_text("newmtl red\nKd 1 0 0\n")
    model = tmp_path / "quad.obj"
    for libraries in ("mtllib here.mtl\nmtllib gone.mtl\n", "mtllib gone.mtl here.mtl\n"):
        model.write_text(f"{libraries}{QUAD}usemtl red\nf 1 2 3 4\n")
        assert load_mesh(model).albedo == pytest.approx([1, 0, 0])
        model.write_text(f"{libraries}{QUAD}usemtl blue\nf 1 2 3 4\n")  # which may stand in the other one
        with pytest.raises(UnirenderError, match=r"material library 'gone\.mtl' is missing"):
            load_mesh(model)


def test_a_packed_picture_says_which_channel_counts(tmp_path):
    """The first one did, of occlusion, roughness and metallic in one picture, whatever `-imfchan` said."""
    (tmp_path / "orm.png").write_bytes(png(np.full((4, 4, 3), (250, 100, 30), np.uint8)))
    obj = write(tmp_path, "map_Pr -imfchan g orm.png\nmap_Pm -imfchan B -mm 0 0.5 orm.png")
    assert obj.roughness == pytest.approx(np.full((6, 6), 100 / 255), abs=1e-6)
    assert obj.metallic == pytest.approx(np.full((6, 6), 30 / 255), abs=1e-6)
    assert obj.provenance["ignored"] == "-mm of a map"
    obj = write(tmp_path, "Pc 0.5\nPs 0\nmap_Pr -mm 0 1 -imfchan l orm.png")
    assert obj.roughness is not None
    assert obj.roughness[0, 0] == pytest.approx((0.2126 * 250 + 0.7152 * 100 + 0.0722 * 30) / 255, abs=1e-6)
    assert obj.provenance["ignored"] == "clearcoat"
    with pytest.raises(UnirenderError, match=r"texture 'orm\.png' of metallic: got -imfchan z"):
        write(tmp_path, "map_Pm -imfchan z orm.png")


def test_a_map_in_colour_that_names_no_channel_counts_by_its_luminance(tmp_path):
    """As the format has it; that the file is in colour is told, since it may be a packed one."""
    (tmp_path / "orm.png").write_bytes(png(np.full((4, 4, 3), (250, 100, 30), np.uint8)))
    obj = write(tmp_path, "map_Pm orm.png")
    assert obj.metallic is not None
    assert obj.metallic[0, 0] == pytest.approx((0.2126 * 250 + 0.7152 * 100 + 0.0722 * 30) / 255, abs=1e-6)
    assert obj.provenance["ignored"] == "colour of a map of metallic"


def test_normals_of_a_map_that_point_into_the_surface_count_as_flat(tmp_path):
    """Under an even light such a surface reflected twice the light that there is."""
    pixels = np.full((4, 4, 3), (128, 128, 255), np.uint8)
    pixels[:, 2:] = 0  # black around a chart
    pixels[0, 0] = 255, 128, 127  # along the surface, rounded
    (tmp_path / "bumps.png").write_bytes(png(pixels))
    obj = write(tmp_path, "norm bumps.png")
    assert obj.provenance["ignored"] == "normals into the surface"
    assert obj.normal_map is not None
    assert obj.normal_map[..., 2].min() == pytest.approx(-1 / 255, abs=1e-3)
    assert (obj.normal_map[..., 2] > 0.99).mean() > 0.8
    pixels[:, 2:] = 128, 128, 255
    (tmp_path / "bumps.png").write_bytes(png(pixels))
    assert write(tmp_path, "norm bumps.png").provenance["ignored"] == ""


def test_pbr_values_and_their_defaults(tmp_path):
    obj = write(tmp_path, "Kd 1 1 1\nPr 0.25")
    assert obj.roughness == pytest.approx(np.full((2, 2), 0.25))
    assert obj.metallic == pytest.approx(np.zeros((2, 2)))


def test_map_options(tmp_path):
    pixels = random_pixels(5, 4, 4)
    (tmp_path / "a.png").write_bytes(png(pixels))
    obj = write(tmp_path, "map_Kd -clamp on -s 2 0.5 1 -o 0.25 -0.1 a.png")
    u, v_up = quad_uv(POINTS)[:, 0] * 2 + 0.25, (1 - quad_uv(POINTS)[:, 1]) * 0.5 - 0.1
    expected = bilinear(srgb_decode(pixels / 255), np.column_stack([u, 1 - v_up]), ("clamp", "clamp"))
    assert shown(obj, obj.albedo) == pytest.approx(expected, abs=2e-5)


def test_parse_mtl_reads_names_and_options():
    entries = parse_mtl("newmtl a b\nmap_Kd -o 1 -s 2 2 my wood 2.png\nKd 0.1 0.2 0.3\nmap_bump x.png\nKd spectral x\n")
    assert entries["a b"].maps["albedo"] == ("my wood 2.png", {"-o": ["1"], "-s": ["2", "2"]})
    assert entries["a b"].numbers["kd"] == [0.1, 0.2, 0.3]
    assert entries["a b"].ignored == {"bump", "kd spectral x"}


def test_polygons_relative_indices_and_continued_lines(tmp_path):
    """A pentagon, a triangle by negative indices in the middle of the file, a line that goes on."""
    pentagon = "v 0 0 0\nv 2 0 0\nv 3 1 0\nv 1 2 0\nv -1 1 0\nf 1 2 3 \\\n 4 5\n"
    (tmp_path / "a.obj").write_text(pentagon + "v 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 -2 -1\nv 9 9 9\n")
    obj = load_mesh(tmp_path / "a.obj")
    assert len(obj.faces) == 4
    a, b, c = np.moveaxis(obj.vertices[obj.faces].astype(float), 1, 0)
    area = np.cross(b - a, c - a)[:, 2] / 2
    assert area[:3].sum() / area[3] == pytest.approx(5 / 0.5, rel=1e-5)  # pentagon by the shoelace formula: 5
    assert area.min() > 0


def test_vertex_colors_of_an_obj_are_srgb(tmp_path):
    (tmp_path / "a.obj").write_text(
        "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nv 0 0 1 0.5 0.5 0.5\nf 1 2 3\nf 1 2 4\n"
    )
    obj = load_mesh(tmp_path / "a.obj")
    assert obj.uv is not None
    h, w, _ = obj.albedo.shape
    texel = obj.albedo[(obj.uv[:, 1] * h).astype(int), (obj.uv[:, 0] * w).astype(int)]
    grey = obj.vertices[:, 2] > obj.vertices[:, 2].max() - 1e-3
    assert texel[grey] == pytest.approx(np.full((grey.sum(), 3), 0.214), abs=1e-3)
    assert texel[~grey] == pytest.approx(np.tile([1, 0, 0], ((~grey).sum(), 1)), abs=1e-6)


def test_two_materials_share_an_atlas(tmp_path):
    (tmp_path / "a.png").write_bytes(png(random_pixels(1, 4, 4)))
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd a.png\nnewmtl b\nKd 1 1 0\n")
    text = QUAD + "v 4 0 0\nmtllib m.mtl\nusemtl a\nf 1/1 2/2 3/3 4/4\nusemtl b\nf 2 5 3\n"
    (tmp_path / "a.obj").write_text(text)
    obj = load_mesh(tmp_path / "a.obj")
    assert obj.uv is not None
    h, w, _ = obj.albedo.shape
    tip = obj.vertices[:, 0].argmax()
    assert obj.albedo[int(obj.uv[tip, 1] * h), int(obj.uv[tip, 0] * w)] == pytest.approx([1, 1, 0])


def test_same_geometry_as_trimesh(tmp_path):
    """Another implementation: areas, volume and colours of a sphere with a picture."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    uv = np.random.default_rng(2).random((len(ball.vertices), 2))
    picture = Image.fromarray(random_pixels(3, 8, 8))
    ball.visual = TextureVisuals(uv=uv, material=SimpleMaterial(image=picture))
    ball.export(tmp_path / "ball.obj")
    obj = load_mesh(tmp_path / "ball.obj")
    assert len(obj.faces) == len(ball.faces)
    assert signed_volume(obj.vertices, obj.faces) == pytest.approx(ball.volume, rel=0.02)
    assert obj.albedo[1:-1, 1:-1] == pytest.approx(srgb_decode(np.asarray(picture) / 255), abs=1e-5)


def test_faces_on_each_other_are_one(tmp_path):
    """A sheet that is written for both sides, the second time with broken normals; its edge neighbour stays."""
    normals = "vn 0 0 1\nvn 0 1 0\n"
    faces = "f 1//1 2//1 3//1\nf 3//2 2//2 1//2\nf 1//1 3//1 4//1"
    obj = write(tmp_path, "Kd 1 1 1", faces, QUAD + normals)
    assert len(obj.faces) == 2
    assert obj.provenance["double_faces"] == "1"
    assert obj.normals == pytest.approx(np.tile([0, 0, 1], (len(obj.normals), 1)))


@pytest.mark.parametrize("back", ["f 4 3 2 1", "f 1 4 3 2", "f 4 3 2\nf 4 2 1"])
def test_a_quadrangle_of_two_materials_is_the_first_one(tmp_path, back):
    """Front and back as modelling programs write them, whichever diagonals they are cut along."""
    (tmp_path / "m.mtl").write_text("newmtl front\nKd 1 0 0\nnewmtl back\nKd 0 0 1\n")
    lines = ["mtllib m.mtl", "v -1 -1 0", "v 1 -1 0.5", "v 1 1 0.5", "v -1 1 0", "v 0 0 2"]
    path = tmp_path / "m.obj"
    path.write_text("\n".join([*lines, "usemtl front", "f 1 2 3 4", "usemtl back", back, ""]))
    obj = load_mesh(path)
    assert obj.provenance["double_faces"] == "2"
    assert obj.albedo == pytest.approx([1, 0, 0])
    path.write_text("\n".join([*lines, "usemtl front", "f 1 2 3 4", "usemtl back", "f 2 3 4", "f 4 2 5", ""]))
    assert load_mesh(path).provenance["double_faces"] == "0", "one half alone is no double"
    bent = "\n".join([*lines, "usemtl front", "f 1 2 3 4", "usemtl back", back, ""]).replace("v -1 1 0", "v -1 1 0.1")
    path.write_text(bent)
    as_triangles = back.count("f") > 1
    assert load_mesh(path).provenance["double_faces"] == ("0" if as_triangles else "2"), "a bent one, cut twice, is two"


@pytest.mark.parametrize("start", range(5))
def test_both_sides_of_a_polygon_are_one_whichever_corner_they_begin_with(tmp_path, start):
    """In one material; twin: a polygon that has one other corner stays."""
    corners = "v 0 0 0\nv 2 0 0\nv 3 1 0\nv 2 2 0\nv 0 2 0\nv 4 1 0\n"
    back = " ".join(str((start - k) % 5 + 1) for k in range(5))
    obj = write(tmp_path, "Kd 1 1 1", f"f 1 2 3 4 5\nf {back}", corners)
    assert (len(obj.faces), obj.provenance["double_faces"]) == (3, "3")
    other = write(tmp_path, "Kd 1 1 1", f"f 1 2 3 4 5\nf {back.replace('3', '6')}", corners)
    assert len(other.faces) > 3


@pytest.mark.parametrize("start", range(8))
def test_both_sides_of_a_concave_polygon_are_one(tmp_path, start):
    """A U, whose cut the corner decides that it begins with."""
    corners = "".join(f"v {x} {y} 0\n" for x, y in ((0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)))
    one = " ".join(str((start + k) % 8 + 1) for k in range(8))
    for begin in range(8):
        back = " ".join(str((begin - k) % 8 + 1) for k in range(8))
        obj = write(tmp_path, "Kd 1 1 1", f"f {one}\nf {back}", corners)
        assert (len(obj.faces), obj.provenance["double_faces"]) == (6, "6")


def test_maps_that_say_how_a_surface_shines_are_listed(tmp_path):
    """What Blender writes roughness and metallic into without its PBR keywords, and packed maps by their own name."""
    maps = "map_Ks s.png\nmap_Ns n.png\nrefl -type sphere r.png\nmap_RMA p.png\nmap_Ka a.png\nmap_aat on"
    assert write(tmp_path, maps).provenance["ignored"] == "gloss, map_rma, reflection, specular"


def test_faces_without_texture_coordinates_leave_the_others_theirs(tmp_path):
    """One face without `vt` made the texture of the whole material its mean."""
    (tmp_path / "a.png").write_bytes(png(random_pixels(1, 4, 4)))
    faces = "f 1/1 2/2 3/3 4/4\nf 1 2 5\nvt nan 0\nf 1/1 2/2 5/5"
    mixed = write(tmp_path, "map_Kd a.png", faces, QUAD + "v 0 0 2\n")
    whole = write(tmp_path, "map_Kd a.png")
    uv = mixed.uv
    assert uv is not None
    assert "textures of faces without coordinates" in mixed.provenance["ignored"]
    assert whole.provenance["ignored"] == ""
    h, w, _ = mixed.albedo.shape
    texels = mixed.albedo[(uv[:, 1] * h).astype(int), (uv[:, 0] * w).astype(int)]
    tip = mixed.vertices[:, 2] > mixed.vertices[:, 2].min() + 0.1
    mean = srgb_decode(random_pixels(1, 4, 4) / 255).mean((0, 1))
    assert texels[tip] == pytest.approx(np.tile(mean, (tip.sum(), 1)), abs=1e-5)
    shown_texels = {tuple(texel) for texel in np.round(mixed.albedo.reshape(-1, 3), 4)}
    assert {tuple(texel) for texel in np.round(whole.albedo.reshape(-1, 3), 4)} <= shown_texels


def test_faces_without_normals_leave_the_others_theirs(tmp_path):
    tilted = "vn 0.6 0 0.8\n"
    obj = write(tmp_path, "Kd 1 1 1", "f 1//1 2//1 3//1\nf 1 3 4", QUAD + tilted)
    turned = np.isclose(obj.normals, [0.6, 0, 0.8], atol=1e-6).all(-1)
    assert turned.sum() == 3
    assert obj.normals[~turned] == pytest.approx(np.tile([0, 0, 1], ((~turned).sum(), 1)))


@pytest.mark.parametrize("lacking", ["coordinates", "colours"])
def test_faces_smooth_across_what_some_of_them_lack(tmp_path, lacking):
    """Faces without `vt` or a colour were a piece of their own, and a crease ran around it."""
    (tmp_path / "a.png").write_bytes(png(random_pixels(1, 4, 4)))
    sphere = trimesh.creation.icosphere(2)
    points = sphere.vertices.tolist()

    def normals(some: bool) -> np.ndarray:
        """Of each point."""
        color = [" 1 0 0" if not some or i % 7 else "" for i in range(len(points))] if lacking == "colours" else None
        head = [f"v {x} {y} {z}{color[i] if color else ''}" for i, (x, y, z) in enumerate(points)]
        head += [f"vt {x} {y}" for x, y, _ in points]
        faces = [
            "f " + " ".join(f"{v}/{v}" if not some or i % 7 or color else f"{v}" for v in face)
            for i, face in enumerate((sphere.faces + 1).tolist())
        ]
        material = "Kd 1 1 1" if color else "map_Kd a.png"
        obj = write(tmp_path, material, "\n".join(faces), "\n".join(head) + "\n")
        assert (obj.provenance["meshes"], bool(obj.provenance["ignored"])) == (("2", True) if some else ("1", False))
        radial = obj.vertices / np.linalg.norm(obj.vertices, axis=1, keepdims=True)
        at = np.argmax(radial @ sphere.vertices.T, axis=1)
        own = np.full((len(points), 3), np.nan)
        own[at] = obj.normals
        assert own[at] == pytest.approx(obj.normals, abs=1e-5)  # one normal at each point
        return own

    assert normals(True) == pytest.approx(normals(False), abs=1e-5)


@pytest.mark.parametrize("written", ["\r", "\r\n", "\r and others", "tab", "bom"])
def test_line_ends_tabs_and_a_byte_order_mark(tmp_path, written):
    """Keywords behind a byte order mark or before a tab were passed over, and files with CR alone were one line."""

    def spelled(text: str) -> bytes:
        if written == "tab":
            text = "".join(line.replace(" ", "\t", 1) for line in text.splitlines(keepends=True))
        ends = {"\r": ["\r"], "\r\n": ["\r\n"], "\r and others": ["\r", "\r\n", "\n"]}.get(written, ["\n"])
        text = "".join(line + ends[i % len(ends)] for i, line in enumerate(text.splitlines()))
        return (codecs.BOM_UTF8 if written == "bom" else b"") + text.encode()

    (tmp_path / "a.png").write_bytes(png(random_pixels(1, 4, 4)))
    mtl, obj = "newmtl a\nmap_Kd -s 2 2 1 a.png\nPr 0.3\n", f"mtllib a.mtl\n{QUAD}usemtl a\nf 1/1 2/2 3/3 4/4\n"
    loaded = []
    for spell in (str.encode, spelled):
        (tmp_path / "a.mtl").write_bytes(spell(mtl))
        (tmp_path / "a.obj").write_bytes(spell(obj))
        loaded.append(load_mesh(tmp_path / "a.obj"))
    assert object_hash(loaded[0]) == object_hash(loaded[1])
    assert loaded[1].roughness is not None


@pytest.mark.parametrize(
    ("material", "ignored"), [("Tr 0.7", "alpha"), ("Tr 0", ""), ("d 1\nTr 1", ""), ("d 0.5", "alpha")]
)
def test_transparency_is_ignored_and_said(tmp_path, material, ignored):
    assert write(tmp_path, material).provenance["ignored"] == ignored


def test_an_unknown_option_of_a_map_is_named(tmp_path):
    (tmp_path / "a.png").write_bytes(png(random_pixels(1, 4, 4)))
    with pytest.raises(UnirenderError, match=r"option '-colorspace', which is not known here"):
        write(tmp_path, "map_Kd -colorspace sRGB a.png")
    (tmp_path / "-a b.png").write_bytes(png(random_pixels(1, 4, 4)))
    obj = write(tmp_path, "map_Kd -a b.png")
    assert shown(obj, obj.albedo).std() > 0


def test_a_vertex_without_a_colour_leaves_the_other_faces_theirs(tmp_path):
    """A face with a corner that has none gets `Kd`, here the grey of a mesh without any; both are said."""
    red = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\n"
    (tmp_path / "a.obj").write_text(red + "v 0 0 1\nf 1 2 3\nf 1 2 4\n")
    obj = load_mesh(tmp_path / "a.obj")
    assert obj.provenance["ignored"] == "colours of faces with a bare corner"
    assert obj.uv is not None
    h, w, _ = obj.albedo.shape
    texels = obj.albedo[(obj.uv[:, 1] * h).astype(int), (obj.uv[:, 0] * w).astype(int)]
    upper = obj.vertices[:, 2] > obj.vertices[:, 2].max() - 1e-3
    assert texels[upper] == pytest.approx(np.full((upper.sum(), 3), 0.5))
    assert (np.abs(texels - [1, 0, 0]).max(-1) < 1e-6).sum() == 3


TIFFS = {
    "float": (np.float32, 0.25, 0.25),
    "16 bits in 32": (np.int32, 16384, 0.25),
    "31 bits": (np.int32, 1 << 29, 0.25),
    "a negative number": (np.int32, -1, r"got numbers from -1, expected 0 and more"),
    "a float rounded up": (np.float32, 1.0000001, 1.0),
    "a float of resampling": (np.float32, -1e-4, 0.0),
    "a float above 1": (np.float32, 1.5, r"got floats from 1.5 to 1.5, expected \[0, 1\]"),
    "a float a little above 1": (np.float32, 1 + 2**-9, r"got floats from 1.00195312 to 1.00195312, expected"),
    "a float below 0": (np.float32, -(2**-9), r"got floats from -0.00195312"),
    "no number": (np.float32, np.nan, r"got floats from nan"),
}


@pytest.mark.parametrize("kind", TIFFS)
def test_tiff_of_floats_and_of_32_bits(tmp_path, kind):
    """Pillow clips them to 8 bits: floats were 0 or 1, whole numbers 1."""
    dtype, value, expected = TIFFS[kind]
    Image.fromarray(np.full((4, 4), value, dtype)).save(tmp_path / "a.tiff")
    if isinstance(expected, str):
        with pytest.raises(UnirenderError, match=expected):
            write(tmp_path, "map_Pr a.tiff")
        return
    obj = write(tmp_path, "map_Pr a.tiff")
    assert obj.roughness is not None
    assert obj.roughness == pytest.approx(np.full_like(obj.roughness, expected), abs=0.5 / 255 + 1e-6)


WHOLE_NUMBERS = [(1, 32, 1, 1 << 30), (1, 16, 1, 1 << 14), (2, 16, 1, 1 << 13), (1, 8, 1, 64), (1, 12, 1, 1 << 10)]
WHITE_IS_ZERO = [(1, 16, 0, 0xBFFF), (1, 8, 0, 191), (3, 32, 0, 0x3F400000)]  # the last is 0.75 in float32


@pytest.mark.parametrize(("kind", "bits", "black", "value"), WHOLE_NUMBERS + WHITE_IS_ZERO)
def test_tiff_of_whole_numbers(tmp_path, kind, bits, black, value):
    """4 x 4 texels of a quarter, byte by byte; kind 1 has no sign, 2 has one, 3 is floats; black 0: 0 is white."""
    entries = [(256, 4, 4), (257, 4, 4), (258, 3, bits), (259, 3, 1), (262, 3, black), (273, 4, 134), (277, 3, 1)]
    entries += [(278, 4, 4), (279, 4, 2 * bits), (339, 3, kind)]
    body = b"".join(struct.pack("<HHII", tag, form, 1, number) for tag, form, number in entries)
    texels = struct.pack(">Q", value << 12 | value)[-3:] * 8 if bits == 12 else value.to_bytes(bits // 8, "little") * 16
    (tmp_path / "a.tiff").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + b"\0" * 4 + texels)
    obj = write(tmp_path, "map_Pr a.tiff")
    assert obj.roughness is not None
    assert obj.roughness == pytest.approx(np.full_like(obj.roughness, 0.25), abs=0.5 / 255 + 1e-6)


def test_comments_behind_numbers(tmp_path):
    """The line was refused, where its words counted as numbers; the name of a material may hold the sign."""
    text = "v 0 0 0 # the lower left\nv 1 0 0\nv 0 1 0\nvt 0 # left\nvn 0 0 1#up\nusemtl #1\nf 1/1/1 2/1/1 3/1/1 # f\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{text}")
    (tmp_path / "a.mtl").write_text("newmtl #1\nKd 0 1 0\n")
    obj = load_mesh(tmp_path / "a.obj")
    assert len(obj.faces) == 1
    assert obj.albedo.reshape(-1, 3) == pytest.approx(np.array([[0, 1, 0]]))
