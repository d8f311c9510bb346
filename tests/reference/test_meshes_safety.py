"""What `load_mesh` refuses: one sentence each, in bounded memory, and nothing read from outside the model's folder."""

import ast
import io
import json
import os
import re
import resource
import struct
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import trimesh
from broken_files import BROKEN, GREEDY
from gltf_files import CORNERS, GOOD, GltfWriter, png, random_pixels
from PIL import Image

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes import find_meshes, load_mesh
from unirender_reference.meshes import limits as bounds
from unirender_reference.meshes.images import ImageBudget

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = b"ply\nformat ascii 1.0\n"
PLY_TRIANGLE = (
    b"element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
)
STL_FACET = b"solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
STL_END = b"endsolid\n"


def reason(path) -> str:
    with pytest.raises(UnirenderError) as caught:
        load_mesh(path)
    message = str(caught.value)
    assert message.startswith(f"mesh {path}: ")
    assert "\n" not in message
    assert re.search(r"; |\?|: install ", message), "it does not say what to do"
    return message.removeprefix(f"mesh {path}: ")


@pytest.mark.parametrize("write", BROKEN | GREEDY, ids=lambda write: write.__name__)
def test_each_broken_file_has_its_reason(tmp_path, write):
    (tmp_path / "model").mkdir()
    assert re.search((BROKEN | GREEDY)[write], reason(write(tmp_path / "model")))


def test_every_refusal_of_a_reader_says_what_to_do() -> None:
    """Behind a semicolon, or as a question: `load` adds nothing to it but the file."""
    calls = (
        (path.name, ast.unparse(node.exc))
        for path in Path(bounds.__file__).parent.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Raise) and node.exc is not None
    )
    silent = [
        (name, call)
        for name, call in calls
        if call.startswith("UnirenderError") and not re.search(r"; |\?|: install |_LIMIT", call)
    ]
    assert silent == [("load.py", "UnirenderError(f'mesh {path}: {error}')")]


@pytest.mark.parametrize("files", [BROKEN, GREEDY], ids=["broken", "greedy"])
def test_broken_files_cost_no_memory(tmp_path, files):
    """All in a process that may take 600 MiB more than after its imports; a twin shows that the limit bites."""
    (tmp_path / "model").mkdir()
    paths = [str(write(tmp_path / "model")) for write in files]
    script = """
        import resource, sys
        import numpy as np
        from unirender.errors import UnirenderError
        from unirender_reference.meshes import load_mesh
        used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 600 * 2**20,) * 2)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        reasons = 0
        for path in sys.argv[1:]:
            try:
                load_mesh(path)
            except UnirenderError as error:
                assert "memory" not in str(error), error
                reasons += 1
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
        try:
            np.ones(2**27)
        except MemoryError:
            print(reasons, "reasons,", grown, "MiB")
    """
    command = [sys.executable, "-c", textwrap.dedent(script), *paths]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.fullmatch(r"(\d+) reasons, (\d+) MiB\n", done.stdout)
    assert found, done.stdout + done.stderr
    assert int(found[1]) == len(files)
    assert int(found[2]) < 200


def write_json(tmp_path, change) -> Path:
    """The quad's GLB with its JSON changed."""
    writer = GltfWriter()
    writer.mesh(writer.quad(writer.material(pbrMetallicRoughness={})))
    document = writer.document()
    change(document)
    writer.document = lambda: document
    return writer.glb(tmp_path / "model.glb")


def set_in(document, *keys, value):
    for key in keys[:-1]:
        document = document[key]
    document[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("accessors", 0, "count"), 4_000_000_000, r"accessors\[0\] counts 4,000,000,000 elements, expected at most"),
        (("accessors", 0, "count"), 400, r"accessors\[0\] needs 4,800 bytes .*cut off; export it again"),
        (("accessors", 0, "count"), -1, "has count -1, expected a non-negative integer"),
        (("accessors", 2, "count"), 5, "cut off|expected triples"),
        (("bufferViews", 0, "byteLength"), 10**12, r"bufferViews\[0\] needs bytes 0 to 1,000,000,000,000"),
        (("bufferViews", 0, "byteStride"), 4, "cut off"),
        (("buffers", 0, "byteLength"), 10**12, r"truncated: buffers\[0\] holds"),
        (("meshes", 0, "primitives", 0, "indices"), 77, r"names accessors\[77\], but has 3 of them"),
        (("meshes", 0, "primitives", 0, "mode"), 7, "has the mode 7, expected 0 to 6"),
        (("meshes", 0, "primitives", 0, "material"), 5, r"names materials\[5\], but has 1"),
        (("nodes", 0, "children"), [0], r"nodes\[0\] has two parents or is its own"),
        (("nodes", 0, "scale"), [1, 2], "has scale .*expected 3 finite numbers"),
        (("accessors", 0, "type"), "MAT2", "has type MAT2"),
        (("accessors", 0), "x", r"accessors\[0\] is x, expected an object"),
        (("meshes",), 3, "its meshes are 3, expected a list"),
        (("asset", "version"), "1.0", "glTF version 1.0, expected 2.0"),
        (("buffers", 0, "uri"), "https://example.org/model.bin", "is a https address"),
        (("buffers", 0, "uri"), "/etc/passwd", "is an absolute path"),
        (("buffers", 0, "uri"), "C:\\model.bin", "is an absolute path"),
        (("buffers", 0, "uri"), "data:text/plain,hello", "expected a base64 data URI"),
        (("buffers", 0, "uri"), "data:;base64,@@@", "its data URI is broken"),
        (("nodes", 0, "translation"), [1e7, 0, 0], None),  # places the quad far away without losing anything
    ],
)  # fmt: skip
def test_gltf_claims_are_checked(tmp_path, keys, value, message):
    path = write_json(tmp_path, lambda document: set_in(document, *keys, value=value))
    if message is None:
        assert len(load_mesh(path).faces) == 2
    else:
        assert re.search(message, reason(path))


def test_damaged_containers(tmp_path):
    path = tmp_path / "model.glb"
    path.write_bytes(b"glTF\x02")
    assert "truncated: has 5 bytes" in reason(path)
    path.write_bytes(struct.pack("<4sII", b"glTF", 1, 12))
    assert "glTF version 1" in reason(path)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20, 10**9, b"JSON"))
    assert "truncated: chunk b'JSON' says 1,000,000,000 bytes, 0 are left" in reason(path)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"{,,,")
    assert "its JSON is broken" in reason(path)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 120_020, 120_000, b"JSON") + b"[" * 120_000)
    assert "its JSON is broken" in reason(path)
    (tmp_path / "empty.gltf").write_text("{}")
    assert "glTF version None" in reason(tmp_path / "empty.gltf")
    (tmp_path / "empty.gltf").write_text(json.dumps({"asset": {"version": "2.0"}}))
    assert "has no faces" in reason(tmp_path / "empty.gltf")


def test_random_damage_is_a_reason_or_harmless(tmp_path):
    """A byte of a good file overwritten, an object of its JSON replaced: never another exception, never two lines."""
    rng = np.random.default_rng(0)
    reasons = []
    for index in range(80):
        source = GOOD[index % len(GOOD)](tmp_path).path
        data = bytearray(source.read_bytes())
        data[rng.integers(len(data))] = rng.integers(256)
        if index % 2 and source.suffix == ".gltf":
            document = json.loads(source.read_text())
            kind = rng.choice(["accessors", "bufferViews", "meshes", "nodes", "materials"])
            document[kind][0] = [None, {}, "x", 1e300, [[]]][rng.integers(5)]
            data = json.dumps(document).encode()
        path = tmp_path / f"damaged{source.suffix}"
        path.write_bytes(data)
        try:
            load_mesh(path)
        except UnirenderError as error:
            reasons.append(str(error))
    assert 20 < len(reasons) < 80
    assert not any("\n" in text for text in reasons)


def test_precision(tmp_path):
    """A kilometre-sized model and one in nanometres load; one whose float32 coordinates collapse does not."""
    for scale in (1e7, 1e-7):
        writer = GltfWriter()
        writer.mesh(writer.quad(None, CORNERS * np.float32(scale)))
        assert len(load_mesh(writer.glb(tmp_path / "model.glb")).faces) == 2
    writer = GltfWriter()
    writer.mesh(writer.quad(None, CORNERS * np.float32(8) + np.array([1e8, 0, 0], np.float32)))
    assert "its float32 coordinates are 8 units apart, for an extent of 16 units" in reason(
        writer.glb(tmp_path / "far.glb")
    )
    assert len(load_mesh(_scaled(tmp_path, 1e7)).faces) == 2  # twin of the 1e9-unit file


def _scaled(tmp_path: Path, scale: float) -> Path:
    writer = GltfWriter()
    writer.mesh(writer.quad(None), scale=[scale] * 3)
    return writer.glb(tmp_path / "scaled.glb")


def test_damaged_and_large_pictures(tmp_path, monkeypatch):
    data = png(random_pixels(0, 64, 64))
    writer = GltfWriter()
    texture = {"index": writer.texture(random_pixels(0, 4, 4), uri="a.png")}
    writer.mesh(writer.quad(writer.material(pbrMetallicRoughness={"baseColorTexture": texture})))
    path = writer.glb(tmp_path / "model.glb")
    (tmp_path / "a.png").write_bytes(data[:2000])
    assert re.search("texture 'a.png': damaged .*export it again", reason(path))
    (tmp_path / "a.png").write_bytes(b"<svg/>")
    assert "texture 'a.png': no image that can be read" in reason(path)
    (tmp_path / "a.png").write_bytes(data)
    assert load_mesh(path).albedo.shape == (66, 66, 3)
    monkeypatch.setattr("unirender_reference.meshes.images.MAX_IMAGE_PIXELS", 4000)
    assert "texture 'a.png': 64 x 64 pixels, expected at most 67,108,864 (8,192 x 8,192); reduce it" in reason(path)
    monkeypatch.undo()
    monkeypatch.setattr("unirender_reference.meshes.images.MAX_IMAGE_SIDE", 63)
    assert "texture 'a.png': 64 x 64 pixels, expected sides of at most 63; reduce it" in reason(path)
    monkeypatch.undo()
    monkeypatch.setattr("unirender_reference.meshes.images.MAX_MODEL_PIXELS", 4000)
    assert "brings the textures to 0 megapixels" in reason(path)


def test_limits_on_faces_and_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(bounds, "MAX_FACES", 1)
    path = _scaled(tmp_path, 1)
    assert "has 2 faces, expected at most 1; decimate the mesh" in reason(path)
    (tmp_path / "model.obj").write_text(TRIANGLE + "f 1 2 3\nf 1 2 3\n")
    assert "has 2 faces, expected at most 1" in reason(tmp_path / "model.obj")
    monkeypatch.undo()
    monkeypatch.setattr(bounds, "MAX_FILE_BYTES", 20)
    assert "the file has 0.00 MiB" in reason(path)
    assert "the file has 0.00 MiB" in reason(tmp_path / "model.obj")


def test_limits_on_pieces_materials_and_arrays(tmp_path, monkeypatch):
    """Each limit lowered below a file that loads without it."""
    writer = GltfWriter()
    mesh = writer._add("meshes", {"primitives": [writer.quad(None)]})
    writer.json["nodes"] = [{"mesh": mesh, "translation": [3 * i, 0, 0]} for i in range(3)]
    copies = writer.glb(tmp_path / "copies.glb")
    writer = GltfWriter()
    writer.mesh(writer.quad(writer.material()), writer.quad(writer.material(), CORNERS + np.float32(3)))
    two = writer.glb(tmp_path / "two.glb")
    obj = tmp_path / "model.obj"
    obj.write_text(TRIANGLE + "v 0 0 1\nvt 0 0\nvn 0 0 1\nusemtl a\nf 1 2 3\nusemtl b\nf 1 2 4\n")
    for name, value, path, message in (
        ("limits.MAX_PIECES", 2, copies, "has more than 2 primitives in all instances; merge its meshes"),
        ("limits.MAX_FACES", 5, copies, "has 6 faces, expected at most 5"),
        ("gltf_accessors.MAX_VERTICES", 3, two, "counts 6 elements, expected at most 3"),
        ("limits.MAX_MATERIALS", 1, two, "has more than 1 materials"),
        ("limits.MAX_MATERIALS", 1, obj, "has more than 1 materials"),
        ("obj.MAX_VERTICES", 3, obj, "has more than 3 vertices"),
        ("obj.MAX_VERTICES", 0, obj, "has more than 0 vertices"),
        ("obj.MAX_LINE_BYTES", 8, obj, "line 6 has more than 8 bytes"),
    ):
        assert load_mesh(path).provenance["source"] == "file"
        monkeypatch.setattr(f"unirender_reference.meshes.{name}", value)
        assert message in reason(path)
        monkeypatch.undo()


def test_buffers_together_have_a_limit(tmp_path, monkeypatch):
    """Two files, and a limit that both together pass and neither alone."""
    writer = GltfWriter()
    writer.mesh(writer.quad(None))
    document = writer.document()
    data = writer.body + b"\0" * (-len(writer.body) % 64)
    for i in (0, 1):
        (tmp_path / f"{i}.bin").write_bytes(data)
    document["buffers"] = [{"byteLength": len(data), "uri": f"{i}.bin"} for i in (0, 1)]
    document["bufferViews"][0]["buffer"] = 1
    path = tmp_path / "model.gltf"
    path.write_text(json.dumps(document))
    assert len(load_mesh(path).faces) == 2
    monkeypatch.setattr(bounds, "MAX_FILE_BYTES", 2 * len(data) - 1)
    assert "the sum of its buffers has" in reason(path)
    document["buffers"][1]["uri"] = "0.bin"  # twin: one file counts once
    path.write_text(json.dumps(document))
    assert len(load_mesh(path).faces) == 2


def test_many_materials(tmp_path):
    """1,000 of them, each with its face and its colour; for 60,000 there is a reason, at once."""
    count = 1000
    lines = [f"v {i} 1 {i % 7}\nusemtl m{i}\nf 1 2 {i + 4}\n" for i in range(count)]
    (tmp_path / "many.obj").write_text(TRIANGLE + "mtllib m.mtl\n" + "".join(lines))
    colors = np.arange(count) % 256 / 255
    (tmp_path / "m.mtl").write_text("".join(f"newmtl m{i}\nKd {v} {v} {v}\n" for i, v in enumerate(colors)))
    obj = load_mesh(tmp_path / "many.obj")
    assert len(obj.faces) == count
    assert obj.uv is not None
    h, w, _ = obj.albedo.shape
    looked = (obj.uv[obj.faces[:, 0]] * [w, h]).astype(int)
    assert obj.albedo[looked[:, 1], looked[:, 0], 0] == pytest.approx(srgb_decode(colors), abs=1e-6)
    (tmp_path / "more.obj").write_text(TRIANGLE + "".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(60_000)))
    assert "has more than 10,000 materials, expected fewer; merge them" in reason(tmp_path / "more.obj")


def test_textures_of_the_folder_of_meshes(tmp_path):
    """ShapeNet's layout: models/model.obj names ../images/texture0.png. The folder of all meshes is the boundary."""
    meshes = tmp_path / "meshes"
    for folder in ("one/models", "one/images"):
        (meshes / folder).mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(png(random_pixels(0, 4, 4)))
    (meshes / "one/images/texture0.png").write_bytes(png(random_pixels(0, 4, 4)))
    (meshes / "one/images/link.png").symlink_to(tmp_path / "secret.png")
    model = meshes / "one/models/model.obj"
    model.write_text(TRIANGLE + "vt 0 0\nvt 1 0\nvt 0 1\nmtllib model.mtl\nusemtl a\nf 1/1 2/2 3/3\n")

    def texture(name: str) -> None:
        (model.parent / "model.mtl").write_text(f"newmtl a\nmap_Kd {name}\n")

    texture("../images/texture0.png")
    assert load_mesh(model, root=meshes).albedo.shape == (6, 6, 3)
    assert load_mesh(model, root=meshes / "one").albedo.shape == (6, 6, 3)
    assert "lies outside the model's folder" in reason(model)
    for name in ("../../../secret.png", "../images/link.png"):
        texture(name)
        with pytest.raises(UnirenderError, match="lies outside the folder of the meshes"):
            load_mesh(model, root=meshes)
    texture(str(meshes / "one/images/texture0.png"))
    with pytest.raises(UnirenderError, match="is an absolute path"):
        load_mesh(model, root=meshes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (TRIANGLE + "f 1 2 9\n", "faces name vertex 9, but it has 3"),
        (TRIANGLE + "f 1 2 -4\n", "its faces name a vertex before the first, counted back from a face, but it has 3"),
        (TRIANGLE + "vn 0 0 1\nf 1//1 2//1 3//-2\n", "name a normal before the first"),
        (TRIANGLE + "f 1 2 99999999999999999999\n", "line 4 cannot be read"),
        (TRIANGLE + "f 1/9 2/9 3/9\n", "faces name texture coordinate 9, but it has 0"),
        (TRIANGLE + "f 1 2 x\n", "line 4 cannot be read .*'f 1 2 x"),
        ("v 1 2\n", "line 1 cannot be read .*expected 3 numbers"),
        ("v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n", "zero area: all 1 faces"),
        (TRIANGLE + "mtllib ../secret.mtl\nusemtl a\nf 1 2 3\n", "'../secret.mtl' lies outside the model's folder"),
        (TRIANGLE + "mtllib nowhere.mtl\nusemtl a\nf 1 2 3\n", "material library 'nowhere.mtl' is missing"),
        (TRIANGLE + "mtllib nowhere.mtl\nf 1 2 3\n", None),  # nothing of it is used
    ],
)  # fmt: skip
def test_obj_reasons(tmp_path, content, message):
    (tmp_path / "secret.mtl").write_text("newmtl a\nKd 1 1 1\n")
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "model.obj").write_text(content)
    if message is None:
        assert len(load_mesh(folder / "model.obj").faces) == 1
    else:
        assert re.search(message, reason(folder / "model.obj"))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("map_Kd nowhere.png", "texture 'nowhere.png' is missing"),
        ("map_Kd ../secret.png", "texture '../secret.png' lies outside"),
        ("map_Kd ..\\secret.png", "lies outside"),
        ("map_Kd link.png", "texture 'link.png' lies outside"),
        ("map_Kd /etc/passwd", "'/etc/passwd' is an absolute path"),
        ("map_Kd C:/pictures/wood.jpg", "is an absolute path"),
        ("map_Kd http://example.org/a.png", "is a http address"),
        ("map_Pr nowhere.png", "texture 'nowhere.png' is missing"),
        ("map_Kd skin.<UDIM>.png", "texture 'skin.<UDIM>.png' is a set of tiles, not read here"),
    ],
)
def test_mtl_textures_stay_in_the_folder(tmp_path, line, message):
    (tmp_path / "secret.png").write_bytes(png(random_pixels(0, 4, 4)))
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "m.mtl").write_text(f"newmtl used\n{line}\nnewmtl idle\nmap_Kd also_nowhere.png\n")
    text = TRIANGLE + "vt 0 0\nvt 1 0\nvt 0 1\nmtllib m.mtl\nusemtl used\nf 1/1 2/2 3/3\n"
    (folder / "model.obj").write_text(text)
    assert message in reason(folder / "model.obj")
    (folder / "model.obj").write_text(text.replace("usemtl used", "usemtl other"))
    obj = load_mesh(folder / "model.obj")  # what no face uses is not asked for
    assert obj.provenance["ignored"] == "undefined materials"


def test_names_that_differ_in_case_alone_are_found(tmp_path):
    """Files made on Windows and macOS were refused; what lies outside still is, and so is a choice of two."""
    (tmp_path / "model" / "Maps").mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(png(random_pixels(0, 4, 4)))
    (tmp_path / "model" / "Maps" / "Wood.PNG").write_bytes(png(random_pixels(0, 4, 4)))
    model = tmp_path / "model" / "model.obj"
    model.write_text(TRIANGLE + "vt 0 0\nvt 1 0\nvt 0 1\nmtllib MODEL.MTL\nusemtl a\nf 1/1 2/2 3/3\n")
    (tmp_path / "model" / "model.mtl").write_text("newmtl a\nmap_Kd maps\\wood.png\n")
    assert load_mesh(model).albedo.shape == (6, 6, 3)
    (tmp_path / "model" / "Maps" / "WOOD.png").symlink_to(tmp_path / "secret.png")
    assert "texture 'maps\\\\wood.png' is missing" in reason(model)
    (tmp_path / "model" / "Maps" / "Wood.PNG").unlink()
    assert "lies outside the model's folder" in reason(model)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", PLY + b"element vertex 4000000000\nproperty float x\nend_header\n", "claims 4,000,000,000"),
        ("a.ply", PLY + b"element vertex 400000\nproperty float x\nend_header\n", "truncated: claims 400,000"),
        ("a.off", b"OFF\n900000 2 0\n", "truncated: claims 900,000 vertices"),
        ("a.off", b"# made by hand\nNCOFF\n900000 2 0\n", "truncated: claims 900,000 vertices"),
        ("a.off", b"4OFF\n3 1 0\n", "starts with '4OFF', expected OFF"),
        ("a.off", b"off\n3 1 0\n", "expected OFF"),
        ("a.stl", b"solid nothing\nendsolid nothing\n", "no faces|cannot be read"),
        ("a.stl", STL_FACET.replace(b"1 0 0", b"1 0") * 3 + STL_END, "the line b'vertex 1 0', expected three numbers"),
        ("a.stl", STL_FACET.replace(b"endloop", b"vertex 1 1 0\nendloop") * 3 + STL_END, "has facets of 4 vertices"),
        ("a.stl", STL_FACET.replace(b"1 0 0", b"1 0 vertex") + STL_END, "the line b'vertex 1 0 vertex', expected"),
        ("a.stl", STL_FACET.replace(b"facet normal", b"normal") + STL_FACET + STL_END, "before its first facet"),
        ("a.ply", PLY + b"comment TextureFile ../a.png\n" + PLY_TRIANGLE + b"3 0 1 2\n", "'../a.png' lies outside"),
        ("a.ply", PLY + b"comment TextureFile a.png\n" + PLY_TRIANGLE + b"3 0 1 2\n", "texture 'a.png' is missing"),
        ("a.ply", PLY + b"comment TextureFile a\ncomment TextureFile b\n" + PLY_TRIANGLE + b"3 0 1 2\n", "names 2"),
        ("a.ply", PLY + b"comment\n" * 9000 + PLY_TRIANGLE + b"3 0 1 2\n", "header does not end within 65,536 bytes"),
        ("a.ply", PLY + PLY_TRIANGLE + b"3 0 1 7\n", "outside the 3 vertices|cannot be read"),
    ],
)  # fmt: skip
def test_other_formats(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    assert re.search(message, reason(tmp_path / name))


def test_a_texture_of_8k_is_read_and_a_larger_one_is_not():
    """64 million pixels were the limit, a little less than 8192 x 8192. Nothing is decoded here."""
    data = []
    for width in (8192, 8193):
        stream = io.BytesIO()
        Image.new("1", (width, 8192)).save(stream, "PNG", compress_level=1)
        data.append(stream.getvalue())
    assert ImageBudget().open(data[0], "'a.png'").size == (8192, 8192)
    with pytest.raises(UnirenderError, match=r"texture 'a\.png': 8,193 x 8,192 pixels, expected at most 67,108,864"):
        ImageBudget().open(data[1], "'a.png'")


@pytest.mark.parametrize("lost", ["100 lines", "half of the last line"])
@pytest.mark.parametrize("kind", ["off", "ply", "stl"])
def test_a_text_that_is_cut_off(tmp_path, kind, lost):
    """The faces that were left were read as the whole mesh; of an STL, as a point cloud."""
    mesh = trimesh.creation.icosphere(1)
    formats = {"ply": {"encoding": "ascii"}, "stl": {"file_type": "stl_ascii"}}
    mesh.export(path := tmp_path / f"ball.{kind}", **formats.get(kind, {}))
    assert len(load_mesh(path).faces) == 80
    lines = path.read_text().split("\n")
    last = " ".join(lines[-1 if lines[-1] else -2].split()[:-1])
    path.write_text("\n".join(lines[:-52] if lost == "100 lines" else [*lines[: -1 if lines[-1] else -2], last]))
    assert "truncated" in reason(path)


def test_truncated_stl(tmp_path):
    trimesh.creation.icosphere().export(tmp_path / "ball.stl")
    data = (tmp_path / "ball.stl").read_bytes()
    assert len(load_mesh(tmp_path / "ball.stl").faces) == 1280
    (tmp_path / "ball.stl").write_bytes(data[:-1])
    assert "truncated: claims 1,280 triangles in 64,083 bytes, expected 64,084" in reason(tmp_path / "ball.stl")
    (tmp_path / "ball.stl").write_bytes(data[:80] + struct.pack("<I", 4_000_000_000) + data[84:])
    assert "truncated: claims 4,000,000,000 triangles" in reason(tmp_path / "ball.stl")
    (tmp_path / "ball.stl").write_bytes(data[:80] + bytes(4) + data[84:])
    assert "claims 0 triangles, but has bytes for 1,280: its count was never written" in reason(tmp_path / "ball.stl")
    (tmp_path / "ball.stl").write_bytes(b"")
    assert reason(tmp_path / "ball.stl") == "is empty; copy it again"


def test_fan_with_a_crowded_vertex_is_loaded_in_bounded_memory(tmp_path):
    """20,000 faces around one point: smoothing it pair by pair would take 400 million comparisons."""
    angle = np.linspace(0, 2 * np.pi, 20_000, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], 1)
    faces = np.stack([np.zeros(20_000), 1 + np.arange(20_000), 1 + (np.arange(20_000) + 1) % 20_000], 1)
    mesh = trimesh.Trimesh(np.vstack([[0, 0, 1], rim]), faces.astype(int), process=False)
    mesh.export(tmp_path / "cone.off")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    obj = load_mesh(tmp_path / "cone.off")
    assert len(obj.faces) == 20_000
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024 < 400
    outwards = np.einsum("ij,ij->i", obj.normals[:, :2], obj.vertices[:, :2])
    assert outwards.min() > -1e-6


def test_find_meshes(tmp_path):
    hidden = ("x/.hidden/e.glb", ".obj", "._b.glb")
    for name in ("b.glb", "a.OBJ", "notes.txt", "x/c.ply", "x/y/d.gltf", "z.glb.part", "w/f[1].stl", *hidden):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "x/loop").symlink_to(tmp_path)

    def names(pattern):
        return [str(path.relative_to(tmp_path)) for path in find_meshes(pattern)]

    assert names(tmp_path) == ["a.OBJ", "b.glb", "w/f[1].stl", "x/c.ply", "x/y/d.gltf"]
    assert names(f"{tmp_path}/*.glb") == ["b.glb"]
    assert names(f"{tmp_path}/x/**") == ["x/c.ply", "x/y/d.gltf"]
    assert names(f"{tmp_path}/**/*.gltf") == ["x/y/d.gltf"]
    assert names(f"{tmp_path}/**/y/*") == ["x/y/d.gltf"]
    assert names(f"{tmp_path}/[xw]/*") == ["w/f[1].stl", "x/c.ply"]
    assert names(f"{tmp_path}/w/f[1].stl") == ["w/f[1].stl"]
    assert names(tmp_path / "b.glb") == ["b.glb"]
    (tmp_path / "others").mkdir()
    (tmp_path / "others/chair.FBX").touch()
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked/models").symlink_to(tmp_path / "x")
    for pattern, message in {
        f"{tmp_path}/absent": "no such file or folder",
        f"{tmp_path}/absent/*.glb": "no folder .*absent; expected one before the first wildcard",
        f"{tmp_path}/*.fbx": r"no mesh found; expected files ending in [a-z., ]+$",  # not below it, as the pattern
        f"{tmp_path}/others": r"; chair\.FBX is there: export it as GLB, from Blender or with assimp$",
        f"{tmp_path}/others/chair.*": r"; chair\.FBX is there: export it as GLB",
        f"{tmp_path}/linked": r"; models is a link to a folder, which is not entered: name the folder itself$",
        f"{tmp_path}/notes.txt": "no mesh found",
        f"{tmp_path}/.obj": "no mesh found",
    }.items():
        with pytest.raises(UnirenderError, match=message):
            list(find_meshes(pattern))


def test_folders_that_cannot_be_listed_do_not_stop_the_search(tmp_path, monkeypatch):
    for name in ("a/1.glb", "locked/2.glb", "shut/4.glb", "z/3.glb"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    scandir = os.scandir

    def refusing(path):
        if Path(path).name in ("locked", "shut"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    missed = []
    found = [path.name for path in find_meshes(tmp_path, lambda *folder: missed.append(folder))]
    assert found == ["1.glb", "3.glb"]
    assert missed == [(tmp_path / name, "Permission denied") for name in ("locked", "shut")]
    search = find_meshes(tmp_path)  # without a place to report to: everything, then an error
    assert [next(search).name, next(search).name] == found
    with pytest.raises(
        UnirenderError, match=r"locked: cannot be listed \(Permission denied\), nor can 1 other folders"
    ):
        next(search)
    with pytest.raises(UnirenderError, match=r"locked: cannot be listed \(Permission denied\); check"):
        list(find_meshes(tmp_path / "locked", lambda *folder: missed.append(folder)))


def test_find_meshes_streams(tmp_path):
    """The first of 2,000 files comes before the second folder is looked at."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for i in range(2_000):
        (tmp_path / "a" / f"{i:05d}.glb").touch()
    found = find_meshes(tmp_path)
    assert next(found).name == "00000.glb"
    (tmp_path / "b" / "late.glb").touch()
    rest = list(found)
    assert len(rest) == 2_000
    assert rest[-1].name == "late.glb"
    assert rest[:-1] == sorted(rest[:-1])
