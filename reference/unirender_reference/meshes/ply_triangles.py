"""PLY files with triangles for their polygons and strips, in the one form that trimesh reads: binary, without comments,
with vertices, faces and the usual names of colours alone.
"""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError
from unirender_reference.meshes.limits import check_faces
from unirender_reference.meshes.ply_elements import PlyColumns, PlyHeader, PlyLists, read_columns
from unirender_reference.meshes.polygons import fans, strip, triangulate

INDICES = "vertex_indices", "vertex_index"
COORDINATES = "texcoord"  # u and v of each corner of a face
VERTEX_COORDINATES = "texture_u", "texture_v", "u", "v", "s", "t"
STRIPS, RESTART = "tristrips", -1  # several strips in one list, with this number between them
COLORS = "red", "green", "blue"
OTHER_COLORS = ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")
WANTED = {"x", "y", "z", "nx", "ny", "nz", *COLORS, *OTHER_COLORS[0], *OTHER_COLORS[1], "alpha", *VERTEX_COORDINATES}
Columns = dict[str, np.ndarray]  # (rows,), or (rows, k) of lists of one length


def triangles_ply(path: Path, header: PlyHeader, *, textured: bool) -> io.BytesIO:
    """A file whose faces have three corners each.

    What a polygon has (a colour), its triangles have; the texture coordinates of its corners go with them. Faces of one
    or two corners, and elements other than vertices and faces, are left out.

    Args:
        path: the file.
        header: its own.
        textured: whether it names a texture; else coordinates beside colours, for which trimesh would drop those, are
            left out.

    Raises:
        UnirenderError: the file is cut off, its vertices have no x, y and z or its faces no list of them, it has both
            faces and strips, or too many triangles.
    """
    elements = read_columns(path, header, WANTED)
    vertices = _numbers(elements.get("vertex", {}))
    if missing := [axis for axis in "xyz" if axis not in vertices]:
        raise UnirenderError(f"its vertices have no {', '.join(missing)}, expected x, y and z; export it again")
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    has = [element for element in ("face", STRIPS) if element in elements and header.elements[element].rows]
    if len(has) > 1:
        raise UnirenderError(f"has both faces and {STRIPS}, expected one of them; export it as triangles")
    faces: Columns = {}
    if has == ["face"]:
        faces = _cut(elements["face"], points)
    elif has:
        faces = {INDICES[0]: _of_strips(_index(elements[STRIPS]))}
    if not textured and any(set(COLORS) <= set(columns) for columns in (vertices, faces)):
        vertices = {name: column for name, column in vertices.items() if name not in VERTEX_COORDINATES}
        faces.pop(COORDINATES, None)
    return io.BytesIO(b"ply\nformat binary_little_endian 1.0\n" + _written({"vertex": vertices, "face": faces}))


def _numbers(columns: PlyColumns) -> Columns:
    """The columns that are no lists, with the usual names of colours."""
    single = {name: column for name, column in columns.items() if not isinstance(column, PlyLists)}
    renamed: Mapping[str, str] = {}
    if not set(COLORS) <= set(single):
        renamed = next(
            (dict(zip(names, COLORS, strict=True)) for names in OTHER_COLORS if set(names) <= set(single)), {}
        )
    return {renamed.get(name, name): column for name, column in single.items()}


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
        result[COORDINATES] = uv.joined(kept).reshape(-1, 2)[triangles].reshape(-1, 6)
    return result


def _of_strips(index: PlyLists) -> Int[np.ndarray, "m 3"]:
    """The triangles of all strips."""
    check_faces(int(np.maximum(index.sizes - 2, 0).sum()))
    joined = index.joined(np.ones(len(index.sizes), bool)).astype(np.int64)
    ends = np.concatenate([np.cumsum(index.sizes), np.flatnonzero(joined == RESTART)])
    return np.concatenate([strip(part[part != RESTART]) for part in np.split(joined, np.unique(ends))])


def _written(elements: Mapping[str, Columns]) -> bytes:
    """The elements that have rows, behind what is left of a header; a two-dimensional column is one of lists."""
    header, body = b"", b""
    for element, columns in elements.items():
        count = len(next(iter(columns.values()), ()))
        if count == 0:
            continue
        header += f"element {element} {count}\n".encode()
        kinds: list[tuple[str, np.dtype, tuple[int, ...]]] = []
        for name, column in columns.items():
            listed = column.ndim > 1
            kinds += [(f"{name} count", np.dtype(np.uint8), ())] if listed else []
            kinds.append((name, column.dtype.newbyteorder("<"), column.shape[1:]))
            header += f"property {'list uchar ' if listed else ''}{column.dtype.name} {name}\n".encode()
        rows = np.empty(count, np.dtype(kinds))
        for name, column in columns.items():
            rows[name] = column
            if column.ndim > 1:
                rows[f"{name} count"] = column.shape[1]
        body += rows.tobytes()
    return header + b"end_header\n" + body
