"""Colours of an OFF file, which trimesh does not read: behind the numbers of a vertex (COFF) or of a face.

Three or four numbers each, sRGB-coded: whole ones of 255, others of 1; the fourth is alpha. A single number behind a
face is an index into a table that the file does not hold.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from unirender.color import srgb_decode


@dataclass(frozen=True)
class OffColors:
    """Linear colours of all vertices or of all faces, or none.

    Attributes:
        vertices: (n, 3), or None.
        faces: (m, 3) of the triangles, or None.
        left_out: the file has colours, or numbers in their place, that are not read.
    """

    vertices: Float[np.ndarray, "n 3"] | None = None
    faces: Float[np.ndarray, "m 3"] | None = None
    left_out: bool = False

    @property
    def known(self) -> bool:
        """Whether the mesh has colours."""
        return self.vertices is not None or self.faces is not None

    def corners(self, faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3 3"]:
        """The colours of each corner; vertices come before faces."""
        if self.vertices is not None:
            return self.vertices[faces]
        assert self.faces is not None
        return np.repeat(self.faces[:, None], 3, axis=1)


def read_off_colors(path: Path) -> OffColors:
    """The colours of a file that trimesh has read.

    Where some vertices or faces have none, where words stand in their place, and on faces with more than three corners,
    they are left out.
    """
    text = re.sub(r"#[^\n]*", "", path.read_text("utf-8", "replace"))
    head, _, body = text.partition("OFF")
    lines = [line.split() for line in body.splitlines() if line.strip()]
    vertices, faces = (int(count) for count in lines[0][:2])
    of_vertices = [line[3:] for line in lines[1 : vertices + 1]] if head.strip() == "C" else []
    of_faces = [line[int(line[0]) + 1 :] for line in lines[vertices + 1 : vertices + 1 + faces]]
    triangles = all(line[0] == "3" for line in lines[vertices + 1 : vertices + 1 + faces])
    vertex_colors = _linear(of_vertices)
    face_colors = _linear(of_faces) if triangles and vertex_colors is None else None
    unread = (any(of_vertices) and vertex_colors is None) or (any(of_faces) and face_colors is None)
    return OffColors(vertex_colors, face_colors, unread or (head.strip() != "C" and "C" in head))


def _linear(numbers: list[list[str]]) -> Float[np.ndarray, "n 3"] | None:
    if not numbers or {len(words) for words in numbers} - {3, 4}:
        return None
    whole = all(word.isdigit() for words in numbers for word in words[:3])
    try:
        colors = np.array([words[:3] for words in numbers], np.float64) / (255 if whole else 1)
    except ValueError:  # words
        return None
    return srgb_decode(np.clip(np.nan_to_num(colors), 0, 1).astype(np.float32)).astype(np.float64)
