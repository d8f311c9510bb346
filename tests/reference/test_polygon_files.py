"""Polygons of PLY and OFF files: concave ones are filled, and what a face or its corners have goes with them.

The files are written here byte by byte, and held against what was drawn.
"""

import struct

import numpy as np
import pytest
from PIL import Image

from unirender.errors import UnirenderError
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.load import read_model

COMB = [(0, 0), (6, 0), (6, 4), (5, 4), (5, 1), (3, 1), (3, 4), (2, 4), (2, 1), (1, 1), (1, 4), (0, 4)]  # area 15
AREA, AROUND, HEIGHT = 15.0, 32.0, 2.0
FLAT = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0.5, 0)]
QUAD, TRIANGLE, PENTAGON = [0, 1, 2, 3], [1, 4, 2], [1, 4, 2, 3, 0]
POINT = [("float", "x"), ("float", "y"), ("float", "z")]
COLOR = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
LETTERS = {"uchar": "B", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
FORMS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def ply(form, elements, comment=None):
    """The bytes of a file.

    Args:
        form: of its numbers.
        elements: (name, properties as (type, name) or (type of counts, type, name), rows), in order.
        comment: a line of the header.
    """
    head, body = ["ply", f"format {form} 1.0"] + ([f"comment {comment}"] if comment else []), b""
    for name, properties, rows in elements:
        head.append(f"element {name} {len(rows)}")
        head += [f"property {'list ' * (len(each) > 2)}{' '.join(each)}" for each in properties]
        for row in rows:
            flat = []
            for each, value in zip(properties, row, strict=True):
                values = value if len(each) > 2 else [value]
                flat += [(each[0], len(value))] if len(each) > 2 else []
                flat += [(each[-2], number) for number in values]
            if form == "ascii":
                body += " ".join(str(number) for _, number in flat).encode() + b"\n"
            else:
                body += b"".join(struct.pack(FORMS[form] + LETTERS[kind], number) for kind, number in flat)
    return "\n".join([*head, "end_header", ""]).encode() + body


def faces_of(*polygons, kinds=("uchar", "int"), more=()):
    return "face", [(*kinds, "vertex_indices"), *more], [[polygon] for polygon in polygons]


def prism():
    """Of the comb: its points, and its faces seen from outside."""
    n = len(COMB)
    points = [(x, y, z) for z in (0.0, HEIGHT) for x, y in COMB]
    caps = [[*range(n - 1, -1, -1)], [*range(n, 2 * n)]]
    return points, caps + [[k, (k + 1) % n, (k + 1) % n + n, k + n] for k in range(n)]


def off(points, faces, head="OFF"):
    lines = [f"{head} {len(points)} {len(faces)} 0", *(" ".join(map(str, point)) for point in points)]
    return "\n".join([*lines, *(" ".join(map(str, [len(face), *face])) for face in faces)]).encode()


def measured(path):
    """Area and volume of the triangles that are read."""
    corners = np.concatenate([piece.vertices[piece.faces] for piece in read_model(path).pieces])
    a, b, c = np.moveaxis(corners, 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2, (a * np.cross(b, c)).sum() / 6


@pytest.mark.parametrize("form", [*FORMS, "off", "obj"])
@pytest.mark.parametrize("axis", range(3))
def test_a_prism_with_concave_ends_has_its_volume(tmp_path, form, axis):
    """PLY and OFF had fans that reached over the notches; a binary PLY with polygons of several sizes was refused."""
    points, outside = prism()
    points = np.roll(points, axis, axis=1).tolist()
    for turn in (1, -1):
        faces = [face[::turn] for face in outside]
        if form == "off":
            (path := tmp_path / "a.off").write_bytes(off(points, faces))
        elif form == "obj":
            lines = [*("v {} {} {}".format(*point) for point in points)]
            lines += [" ".join(["f", *(str(k + 1) for k in face)]) for face in faces]
            (path := tmp_path / "a.obj").write_text("\n".join(lines))
        else:
            (path := tmp_path / "a.ply").write_bytes(ply(form, [("vertex", POINT, points), faces_of(*faces)]))
        area, volume = measured(path)
        assert area == pytest.approx(2 * AREA + AROUND * HEIGHT, rel=1e-6)
        assert volume == pytest.approx(AREA * HEIGHT * turn, rel=1e-6)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kinds", [("uchar", "ushort"), ("int", "uint"), ("uint", "uchar"), ("uchar", "float")])
def test_lists_of_any_type_among_other_properties_and_elements(tmp_path, form, kinds):
    faces = ("face", [*COLOR, (*kinds, "vertex_index"), ("uchar", "float", "texcoord"), ("int", "flags")], [])
    faces[2].extend([[255, 0, 0, PENTAGON, [0.0] * 10, 7], [0, 255, 0, [0, 1], [], 7]])
    camera = ("camera", [("uchar", "float", "matrix"), ("double", "focal")], [[[1.0, 2.0], 3.0], [[], 4.0]])
    edges = ("edge", [("int", "vertex1"), ("int", "vertex2")], [[0, 1], [1, 2]])
    (path := tmp_path / "a.ply").write_bytes(ply(form, [camera, ("vertex", POINT, FLAT), edges, faces]) + b" \n")
    assert measured(path)[0] == pytest.approx(1.5)
    assert {tuple(texel) for texel in load_mesh(path).albedo.reshape(-1, 3).tolist()} == {(1.0, 0.0, 0.0)}


@pytest.mark.parametrize(
    "polygons", [[QUAD, TRIANGLE, [0, 1, 4, 2, 3]], [TRIANGLE, QUAD, PENTAGON], [QUAD, [0, 1], [2]]]
)
def test_polygons_of_several_sizes_in_a_binary_file(tmp_path, polygons):
    """Where their mean size was that of the first, other bytes were read as indices."""
    rows = [("vertex", POINT, FLAT), faces_of(*polygons)]
    (tmp_path / "a.ply").write_bytes(ply("binary_little_endian", rows))
    (tmp_path / "b.ply").write_bytes(ply("ascii", rows))
    expected = sum({3: 0.5, 4: 1.0, 5: 1.5}.get(len(polygon), 0) for polygon in polygons)
    assert measured(tmp_path / "a.ply")[0] == measured(tmp_path / "b.ply")[0] == pytest.approx(expected)


@pytest.mark.parametrize("form", [*FORMS, "off"])
def test_each_polygon_keeps_its_color(tmp_path, form):
    """Colours of faces with more than three corners were left out."""
    if form == "off":
        data = off(FLAT, [QUAD, TRIANGLE]).replace(b"4 0 1 2 3", b"4 0 1 2 3 255 0 0") + b" 0 0 255"
    else:
        faces = "face", [("uchar", "int", "vertex_indices"), *COLOR], [[QUAD, 255, 0, 0], [TRIANGLE, 0, 0, 255]]
        data = ply(form, [("vertex", POINT, FLAT), faces])
    (path := tmp_path / f"a.{'off' if form == 'off' else 'ply'}").write_bytes(data)
    (piece,) = read_model(path).pieces
    assert piece.colors is not None
    right = piece.vertices[piece.faces][:, :, 0].max(axis=1) > 1
    np.testing.assert_array_equal(piece.colors[right], np.broadcast_to([0, 0, 1], (1, 3, 3)))
    np.testing.assert_array_equal(piece.colors[~right], np.broadcast_to([1, 0, 0], (2, 3, 3)))
    assert read_model(path).ignored == frozenset()


@pytest.mark.parametrize("of_vertices", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_texture_coordinates_go_with_the_corners(tmp_path, form, of_vertices):
    """A text with them on polygons of several sizes was refused; colours beside them without a picture were lost."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    points = [[*point, *point[:2], 255, 0, 0] for point in FLAT]
    faces = faces_of(PENTAGON, TRIANGLE)
    if not of_vertices:
        points = [[*point, 255, 0, 0] for point in FLAT]
        faces = (
            "face",
            [*faces[1], ("uchar", "float", "texcoord")],
            [[f, np.array(FLAT)[f, :2].ravel()] for [f] in faces[2]],
        )
    kinds = [*POINT, *([("float", "s"), ("float", "t")] if of_vertices else []), *COLOR]
    (path := tmp_path / "a.ply").write_bytes(ply(form, [("vertex", kinds, points), faces], "TextureFile a.png"))
    (piece,) = read_model(path).pieces
    np.testing.assert_array_equal(piece.uv[0] * [1, -1] + [0, 1], piece.vertices[piece.faces][..., :2])
    path.write_bytes(ply(form, [("vertex", kinds, points), faces]))
    assert load_mesh(path).albedo.reshape(-1, 3)[0].tolist() == [1.0, 0.0, 0.0]


def test_normals_go_with_the_corners_beside_their_coordinates(tmp_path):
    """Where the faces had coordinates of their own, normals of the vertices were lost."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    kinds, normals = [*POINT, ("float", "nx"), ("float", "ny"), ("float", "nz")], np.arange(15.0).reshape(5, 3) + 1
    faces = [*faces_of()[1], ("uchar", "float", "texcoord")]
    rows = [[face, np.arange(2 * len(face)) / 10] for face in (QUAD, TRIANGLE)]
    points = np.hstack([FLAT, normals]).tolist()
    (path := tmp_path / "a.ply").write_bytes(
        ply("ascii", [("vertex", kinds, points), ("face", faces, rows)], "TextureFile a.png")
    )
    (piece,) = read_model(path).pieces
    assert piece.uv
    np.testing.assert_array_equal(piece.normals, normals[piece.faces])


def test_a_texture_without_coordinates_counts_as_its_mean_and_is_listed(tmp_path):
    """The object was grey, and nothing said so."""
    Image.new("RGB", (4, 4), (255, 0, 255)).save(tmp_path / "a.png")
    (path := tmp_path / "a.ply").write_bytes(
        ply("ascii", [("vertex", POINT, FLAT), faces_of(QUAD)], "TextureFile a.png")
    )
    obj = load_mesh(path)
    assert (obj.albedo.tolist(), obj.provenance["ignored"]) == ([1, 0, 1], "textures of faces without coordinates")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("lists", [[[0, 1, 3, 2, -1, 1, 4, 2]], [[0, 1, 3, 2], [1, 4, 2], [0, 1]]])
def test_strips_of_a_ply(tmp_path, form, lists):
    """They were called a point cloud."""
    strips = "tristrips", [("int", "int", "vertex_indices")], [[each] for each in lists]
    (path := tmp_path / "a.ply").write_bytes(ply(form, [("vertex", POINT, FLAT), strips]))
    (piece,) = read_model(path).pieces
    a, b, c = np.moveaxis(piece.vertices[piece.faces], 1, 0)
    np.testing.assert_array_equal(np.cross(b - a, c - a), [[0, 0, 1]] * 3)


@pytest.mark.parametrize("ends", ["\r\n", "\r", "\n\n"])
def test_lines_of_a_ply_may_end_in_any_way(tmp_path, ends):
    text = ply("ascii", [("vertex", POINT, FLAT), faces_of(QUAD, TRIANGLE)]).decode()
    (tmp_path / "a.ply").write_text(text.replace("\n", ends), newline="")
    assert measured(tmp_path / "a.ply")[0] == pytest.approx(1.5)


VERTICES = ("vertex", POINT, FLAT)
WRONG = {
    "a word": (ply("ascii", [VERTICES, faces_of(QUAD)]).replace(b"0 1 2 3", b"0 1 two 3"), "has the word b'two'"),
    "glued numbers": (ply("ascii", [VERTICES, faces_of(QUAD)]).replace(b"0 1 0", b"0 1-0"), "has the word b'1-0'"),
    "many lists": (
        ply("ascii", [("face", [("uchar", "int", f"list{k}") for k in range(9)], [])]),
        "its element face has 9 lists",
    ),
    "a short line": (ply("ascii", [VERTICES, faces_of(QUAD)]).replace(b"1 1 0", b"1 1"), "row 3 of its element vertex"),
    "a short binary": (ply("binary_big_endian", [VERTICES, faces_of(QUAD)])[:-1], "truncated: row 1 .* face"),
    "several sizes, short": (ply("binary_big_endian", [VERTICES, faces_of(QUAD, TRIANGLE)])[:-13], "truncated"),
    "a negative length": (
        ply("binary_little_endian", [VERTICES, faces_of(QUAD, kinds=("int", "int"))]).replace(
            struct.pack("<5i", 4, *QUAD), struct.pack("<5i", -4, *QUAD)
        ),
        "a list of its element face has -4 numbers",
    ),
    "other lists": (
        ply("ascii", [VERTICES, ("face", [("uchar", "int", "a"), ("uchar", "int", "b")], [[QUAD, []]])]),
        "lists a, b, expected one of vertex_indices",
    ),
    "both": (ply("ascii", [VERTICES, faces_of(QUAD), ("tristrips", *faces_of(QUAD)[1:])]), "both faces and tristrips"),
    "no z": (ply("ascii", [("vertex", POINT[:2], [[0, 0]]), faces_of(QUAD)]), "vertices have no z"),
    "a type": (ply("ascii", [VERTICES, faces_of(QUAD)]).replace(b"float z", b"half z"), "the line b'property half z'"),
    "rows below 0": (  # which took lines away from the faces
        ply("ascii", [VERTICES, faces_of(QUAD)]).replace(b"end_header", b"element edge -1\nend_header"),
        "the line b'element edge -1'",
    ),
    "an order": (ply("ascii", [VERTICES]).replace(b"ascii", b"binary"), "the line b'format binary 1.0'"),
    "no order": (ply("ascii", [VERTICES]).replace(b"format ascii 1.0\n", b""), "no line 'format'|not understood"),
    "a name twice": (ply("ascii", [VERTICES]).replace(b"float z", b"float y"), "two properties of one name"),
    "many corners": (off(FLAT, [[0, 1, 2, 4] * 30_000]), "concave polygon of 120,000 corners"),
    "OFF in bytes": (b"OFF BINARY\n" + struct.pack(">3i", 5, 1, 0) + bytes(80), "starts with 'OFF BINARY', expected"),
    "OFF, no counts": (b"OFF\nfive\n", "its header says 'five', expected counts"),
    "OFF, an index": (off(FLAT, [QUAD, [0, 1, 7, 2]]), "its faces name vertex 7, but it has 5"),
    "OFF, a word": (off(FLAT, [["a", 1, 2]]), "faces are no numbers"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_reasons(tmp_path, kind):
    data, message = WRONG[kind]
    (path := tmp_path / ("a.off" if data.startswith(b"OFF") else "a.ply")).write_bytes(data)
    with pytest.raises(UnirenderError, match=message):
        load_mesh(path)
