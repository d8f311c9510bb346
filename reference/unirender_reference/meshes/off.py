"""OFF files as text: points, polygons, normals (NOFF) and colours.

Behind the three coordinates of a vertex stand its normal (N), its colour (C) and its texture coordinates (ST), as far
as the header's letters name them; behind the indices of a face may stand a colour. Colours are three or four numbers,
sRGB-coded, of 255 or of 1 (`colors`); the fourth is alpha. A single number behind a face is an index into a table
that the file does not hold.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError
from unirender_reference.meshes.colors import is_opaque, linear_colors
from unirender_reference.meshes.limits import MAX_VERTICES, check_bytes, check_faces
from unirender_reference.meshes.mtl import DEFAULT_ALBEDO
from unirender_reference.meshes.polygons import triangulate
from unirender_reference.meshes.surface import Material, Model, Piece

LETTERS = "CNST"


def read_off(path: Path) -> Model:
    """Reads an OFF file.

    Colours of vertices come before those of faces. Where some have no colour, or words stand in its place, colours are
    left out. Faces of one or two corners are, too.

    Raises:
        UnirenderError: another header than OFF with the letters C, N and ST; counts, points or indices that are none;
            fewer lines, or numbers on them, than claimed; or a limit is exceeded.
    """
    check_bytes(path.stat().st_size, "the file")
    text = re.sub(r"#[^\n]*", "", path.read_text("utf-8-sig", "replace"))
    letters, found, body = text.partition("OFF")
    letters = letters.strip()
    if not found or set(letters) - set(LETTERS) or body.split(None, 1)[:1] == ["BINARY"]:
        first = text.strip().partition("\n")[0]
        raise UnirenderError(
            f"starts with {first[:20]!r}, expected OFF, or COFF, NOFF, STOFF and the like, as text and in three "
            "dimensions; export it again"
        )
    start = 6 if "N" in letters else 3
    end = -2 if "ST" in letters else None
    lines = [line.split() for line in body.splitlines() if line.strip()]
    of_vertices, of_faces = _rows(lines, start - (end or 0))
    points, faces, polygon = _triangles(of_vertices, [line[1 : int(line[0]) + 1] for line in of_faces])
    vertex_colors = [line[start:end] for line in of_vertices]
    face_colors = [of_faces[k][int(of_faces[k][0]) + 1 :] for k in polygon]
    of_each_vertex, vertices_opaque = _linear(vertex_colors if "C" in letters else [])
    of_each_face, faces_opaque = _linear(face_colors if of_each_vertex is None else [])
    unread = (any(vertex_colors) and of_each_vertex is None) or (any(face_colors) and of_each_face is None)
    ignored = {"colours": unread, "alpha": not (vertices_opaque and faces_opaque)}
    normals = np.array([line[3:6] for line in of_vertices], np.float64)[faces] if "N" in letters else None
    colors = None if of_each_face is None else np.repeat(of_each_face[:, None], 3, axis=1)
    colors = colors if of_each_vertex is None else of_each_vertex[faces]
    material = Material({"albedo": np.full(3, DEFAULT_ALBEDO if colors is None else 1, np.float32)})
    piece = Piece(points, faces, normals, {}, colors, material)
    return Model([piece], frozenset(name for name, is_so in ignored.items() if is_so))


def _rows(lines: list[list[str]], width: int) -> tuple[list[list[str]], list[list[str]]]:
    """The lines of vertices, of `width` numbers and more, and of faces, as many as the first line says."""
    try:
        vertices, faces = (int(count) for count in lines[0][:2])
    except (ValueError, IndexError):
        what = " ".join(lines[0])[:40] if lines else ""
        raise UnirenderError(
            f"its header says {what!r}, expected counts of vertices and faces; export it again"
        ) from None
    if vertices < 0 or faces < 0:
        raise UnirenderError(f"its header claims {vertices:,} vertices and {faces:,} faces; export it again")
    if vertices > MAX_VERTICES:
        raise UnirenderError(f"has {vertices:,} vertices, expected at most {MAX_VERTICES:,}; decimate the mesh")
    check_faces(faces)
    of_vertices, of_faces = lines[1 : vertices + 1], lines[vertices + 1 : vertices + 1 + faces]
    if bad := next((line for line in of_faces if not line[0].isdecimal()), None):
        raise UnirenderError(f"has the face {' '.join(bad)[:40]!r}, expected its corners' count; export it again")
    whole = all(len(line) >= width for line in of_vertices) and all(len(line) > int(line[0]) for line in of_faces)
    if len(of_vertices) < vertices or len(of_faces) < faces or not whole:
        raise UnirenderError(
            f"truncated: claims {vertices:,} vertices and {faces:,} faces, but its lines, one for each, end before; "
            "copy it again"
        )
    return of_vertices, of_faces


def _triangles(
    vertices: list[list[str]], corners: list[list[str]]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """The points, the triangles, and the polygon of each."""
    rows = np.array([k for k, face in enumerate(corners) if len(face) > 2], np.int64)
    sizes = np.array([len(corners[k]) for k in rows], np.int64)
    check_faces(int((sizes - 2).sum()))
    try:
        index = np.array([word for k in rows for word in corners[k]], np.int64)
        points = np.array([line[:3] for line in vertices], np.float64).reshape(-1, 3)
    except (ValueError, OverflowError) as error:
        raise UnirenderError(f"its vertices or faces are no numbers ({error}); export it again") from error
    if len(index) and (index.min() < 0 or index.max() >= len(points)):
        wrong = index.min() if index.min() < 0 else index.max()
        raise UnirenderError(f"its faces name vertex {wrong:,}, but it has {len(points):,} vertices; export it again")
    triangles, polygon = triangulate(points[index], sizes)
    return points, index[triangles], rows[polygon]


def _linear(numbers: list[list[str]]) -> tuple[Float[np.ndarray, "n 3"] | None, bool]:
    """Linear colours, None where they are none; and whether those that are have no alpha, or one of 1."""
    if not numbers or {len(words) for words in numbers} - {3, 4}:
        return None, True
    have_alpha = all(len(words) == 4 for words in numbers)
    try:
        stored = np.array([words if have_alpha else words[:3] for words in numbers], np.float64)
    except ValueError:  # words
        return None, True
    opaque = not have_alpha or is_opaque(stored[:, 3])
    if (stored % 1).any():
        stored = stored[:, :3]  # of floats, alpha may be of another range
    return linear_colors(stored), opaque
