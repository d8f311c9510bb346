"""Users' meshes: GLB, glTF, OBJ, PLY, STL, OFF to a `MeshObject`, or one sentence why not.

The scene is flattened and its materials are packed into one atlas. `docs/meshes.md` says what is read from each
format, in which colour space, what is ignored, and every reason for a refusal.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender.arguments import as_path
from unirender.errors import UnirenderError
from unirender_reference.meshes.atlas import build_atlas
from unirender_reference.meshes.doubles import without_doubles
from unirender_reference.meshes.find import OTHERS, SUFFIXES
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.gltf_scene import read_gltf
from unirender_reference.meshes.limits import check_geometry
from unirender_reference.meshes.normals import piece_normals
from unirender_reference.meshes.obj import read_obj
from unirender_reference.meshes.off import read_off
from unirender_reference.meshes.ply import read_ply
from unirender_reference.meshes.stl import read_stl
from unirender_reference.meshes.surface import Model, Piece
from unirender_reference.meshes.tiles import Patch
from unirender_reference.shapes import MeshObject, Sphere, bounding_sphere
from unirender_reference.shapes.surface import split_corners

SMALLER = "sharpness of smaller textures"  # among what is ignored
READERS = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".ply": read_ply,
    ".stl": lambda path, folder: read_stl(path),
    ".off": lambda path, folder: read_off(path),
}


def load_mesh(path: str | Path, root: Path | None = None) -> MeshObject:
    """Loads a mesh, moved and scaled into the unit sphere; its own normals are kept where it has them.

    Args:
        path: a GLB, glTF, OBJ, PLY, STL or OFF file; +y is up and +z faces the camera, as in glTF.
        root: a folder of models that may share textures: what the file names is read from there and from the file's
            own folder, and from nowhere else. None: from its own folder alone.

    Returns:
        The object. glTF objects always have roughness and metallic of their own, OBJ objects where their MTL has the
        PBR keywords. `provenance["ignored"]` lists what the file has and the contract has not.

    Raises:
        UnirenderError: one sentence with the reason: a missing, damaged or dangerous file (see `limits`), no faces,
            broken coordinates, a missing texture.
    """
    return load_mesh_placed(path, root)[0]


def load_mesh_placed(path: str | Path, root: Path | None = None) -> tuple[MeshObject, Sphere]:
    """Loads a mesh like `load_mesh`, and says where it stood: cameras in the file's units move along with it."""
    path = as_path(path, "mesh")
    with _one_sentence(path):
        return _assembled(path, _read(path, root))


def read_model(path: str | Path, root: Path | None = None) -> Model:
    """Reads a mesh as pieces with materials of their own, in its own units; arguments and errors are `load_mesh`'s."""
    path = as_path(path, "mesh")
    with _one_sentence(path):
        model = _read(path, root)
        check_geometry(_corners(model.pieces), max(piece.step for piece in model.pieces))
        return model


def _read(path: Path, root: Path | None) -> Model:
    """The pieces that have faces; at least one."""
    if not path.is_file():
        raise UnirenderError(f"no such file; expected one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() not in SUFFIXES:
        advice = OTHERS.get(path.suffix.lower(), "convert it")
        raise UnirenderError(f"got suffix {path.suffix!r}, expected one of {', '.join(SUFFIXES)}; {advice}")
    if path.stat().st_size == 0:
        raise UnirenderError("is empty; copy it again")
    model = READERS[path.suffix.lower()](path, ModelFolder(path, root))
    pieces = [piece for piece in model.pieces if len(piece.faces)]
    if not pieces:
        raise UnirenderError("has no faces, expected a triangle mesh; is it a point cloud?")
    return Model(pieces, model.ignored)


def _corners(pieces: list[Piece]) -> Float[np.ndarray, "m 3 3"]:
    return np.concatenate([piece.vertices[piece.faces] for piece in pieces])


@contextlib.contextmanager
def _one_sentence(path: Path) -> Iterator[None]:
    """Whatever goes wrong with a file becomes a `UnirenderError` that names it; readers say what to do."""
    try:
        yield
    except UnirenderError as error:
        raise UnirenderError(f"mesh {path}: {error}") from error
    except MemoryError as error:
        raise UnirenderError(f"mesh {path}: needs more memory than there is; reduce the model") from error
    except Exception as error:  # parsers raise whatever a broken file makes them raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UnirenderError(
            f"mesh {path}: cannot be read as {path.suffix.lower()} ({reason}); export it again"
        ) from error


def _grouped(pieces: list[Piece]) -> list[list[Piece]]:
    """The pieces of one material that have the same attributes, together."""
    groups: dict[tuple[int, frozenset[int]], list[Piece]] = {}
    for piece in pieces:
        groups.setdefault((id(piece.material), frozenset(piece.uv)), []).append(piece)
    return list(groups.values())


def _patch(group: list[Piece]) -> Patch:
    colored = any(piece.colors is not None for piece in group)
    colors = [np.ones((len(p.faces), 3, 3)) if p.colors is None else p.colors for p in group]
    return Patch(
        points=_corners(group),
        uv={i: np.concatenate([piece.uv[i] for piece in group]) for i in group[0].uv},
        colors=np.concatenate(colors) if colored else None,
        material=group[0].material,
    )


def _assembled(path: Path, model: Model) -> tuple[MeshObject, Sphere]:
    """The object of a model's pieces, in the unit sphere, and where it stood."""
    single, doubles = without_doubles(model.pieces)
    groups = _grouped(single)
    pieces = [piece for group in groups for piece in group]
    patches = [_patch(group) for group in groups]
    check_geometry(_corners(pieces), max(piece.step for piece in pieces))
    atlas = build_atlas(patches)
    sphere = bounding_sphere(np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces]))
    points, corners = _one_array(pieces)
    normals_at_corners = np.concatenate([piece_normals(piece) for piece in pieces])
    vertices, faces, normals, uv = split_corners(
        sphere.to_unit(points).astype(np.float32), corners, normals_at_corners, atlas.uv
    )
    smaller = {SMALLER} if any(group[0].material.has_smaller_textures() for group in groups) else set()
    maps = atlas.maps
    if "roughness" in maps and uv is None:
        uv = np.zeros((len(vertices), 2), np.float32)
    albedo = np.clip(maps["albedo"], 0, 1)
    obj = MeshObject(
        name=path.stem.replace(".", "-"),
        family="mesh",
        vertices=vertices,
        faces=faces,
        normals=normals,
        uv=uv,
        albedo=albedo[0, 0] if albedo.shape[:2] == (1, 1) else albedo,
        roughness=_scalar_map(maps.get("roughness")),
        metallic=_scalar_map(maps.get("metallic")),
        normal_map=maps["normal"] if "normal" in maps and uv is not None else None,
        provenance={
            "source": "file",
            "file": path.name,
            "meshes": str(len(pieces)),
            "double_faces": str(doubles),
            "textures": str(atlas.tiles),
            "textures_averaged": str(atlas.averaged),
            "textures_baked": str(atlas.baked),
            "ignored": ", ".join(sorted(model.ignored | smaller)),
        },
    )
    return obj, sphere


def _one_array(pieces: list[Piece]) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """The vertices of all pieces, those of pieces that share an array (an OBJ's do) once, and the faces among them."""
    arrays = {id(piece.vertices): piece.vertices for piece in pieces}
    starts = dict(zip(arrays, np.cumsum([0, *map(len, arrays.values())])[:-1], strict=True))
    faces = np.concatenate([piece.faces + starts[id(piece.vertices)] for piece in pieces])
    return np.concatenate(list(arrays.values())), faces


def _scalar_map(texels: Float[np.ndarray, "h w 1"] | None) -> Float[np.ndarray, "i j"] | None:
    """A map in [0, 1]; a constant takes 2 x 2 texels."""
    if texels is None:
        return None
    plane = np.clip(texels[..., 0], 0, 1)
    return np.full((2, 2), plane[0, 0], np.float32) if plane.shape == (1, 1) else np.ascontiguousarray(plane)
