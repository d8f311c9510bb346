"""Mixed meshes: placement and normals of the parts, what is written is what was mixed, and the command around it."""

import json

import numpy as np
import pytest
import trimesh
from gltf_files import png, random_pixels

from unirender.color import srgb_decode
from unirender.errors import UnirenderError, UsageError
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.load import read_model
from unirender_reference.meshes.mix import draw_count, mixed, pictures_of
from unirender_reference.meshes.surface import Material, Model, Piece, Texture
from unirender_reference.meshes.write_obj import write_obj
from unirender_reference.mix_command import MixMeshes, mix_meshes


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


@pytest.mark.parametrize("seed", range(12))
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


def test_what_is_written_is_read_back(tmp_path):
    """Geometry to the digits of the text, a picture to those of JPEG, a colour times a mean of vertex colours."""
    model = read_model(write_solid(tmp_path, "a", picture=3))
    plain = read_model(write_solid(tmp_path, "b"))
    piece = plain.pieces[0]
    colored = Piece(
        piece.vertices, piece.faces, None, {}, np.full((len(piece.faces), 3, 3), 0.5), piece.material, piece.step
    )
    (tmp_path / "out").mkdir()
    path = write_obj(Model([*model.pieces, *plain.pieces, colored], frozenset()), tmp_path / "out", "mix")
    back = read_model(path)
    assert len(back.pieces) == 3
    for was, now in zip([model.pieces[0], piece, colored], back.pieces, strict=True):
        assert corners(now) == pytest.approx(corners(was), abs=1e-6)
        assert (now.normals is None) == (was.normals is None)
        if was.normals is not None:
            assert now.normals == pytest.approx(was.normals, abs=1e-6)
    was, now = (one.pieces[0] for one in (model, back))
    before, after = was.material.channels["albedo"], now.material.channels["albedo"]
    assert isinstance(before, Texture)
    assert isinstance(after, Texture)
    assert now.uv[0] == pytest.approx(was.uv[0], abs=1e-6)
    assert after.texels.mean((0, 1)) == pytest.approx(before.texels.mean((0, 1)), abs=0.01)
    colour = srgb_decode(np.array([0.5, 0.25, 0.75]))
    assert back.pieces[1].material.channels["albedo"] == pytest.approx(colour, abs=1e-5)
    assert back.pieces[2].material.channels["albedo"] == pytest.approx(colour * 0.5, abs=1e-5)


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


def test_a_stopped_run_goes_on_with_the_same_files(tmp_path):
    meshes = folder_of_boxes(tmp_path)
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert mix_meshes(MixMeshes((str(meshes),), whole, count=6, seed=3)) == []
    mix_meshes(MixMeshes((str(meshes),), stopped, count=2, seed=3))
    mix_meshes(MixMeshes((str(meshes),), stopped, count=6, seed=3))
    assert files(whole) == files(stopped)
    assert len(list(whole.glob("mix-3-*"))) == 6
    another = tmp_path / "another"
    mix_meshes(MixMeshes((str(meshes),), another, count=6, seed=4))
    assert {n.split("-", 2)[2]: d for n, d in files(another).items() if "-" in n} != {
        n.split("-", 2)[2]: d for n, d in files(whole).items() if "-" in n
    }
    for path in sorted(whole.rglob("*.obj")):
        obj = load_mesh(path)  # as a data set reads them
        assert obj.roughness is None
        assert obj.metallic is None
    firsts = [p.read_text().splitlines()[0] for p in sorted(whole.rglob("*.obj"))]
    assert {*firsts[:4]} == {f"# made of box{i}.obj" for i in range(4)}  # each before any comes again
    with pytest.raises(UnirenderError, match="holds mixes with seed 3, got 9"):
        mix_meshes(MixMeshes((str(meshes),), whole, count=6, seed=9))


def test_refused_meshes_are_named_and_others_take_their_place(tmp_path, capsys):
    meshes = folder_of_boxes(tmp_path)
    (meshes / "broken.obj").write_text("v 0 0 0\n")
    assert MixMeshes((str(meshes),), tmp_path / "out", count=8).run() == 1
    out = capsys.readouterr().out
    assert out.count("refused  mesh") == 1
    assert "broken.obj: has no faces" in out
    assert len(list((tmp_path / "out").glob("mix-0-*/*.obj"))) == 8
    with pytest.raises(UnirenderError, match=r"none of the 5 meshes can be used \(1 refused, 4 with more than 11"):
        mix_meshes(MixMeshes((str(meshes),), tmp_path / "none", count=1, max_faces=11))
    assert json.loads((tmp_path / "none" / "mix.json").read_text())["max_faces"] == 11


def test_the_test_side_is_left_out(tmp_path):
    meshes = folder_of_boxes(tmp_path)
    mix_meshes(MixMeshes((str(meshes),), tmp_path / "out", count=12, holdout=4))
    made = "".join(p.read_text() for p in (tmp_path / "out").rglob("*.obj"))
    assert "made of box2.obj" in made
    assert "box3.obj" not in made


def test_bad_options(tmp_path):
    meshes = str(folder_of_boxes(tmp_path))
    with pytest.raises(UsageError, match="got no folder"):
        MixMeshes((), tmp_path / "out").check()
    with pytest.raises(UsageError, match="--count: got 0, expected at least 1"):
        MixMeshes((meshes,), tmp_path / "out", count=0).check()
    with pytest.raises(UsageError, match="--holdout: got 1, expected 0 or at least 2"):
        MixMeshes((meshes,), tmp_path / "out", holdout=1).check()
    with pytest.raises(UnirenderError, match="is no folder of mixes and not empty"):
        mix_meshes(MixMeshes((meshes,), tmp_path, count=1))
