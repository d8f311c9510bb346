"""PLY files: vertices, polygons and strips with their colours (sRGB-coded), normals and one texture.

What the header claims is held against the size of the file before its numbers are read (`ply_elements`).
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.colors import is_opaque, linear_colors
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
from unirender_reference.meshes.ply_elements import PlyColumns, PlyHeader, PlyLists, read_columns, read_header
from unirender_reference.meshes.polygons import fans, strip, triangulate
from unirender_reference.meshes.surface import BARE, Channel, Material, Model, Piece, Texture

HEAD = 65536  # bytes in which the header ends
TEXTURE_COMMENT = re.compile(rb"TextureFile\s+(.+)", re.IGNORECASE)
INDICES = "vertex_indices", "vertex_index"
COORDINATES = "texcoord"  # u and v of each corner of a face
VERTEX_COORDINATES = ("texture_u", "texture_v"), ("u", "v"), ("s", "t")
STRIPS, RESTART = "tristrips", -1  # several strips in one list, with this number between them
NORMAL = "nx", "ny", "nz"
COLORS = "red", "green", "blue"
OTHER_COLORS = ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")
WANTED = {"x", "y", "z", *NORMAL, *COLORS, *OTHER_COLORS[0], *OTHER_COLORS[1], "alpha", *sum(VERTEX_COORDINATES, ())}
Columns = dict[str, np.ndarray]  # (rows,), or (rows, k) of lists of one length


def read_ply(path: Path, folder: ModelFolder) -> Model:
    """Reads a PLY file, text or binary.

    What a polygon has (a colour), its triangles have; the texture coordinates of its corners go with them. Faces of one
    or two corners, and elements other than vertices, faces and strips, are left out.

    Args:
        path: the file.
        folder: where its texture may lie.

    Raises:
        UnirenderError: the file is cut off, its vertices have no x, y and z or its faces no list of them, it has both
            faces and strips, or a limit is exceeded.
    """
    length = path.stat().st_size
    check_bytes(length, "the file")
    with path.open("rb") as file:
        header = read_header(file.read(HEAD))
    _check_claims(header, length)
    texture = _texture(folder, header)
    elements = read_columns(path, header, WANTED)
    vertices = _numbers(elements.get("vertex", {}))
    if missing := [axis for axis in "xyz" if axis not in vertices]:
        raise UnirenderError(f"its vertices have no {', '.join(missing)}, expected x, y and z; export it again")
    points = _stacked(vertices, tuple("xyz"))
    has = [element for element in ("face", STRIPS) if element in elements and header.elements[element].rows]
    if len(has) > 1:
        raise UnirenderError(f"has both faces and {STRIPS}, expected one of them; export it as triangles")
    if not has:
        return Model([], frozenset())
    triangles = _cut(elements["face"], points) if has == ["face"] else {}
    faces = triangles[INDICES[0]] if triangles else _of_strips(_index(elements[STRIPS]))
    if len(faces) and (faces.min() < 0 or faces.max() >= len(points)):
        raise UnirenderError(f"its faces index outside the {len(points):,} vertices; export it again")
    uv = None if texture is None else _coordinates(triangles, vertices, faces)
    colors, opaque = _colors(triangles, vertices, faces) if uv is None else (None, True)
    albedo: Channel = np.full(3, 1.0 if colors is not None else DEFAULT_ALBEDO, np.float32)
    textured = uv is not None and bool(np.isfinite(uv).all())
    if texture is not None and colors is None:
        albedo = texture if textured else texture.texels.mean((0, 1))
    piece = Piece(
        vertices=points,
        faces=faces,
        normals=_stacked(vertices, NORMAL)[faces] if set(NORMAL) <= set(vertices) else None,
        uv={0: uv} if uv is not None and textured else {},
        colors=colors,
        material=Material({"albedo": albedo}),
        step=0.0 if header.text or "x" in header.elements["vertex"].doubles() else float32_step(points),
    )
    ignored = {BARE: texture is not None and not textured, "alpha": not opaque}
    return Model([piece], frozenset(name for name, is_so in ignored.items() if is_so))


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


def _numbers(columns: PlyColumns) -> Columns:
    """The columns that are no lists, with the usual names of colours."""
    single = {name: column for name, column in columns.items() if not isinstance(column, PlyLists)}
    renamed: Mapping[str, str] = {}
    if not set(COLORS) <= set(single):
        renamed = next(
            (dict(zip(names, COLORS, strict=True)) for names in OTHER_COLORS if set(names) <= set(single)), {}
        )
    return {renamed.get(name, name): column for name, column in single.items()}


def _stacked(columns: Columns, names: tuple[str, ...]) -> Float[np.ndarray, "n k"]:
    return np.stack([columns[name].astype(np.float64) for name in names], axis=-1)


def _index(columns: PlyColumns) -> PlyLists:
    """The list of the vertices of each face or strip: of the usual name, or the only one."""
    lists = {name: column for name, column in columns.items() if isinstance(column, PlyLists)}
    for name in (*INDICES, *(lists if len(lists) == 1 else ())):
        if name in lists:
            return lists[name]
    raise UnirenderError(
        f"its faces have the lists {', '.join(lists) or 'none'}, expected one of {', '.join(INDICES)}; export it again"
    )


def _cut(columns: PlyColumns, points: Float[np.ndarray, "k 3"]) -> Columns:
    """The columns of triangles instead of polygons."""
    index = _index(columns)
    kept = index.sizes > 2
    sizes = index.sizes[kept]
    check_faces(int((sizes - 2).sum()))
    corners = index.joined(kept).astype(np.int64)
    if len(points) and (sizes > 3).any():  # indices outside are refused later
        triangles, polygon = triangulate(points[np.clip(corners, 0, len(points) - 1)], sizes)
    else:
        triangles, polygon = fans(sizes)
    result: Columns = {name: column[kept][polygon] for name, column in _numbers(columns).items()}
    result[INDICES[0]] = corners[triangles]
    uv = columns.get(COORDINATES)
    if isinstance(uv, PlyLists) and np.array_equal(uv.sizes[kept], 2 * sizes):
        result[COORDINATES] = uv.joined(kept).reshape(-1, 2)[triangles]
    return result


def _of_strips(index: PlyLists) -> Int[np.ndarray, "m 3"]:
    """The triangles of all strips."""
    check_faces(int(np.maximum(index.sizes - 2, 0).sum()))
    joined = index.joined(np.ones(len(index.sizes), bool)).astype(np.int64)
    ends = np.concatenate([np.cumsum(index.sizes), np.flatnonzero(joined == RESTART)])
    return np.concatenate([strip(part[part != RESTART]) for part in np.split(joined, np.unique(ends))])


def _coordinates(
    triangles: Columns, vertices: Columns, faces: Int[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 3 2"] | None:
    """Texture coordinates of the corners, v from the first row: those of the faces, else of the vertices."""
    names = next((names for names in VERTEX_COORDINATES if set(names) <= set(vertices)), None)
    if COORDINATES in triangles:
        uv = triangles[COORDINATES].astype(np.float64)
    elif names is not None:
        uv = _stacked(vertices, names)[faces]
    else:
        return None
    return uv * [1, -1] + [0, 1]  # PLY's v counts from below


def _colors(
    triangles: Columns, vertices: Columns, faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m 3 3"] | None, bool]:
    """Linear colours of the corners, those of the vertices before those of the faces; whether no alpha is below 1."""
    columns = next((columns for columns in (vertices, triangles) if set(COLORS) <= set(columns)), None)
    if columns is None:
        return None, True
    linear = linear_colors(np.stack([columns[name] for name in COLORS], axis=-1))
    opaque = "alpha" not in columns or is_opaque(columns["alpha"])
    return linear[faces] if columns is vertices else np.repeat(linear[:, None], 3, axis=1), opaque
