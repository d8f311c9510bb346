"""Mixed meshes: placement and normals of the parts, what is written is what was mixed, and the command around it."""

import os
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from gltf_files import png, random_pixels
from PIL import Image

from unirender.cli import main
from unirender.color import srgb_decode
from unirender.errors import UnirenderError, UsageError
from unirender_reference.folder_lock import locked
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.load import read_model
from unirender_reference.meshes.mix import draw_count, mixed, pictures_of
from unirender_reference.meshes.surface import IDENTITY, Material, Model, Piece, Texture, Wrap
from unirender_reference.meshes.write_obj import write_obj
from unirender_reference.mix_command import MixMeshes
from unirender_reference.mix_folder import mix_meshes


def write_solid(folder, name: str, solid: trimesh.Trimesh | None = None, picture: int | None = None):
    """A box (or another solid) with flat normals; its texture coordinates are the points' x and y."""
    box = trimesh.creation.box((1, 2, 3)) if solid is None else solid
    lines = [f"mtllib {name}.mtl", "usemtl paint"]
    lines += [f"v {x} {y} {z}\nvt {x} {y}" for x, y, z in box.vertices]
    lines += [f"vn {x} {y} {z}" for x, y, z in box.face_normals]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}/{k + 1}" for i in face) for k, face in enumerate(box.faces)]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
    color = "Kd 0.5 0.25 0.75"
    if picture is not None:
        (folder / f"{name}.png").write_bytes(png(np.repeat(np.repeat(random_pixels(picture, 4, 4), 16, 0), 16, 1)))
        color = f"map_Kd {name}.png"
    (folder / f"{name}.mtl").write_text(f"newmtl paint\n{color}\n")
    return folder / f"{name}.obj"


def corners(piece: Piece) -> np.ndarray:
    return piece.vertices[piece.faces]


def flat_normals(piece: Piece) -> np.ndarray:
    a, b, c = np.moveaxis(corners(piece), 1, 0)
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


@pytest.mark.parametrize("seed", range(3))
def test_normals_stay_those_of_the_faces(tmp_path, seed):
    """Of icosahedra, whose faces look along no axis: they are stretched by the inverse transpose."""
    model = read_model(write_solid(tmp_path, "a", trimesh.creation.icosahedron()))
    mix = mixed([model, model, model], [], np.random.default_rng(seed))
    assert len(mix.pieces) == 3
    for piece in mix.pieces:
        assert piece.normals is not None
        assert piece.normals == pytest.approx(np.repeat(flat_normals(piece)[:, None], 3, 1), abs=1e-5)
        assert trimesh.Trimesh(piece.vertices, piece.faces).volume > 0  # no face is turned round
    first = corners(mix.pieces[0]).reshape(-1, 3)
    assert (first.min(0) + first.max(0)) / 2 == pytest.approx(np.zeros(3), abs=1e-9)


def test_parts_are_stretched(tmp_path):
    """The angle between two faces of an icosahedron is no longer 41.8 degrees; of two in five it is."""
    model = read_model(write_solid(tmp_path, "a", trimesh.creation.icosahedron()))
    kept = 0
    for seed in range(200):
        normals = flat_normals(mixed([model, model], [], np.random.default_rng(seed)).pieces[1])
        kept += abs(normals[0] @ normals[1] - np.sqrt(5) / 3) < 1e-4
    assert kept == pytest.approx(80, abs=28)  # four standard deviations


def test_materials_keep_their_colour_or_take_another(tmp_path):
    box, other = write_solid(tmp_path, "a", picture=1), write_solid(tmp_path, "b", picture=2)
    model, pictures = read_model(box), pictures_of(read_model(other))
    assert len(pictures) == 1
    own = pictures_of(model)[0].texels
    kinds = {"own": 0, "other": 0, "colour": 0}
    for seed in range(400):
        albedo = mixed([model], pictures, np.random.default_rng(seed)).pieces[0].material.channels["albedo"]
        if not isinstance(albedo, Texture):
            kinds["colour"] += 1
            assert albedo.shape == (3,)
            assert 0 <= albedo.min() <= albedo.max() <= 1
        else:
            kinds["own" if albedo.texels is own else "other"] += 1
    assert kinds["own"] == pytest.approx(200, abs=40)  # four standard deviations
    assert kinds["other"] == pytest.approx(100, abs=35)
    assert kinds["colour"] == pytest.approx(100, abs=35)
    counts = np.bincount([draw_count(np.random.default_rng(seed)) for seed in range(400)], minlength=4)
    assert counts[0] == 0
    assert counts[1:] == pytest.approx([200, 100, 100], abs=40)


def test_a_colour_takes_the_place_of_vertex_colours(tmp_path):
    """Of a changed material; one that kept its colour is multiplied by them as before."""
    model = read_model(write_solid(tmp_path, "a"))
    dark = replace(model.pieces[0], colors=np.full((len(model.pieces[0].faces), 3, 3), 0.1))
    changed = 0
    for seed in range(40):
        piece = mixed([Model([dark], frozenset())], [], np.random.default_rng(seed)).pieces[0]
        same = piece.material.channels["albedo"] is dark.material.channels["albedo"]
        assert (piece.colors is not None) == same
        changed += not same
    assert 0 < changed < 40


def test_parts_lie_in_the_box_of_the_first(tmp_path):
    """A wedge, whose box is not where it was before once it is turned."""
    corner = np.array([[0, 0, 0], [10, 0, 0], [0, 1, 0], [0, 0, 3]], float)
    wedge = trimesh.Trimesh(corner, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    model = read_model(write_solid(tmp_path, "a", wedge))
    block = read_model(write_solid(tmp_path, "b"))
    for seed in range(60):
        first, *others = mixed([model, block, block], [], np.random.default_rng(seed)).pieces
        box = corners(first).reshape(-1, 3)
        for piece in others:
            points = corners(piece).reshape(-1, 3)
            middle = (points.min(0) + points.max(0)) / 2
            assert (middle >= box.min(0) - 1e-9).all()
            assert (middle <= box.max(0) + 1e-9).all()


def a_texture(side: int, wrap: tuple[Wrap, Wrap] = ("repeat", "repeat"), transform=IDENTITY) -> Texture:
    """Random colours, each texel another."""
    return Texture(srgb_decode(random_pixels(5, side, side) / 255).astype(np.float32), 0, transform, wrap)


def a_piece(albedo: Texture | np.ndarray, shift: float = 0.0, **attributes) -> Piece:
    """A quad with coordinates on it."""
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float) + shift
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    parts: dict = {"normals": None, "uv": {0: quad[faces][..., :2] - shift}, "colors": None} | attributes
    return Piece(vertices=quad, faces=faces, material=Material({"albedo": albedo}), **parts)


def written(tmp_path, *pieces: Piece) -> list[Piece]:
    (tmp_path / "out").mkdir()
    model = read_model(write_obj(Model(list(pieces), frozenset()), tmp_path / "out", "mix", ["of a", "of b"]))
    assert model.ignored == frozenset()
    return model.pieces


def looked_up(piece: Piece) -> np.ndarray:
    """Where the corners look into the picture, as `Patch.lookup` says it."""
    texture = piece.material.channels["albedo"]
    assert isinstance(texture, Texture)
    return piece.uv[0] @ texture.transform[:, :2].T + texture.transform[:, 2]


def test_geometry_and_colours_are_read_back(tmp_path):
    """To the digits of the text; vertex colours as their mean, of a gradient."""
    normals = np.broadcast_to([0.6, 0.0, 0.8], (2, 3, 3))
    gradient = np.linspace(0, 1, 18).reshape(2, 3, 3)
    colour = np.array([0.2, 0.4, 0.8])
    pieces = [a_piece(colour, normals=normals), a_piece(colour, 2.0, colors=gradient), a_piece(colour, 4.0)]
    back = written(tmp_path, *pieces)
    by_place = {round(float(piece.vertices[piece.faces].min()), 3): piece for piece in back}
    assert len(back) == 3  # with and without normals are materials of their own
    for was, shift in zip(pieces, (0.0, 2.0, 4.0), strict=True):
        now = by_place[shift]
        assert corners(now) == pytest.approx(corners(was), abs=1e-6)
        assert (now.normals is None) == (was.normals is None)
        albedo = now.material.channels["albedo"]
        factor = 1 if was.colors is None else gradient.reshape(-1, 3).mean(0)
        assert albedo == pytest.approx(colour * factor, abs=1e-5)
    assert by_place[0.0].normals == pytest.approx(normals, abs=1e-6)
    head = (tmp_path / "out" / "mix.obj").read_text().splitlines()[:3]
    assert head == ["# of a", "# of b", "mtllib mix.mtl"]


def test_a_small_picture_is_read_back_to_the_texel(tmp_path):
    """Through coordinates with an offset, a scale and another direction."""
    texture = a_texture(4, transform=np.array([[0.5, 0.1, 0.25], [0.0, -0.5, 0.75]]))
    was = a_piece(texture)
    (now,) = written(tmp_path, was)
    after = now.material.channels["albedo"]
    assert isinstance(after, Texture)
    assert after.texels == pytest.approx(texture.texels, abs=2e-6)
    assert looked_up(now) == pytest.approx(looked_up(was), abs=1e-6)
    assert after.wrap == ("repeat", "repeat")


def test_a_large_picture_is_reduced_and_compressed(tmp_path):
    texels = np.kron(a_texture(8).texels, np.ones((128, 128, 1))).astype(np.float32)
    (now,) = written(tmp_path, a_piece(Texture(texels, wrap=("clamp", "clamp"))))
    after = now.material.channels["albedo"]
    assert isinstance(after, Texture)
    assert after.texels.shape == (512, 512, 3)
    inside = after.texels.reshape(8, 64, 8, 64, 3)[:, 16:48, :, 16:48].mean((1, 3))
    assert inside == pytest.approx(a_texture(8).texels, abs=0.01)
    assert after.wrap == ("clamp", "clamp")


def test_materials_of_one_picture_share_its_file(tmp_path):
    texture = a_texture(8)
    other = replace(texture, wrap=("clamp", "clamp"))
    back = written(tmp_path, a_piece(texture), a_piece(other, 2.0))
    assert len(back) == 2
    assert len(list((tmp_path / "out").glob("*.png"))) == 1


def test_flat_models_without_extent_are_refused():
    point = Piece(np.zeros((3, 3)), np.array([[0, 1, 2]]), None, {}, None, Material({"albedo": np.ones(3)}))
    with pytest.raises(UnirenderError, match="extent of 0, expected more than 0"):
        mixed([Model([point], frozenset())], [], np.random.default_rng(0))


def folder_of_boxes(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for i in range(4):
        write_solid(folder, f"box{i}", trimesh.creation.box((1, 1 + i, 2)), picture=i if i % 2 else None)
    return folder


def files(folder) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def shapes(folder) -> list[np.ndarray]:
    return [load_mesh(path).vertices for path in sorted(folder.rglob("*.obj"))]


def test_a_stopped_run_goes_on_with_the_same_files(tmp_path, monkeypatch):
    """Stopped while a mix is written, which leaves nothing of it; another seed makes other shapes."""
    meshes = folder_of_boxes(tmp_path)
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    report = mix_meshes(MixMeshes((str(meshes),), whole, count=4, seed=3))
    assert (report.made, report.refused, report.too_large) == (4, [], 0)
    calls = []

    def full_disk(*arguments):
        calls.append(write_obj(*arguments))
        if len(calls) == 3:
            raise OSError("disk full")

    with monkeypatch.context() as patched:
        patched.setattr("unirender_reference.mix_folder.write_obj", full_disk)
        with pytest.raises(UnirenderError, match=r"mix-3-00002: cannot be written \(disk full\); mend that"):
            mix_meshes(MixMeshes((str(meshes),), stopped, count=4, seed=3))
    assert sorted(p.name for p in stopped.iterdir()) == ["mix-3-00000", "mix-3-00001", "mix.json"]
    (stopped / ".mix-3-00002.killed").mkdir()
    (stopped / ".mix.json.killed.partial").write_text("{")
    assert mix_meshes(MixMeshes((str(meshes),), stopped, count=4, seed=3)).made == 2
    assert files(whole) == files(stopped)
    assert not list(stopped.glob(".mix*"))
    mix_meshes(MixMeshes((str(meshes),), tmp_path / "another", count=4, seed=4))
    assert [len(v) for v in shapes(whole)] != [len(v) for v in shapes(tmp_path / "another")]
    for path in sorted(whole.rglob("*.obj")):
        obj = load_mesh(path)  # as a data set reads them
        assert obj.roughness is None
        assert obj.metallic is None
    firsts = [p.read_text().splitlines()[0] for p in sorted(whole.rglob("*.obj"))]
    assert {*firsts} == {f"# made of meshes/box{i}.obj" for i in range(4)}  # each before any comes again


def test_borrowed_pictures_are_named(tmp_path):
    """Each OBJ names the meshes whose pictures it has: of two boxes with pictures, by their first texels."""
    meshes = folder_of_boxes(tmp_path)
    mix_meshes(MixMeshes((str(meshes),), tmp_path / "out", count=12))
    own = {read_texel(meshes / f"box{i}.png"): f"box{i}.obj" for i in (1, 3)}
    borrowed = 0
    for folder in sorted((tmp_path / "out").glob("mix-*")):
        text = next(folder.glob("*.obj")).read_text()
        named = [line for line in text.splitlines() if line.startswith("#")]
        assert {own[read_texel(p)] for p in folder.glob("*.png")} <= {line.split("/")[-1] for line in named}
        borrowed += any("with a picture of" in line for line in named)
    assert 0 < borrowed < 12


def read_texel(path) -> tuple[int, ...]:
    with Image.open(path) as image:
        value = image.convert("RGB").getpixel((0, 0))
    assert isinstance(value, tuple)
    return tuple(int(x) for x in value)


def test_a_folder_of_other_mixes_is_refused(tmp_path):
    meshes, out = folder_of_boxes(tmp_path), tmp_path / "out"
    options = MixMeshes((str(meshes),), out, count=1, seed=3)
    mix_meshes(options)
    mix_meshes(replace(options, patterns=(f"{meshes}/",)))  # another spelling of the same
    with pytest.raises(UnirenderError, match="holds mixes with seed 3, got 9; repeat that option"):
        mix_meshes(replace(options, seed=9))
    whole = (meshes / "box0.obj").read_text()
    (meshes / "box0.obj").write_text(whole + "# changed\n")
    with pytest.raises(UnirenderError, match=r"its mixes are of other meshes, .* \(4 then, 4 now\); bring those back"):
        mix_meshes(options)
    (meshes / "box0.obj").write_text(whole)
    assert mix_meshes(options).made == 0
    for broken in ("{", "", "[]", "{}"):
        (out / "mix.json").write_text(broken)
        with pytest.raises(UnirenderError, match=r"mix.json: cannot be read"):
            mix_meshes(options)


def test_places_that_would_mix_up_the_sides(tmp_path, monkeypatch):
    """A file of two patterns may be held out by one alone; mixes must not be mixed again."""
    meshes = folder_of_boxes(tmp_path)
    with pytest.raises(UnirenderError, match=r"box0.obj is named by two of the patterns, expected it once"):
        mix_meshes(MixMeshes((str(meshes), f"{meshes}/*.obj"), tmp_path / "out", count=1))
    monkeypatch.chdir(tmp_path)
    inside = MixMeshes(("meshes/**/*.obj",), meshes / "mixed", count=1)
    mix_meshes(inside)
    with pytest.raises(UnirenderError, match=r"which holds one of the meshes that are mixed \(mixed/mix-0-00000"):
        mix_meshes(inside)


def test_a_kill_before_anything_was_made(tmp_path):
    meshes, out = folder_of_boxes(tmp_path), tmp_path / "out"
    out.mkdir()
    (out / ".mix.json.killed.partial").write_text("{")
    assert mix_meshes(MixMeshes((str(meshes),), out, count=1)).made == 1


def test_one_process_writes_at_a_time(tmp_path):
    meshes, out = folder_of_boxes(tmp_path), tmp_path / "out"
    out.mkdir()
    with locked(out), pytest.raises(UnirenderError, match="another run is writing here"):
        mix_meshes(MixMeshes((str(meshes),), out, count=1))


def test_all_that_were_there_are_counted(tmp_path, capsys):
    meshes = folder_of_boxes(tmp_path)
    for count, said in (
        (6, "6 meshes made, 0 were there"),
        (4, "0 meshes made, 6 were there"),
        (7, "1 meshes made, 6"),
    ):
        assert MixMeshes((str(meshes),), tmp_path / "out", count=count).run() == 0
        assert said in capsys.readouterr().out


def test_refused_meshes_are_named_and_others_take_their_place(tmp_path, capsys):
    meshes = folder_of_boxes(tmp_path)
    (meshes / "broken.obj").write_text("v 0 0 0\n")
    with pytest.raises(SystemExit) as end:
        main(["mix-meshes", str(meshes), "--out", str(tmp_path / "out"), "--count", "8"])
    assert end.value.code == 1
    out = capsys.readouterr().out
    assert out.count("refused  mesh") == 1
    assert "broken.obj: has no faces" in out
    assert "8 meshes made, 0 were there" in out
    assert len(list((tmp_path / "out").glob("mix-0-*/*.obj"))) == 8
    none = MixMeshes((str(meshes),), tmp_path / "none", count=1, max_faces=11)
    with pytest.raises(UnirenderError, match=r"4 have more than 11 triangles \(--max-faces\), 1 are refused"):
        mix_meshes(none)
    assert mix_meshes(replace(none, max_faces=12)).made == 1  # nothing was there that held it to 11


def test_names_are_one_line_of_utf8(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    source = write_solid(tmp_path, "a").read_text()
    (meshes / "a.mtl").write_text((tmp_path / "a.mtl").read_text())
    (meshes / os.fsdecode(b"caf\xe9 a\nv 9 9 9 .obj")).write_text(source)
    mix_meshes(MixMeshes((str(meshes),), tmp_path / "out", count=1))
    (path,) = (tmp_path / "out").rglob("*.obj")
    assert path.read_text(encoding="utf-8").splitlines()[0] == r"# made of meshes/caf\udce9 a v 9 9 9 .obj"


def test_the_test_side_is_left_out(tmp_path):
    meshes = folder_of_boxes(tmp_path)
    mix_meshes(MixMeshes((str(meshes),), tmp_path / "out", count=12, holdout=4))
    made = "".join(p.read_text() for p in (tmp_path / "out").rglob("*.obj"))
    assert "made of meshes/box2.obj" in made
    assert "box3.obj" not in made


def test_bad_options(tmp_path):
    meshes = str(folder_of_boxes(tmp_path))
    with pytest.raises(UsageError, match="got no folder"):
        MixMeshes((), tmp_path / "out").check()
    with pytest.raises(UsageError, match="--count 0: expected 1 or more"):
        MixMeshes((meshes,), tmp_path / "out", count=0).check()
    with pytest.raises(UsageError, match="--holdout: got 1, expected 0 or at least 2"):
        MixMeshes((meshes,), tmp_path / "out", holdout=1).check()
    with pytest.raises(UsageError, match="--max-faces: got 500,000, expected at most 333,333"):
        MixMeshes((meshes,), tmp_path / "out", max_faces=500_000).check()
    with pytest.raises(UsageError, match=r"which lies in .*, whose meshes are mixed"):
        MixMeshes((meshes,), tmp_path / "meshes" / "mixed").check()
    (tmp_path / "other" / "notes").mkdir(parents=True)
    with pytest.raises(UnirenderError, match=r"is not empty and holds no mixes \(notes\)"):
        mix_meshes(MixMeshes((meshes,), tmp_path / "other", count=1))
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "sub"):
        with pytest.raises(UnirenderError, match="cannot be made"):
            mix_meshes(MixMeshes((meshes,), out, count=1))
