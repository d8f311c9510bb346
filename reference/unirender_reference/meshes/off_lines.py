"""What trimesh leaves out of an OFF file: whether it is whole, its normals (NOFF) and its colours.

Behind the three coordinates of a vertex stand its normal (N), its colour (C) and its texture coordinates (ST), as far
as the header's letters name them; behind the indices of a face may stand a colour. Colours are three or four numbers,
sRGB-coded, of 255 or of 1 (`colors`); the fourth is alpha. A single number behind a face is an index into a table
that the file does not hold.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.colors import unit_colors

LETTERS = "CNST"


@dataclass(frozen=True)
class OffLines:
    """Normals and linear colours of a mesh, as far as it has them.

    Attributes:
        normals: (n, 3) of the vertices, as they are stored, or None.
        vertices: (n, 3) colours of the vertices, or None.
        faces: (m, 3) colours of the triangles, or None.
        left_out: the file has colours, or numbers in their place, that are not read.
    """

    normals: Float[np.ndarray, "n 3"] | None = None
    vertices: Float[np.ndarray, "n 3"] | None = None
    faces: Float[np.ndarray, "m 3"] | None = None
    left_out: bool = False

    @property
    def colored(self) -> bool:
        """Whether the mesh has colours."""
        return self.vertices is not None or self.faces is not None

    def corners(self, faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3 3"]:
        """The colours of each corner; vertices come before faces."""
        if self.vertices is not None:
            return self.vertices[faces]
        assert self.faces is not None
        return np.repeat(self.faces[:, None], 3, axis=1)


def read_off_lines(path: Path) -> OffLines:
    """Normals and colours of a file.

    Where some vertices or faces have no colour, where words stand in its place, and on faces with more than three
    corners, they are left out.

    Raises:
        UnirenderError: another header than OFF with the letters C, N and ST, or fewer lines than it claims.
    """
    text = re.sub(r"#[^\n]*", "", path.read_text("utf-8", "replace"))
    letters, found, body = text.partition("OFF")
    letters = letters.strip()
    if not found or set(letters) - set(LETTERS):
        raise UnirenderError(
            f"starts with {(letters + found)[:20]!r}, expected OFF, or COFF, NOFF, STOFF and the like, as text and in "
            "three dimensions; export it again"
        )
    lines = [line.split() for line in body.splitlines() if line.strip()]
    vertices, faces = (int(count) for count in lines[0][:2])
    of_vertices, of_faces = lines[1 : vertices + 1], lines[vertices + 1 : vertices + 1 + faces]
    if vertices < 0 or not 0 <= faces <= len(of_faces) or any(len(line) <= int(line[0]) for line in of_faces):
        raise UnirenderError(
            f"truncated: claims {vertices:,} vertices and {faces:,} faces, but its lines end before; copy it again"
        )
    start = 6 if "N" in letters else 3
    end = -2 if "ST" in letters else None
    vertex_colors = [line[start:end] for line in of_vertices] if "C" in letters else []
    face_colors = [line[int(line[0]) + 1 :] for line in of_faces]
    triangles = all(line[0] == "3" for line in of_faces)
    of_each_vertex = _linear(vertex_colors)
    of_each_face = _linear(face_colors) if triangles and of_each_vertex is None else None
    unread = (any(vertex_colors) and of_each_vertex is None) or (any(face_colors) and of_each_face is None)
    normals = np.array([line[3:6] for line in of_vertices], np.float64) if "N" in letters else None
    return OffLines(normals, of_each_vertex, of_each_face, unread)


def _linear(numbers: list[list[str]]) -> Float[np.ndarray, "n 3"] | None:
    if not numbers or {len(words) for words in numbers} - {3, 4}:
        return None
    have_alpha = all(len(words) == 4 for words in numbers)
    try:
        stored = np.array([words if have_alpha else words[:3] for words in numbers], np.float64)
    except ValueError:  # words
        return None
    if (stored % 1).any():
        stored = stored[:, :3]  # of floats, alpha may be of another range
    return srgb_decode(unit_colors(stored).astype(np.float32)).astype(np.float64)
