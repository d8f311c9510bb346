"""PLY, STL and OFF through trimesh: geometry, vertex and face colours (sRGB-coded), one texture of a PLY.

trimesh trusts the counts of a header, so those are held against the size of the file first.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.colors import is_opaque, unit_colors
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.images import ImageBudget, texels_of
from unirender_reference.meshes.limits import (
    MAX_FACES,
    MAX_TEXTURE,
    MAX_VERTICES,
    check_bytes,
    check_faces,
    float32_step,
)
from unirender_reference.meshes.mtl import DEFAULT_ALBEDO
from unirender_reference.meshes.off_lines import OffLines, read_off_lines
from unirender_reference.meshes.ply_elements import PlyHeader, read_header
from unirender_reference.meshes.ply_triangles import COLORS, triangles_ply
from unirender_reference.meshes.stl_facets import whole_stl
from unirender_reference.meshes.surface import BARE, Channel, Material, Model, Piece, Texture

HEAD = 65536  # bytes that are looked at before trimesh reads the file
WHITE = Material({"albedo": np.ones(3, np.float32)})
TEXTURE_COMMENT = re.compile(rb"TextureFile\s+(.+)", re.IGNORECASE)


def read_through_trimesh(path: Path, folder: ModelFolder) -> Model:
    """Reads a PLY, STL or OFF file.

    Args:
        path: the file.
        folder: where the texture of a PLY may lie.

    Raises:
        UnirenderError: the file claims more than it holds, or a limit is exceeded; also whatever trimesh raises.
    """
    length, kind = path.stat().st_size, path.suffix.lower()[1:]
    check_bytes(length, "the file")
    with path.open("rb") as file:
        head = file.read(HEAD)
    texture, off, rewritten, exact = None, OffLines(), None, False
    ignored: set[str] = set()
    if kind == "ply":
        header = read_header(head)
        _check_claims(header, length)
        texture = _texture(folder, header)
        rewritten = triangles_ply(path, header, textured=texture is not None)
        exact = header.text or "x" in header.elements["vertex"].doubles()
    elif kind == "off":
        off = read_off_lines(path)
        rewritten, exact = off.triangles, True
        ignored = set(off.ignored)
    else:
        rewritten, ignored = whole_stl(path, head)
    scene = trimesh.load_scene(path if rewritten is None else rewritten, file_type=kind, process=False)
    pieces = []
    for mesh in scene.geometry.values():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            check_faces(len(mesh.faces))
            if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
                raise UnirenderError(f"its faces index outside the {len(mesh.vertices):,} vertices; export it again")
            piece = _piece(mesh, texture, step=0.0 if exact else float32_step(mesh.vertices))
            ignored |= {BARE} if texture is not None and not piece.uv else set()
            ignored |= {"alpha"} if piece.colors is not None and not _is_opaque(mesh) else set()
            if off.normals is not None:
                piece = replace(piece, normals=off.normals[piece.faces])
            if off.colored:
                piece = replace(piece, colors=off.corners(piece.faces), material=WHITE)
            pieces.append(piece)
    return Model(pieces, frozenset(ignored))


def _check_claims(header: PlyHeader, length: int) -> None:
    """Counts that the file cannot hold; a row takes a byte at least."""
    for name, count in ((name, element.rows) for name, element in header.elements.items()):
        limit = MAX_FACES if name == "face" else MAX_VERTICES
        if count > limit:
            raise UnirenderError(f"claims {count:,} of element {name}, expected at most {limit:,}; decimate the mesh")
        if count > length:
            raise UnirenderError(f"truncated: claims {count:,} of element {name} in {length:,} bytes; copy it again")


def _texture(folder: ModelFolder, header: PlyHeader) -> Texture | None:
    """The picture that a PLY header names, as MeshLab writes it."""
    named = [TEXTURE_COMMENT.fullmatch(comment) for comment in header.comments]
    names = list(dict.fromkeys(found[1] for found in named if found))
    if not names:
        return None
    if len(names) > 1:
        raise UnirenderError(
            f"names {len(names)} textures, expected one: which of them a face has is not read; export it as OBJ or GLB"
        )
    name = names[0].decode("utf-8", "surrogateescape")
    image = ImageBudget().open(folder.read(name, "texture"), repr(name))
    return Texture(texels_of(image, repr(name), MAX_TEXTURE, "RGB", srgb_decode))


def _piece(mesh: trimesh.Trimesh, texture: Texture | None, step: float) -> Piece:
    """The mesh as a piece with its texture, or else its colours, or else the default albedo."""
    faces = np.asarray(mesh.faces, np.int64)
    vertices = np.asarray(mesh.vertices, np.float64)
    stored = mesh._cache["vertex_normals"]  # the file's, or None; the property would compute them
    uv = np.asarray(getattr(mesh.visual, "uv", None), np.float64)  # of any shape
    textured = texture is not None and uv.shape == (len(vertices), 2) and bool(np.isfinite(uv).all())
    colors = None if textured else _colors(mesh, faces)
    albedo: Channel = np.full(3, 1.0 if colors is not None else DEFAULT_ALBEDO, np.float32)
    if texture is not None and colors is None:
        albedo = texture if textured else texture.texels.mean((0, 1))
    return Piece(
        vertices=vertices,
        faces=faces,
        normals=None if stored is None else np.asarray(stored, np.float64)[faces],
        uv={0: (uv * [1, -1] + [0, 1])[faces]} if textured else {},  # trimesh: v from below
        colors=colors,
        material=Material({"albedo": albedo}),
        step=step,
    )


def _colors(mesh: trimesh.Trimesh, faces: np.ndarray) -> Float[np.ndarray, "m 3 3"] | None:
    """Linear colours of the corners, from the vertices or the faces."""
    kind = getattr(mesh.visual, "kind", None)
    stored = _stored_colors(mesh, kind) if kind in ("vertex", "face") else None
    if stored is None:
        return None
    linear = srgb_decode(unit_colors(stored).astype(np.float32)).astype(np.float64)
    return linear[faces] if kind == "vertex" else np.repeat(linear[:, None], 3, axis=1)


def _stored_colors(mesh: trimesh.Trimesh, element: str) -> np.ndarray | None:
    """Red, green and blue of a PLY's vertices or faces in the type that the file has; trimesh takes floats as of 1."""
    data = mesh.metadata.get("_ply_raw", {}).get(element, {}).get("data")
    if data is None or not set(COLORS) <= set(data.dtype.names):
        return None
    return np.stack([data[name] for name in COLORS], axis=-1)


def _is_opaque(mesh: trimesh.Trimesh) -> bool:
    """Whether the element that has the colours of a PLY has no alpha, or one of 1."""
    data = mesh.metadata["_ply_raw"][getattr(mesh.visual, "kind", None)]["data"]
    return "alpha" not in data.dtype.names or is_opaque(data["alpha"])
