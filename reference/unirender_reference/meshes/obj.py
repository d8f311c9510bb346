"""Wavefront OBJ: polygons of any size, absolute and relative indices, materials, vertex colours.

Concave polygons are filled (`polygons`). Curves, points, lines and smoothing groups are left out: faces without
normals get creased ones (`normals`).
"""

import codecs
import io
import re
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.colors import unit_colors
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.limits import (
    MAX_LINE_BYTES,
    MAX_VERTICES,
    check_bytes,
    check_faces,
    check_geometry,
    check_materials,
)
from unirender_reference.meshes.mtl import MtlMaterials, read_libraries
from unirender_reference.meshes.normals import piece_normals
from unirender_reference.meshes.polygons import fans, triangulate
from unirender_reference.meshes.surface import BARE, Material, Model, Piece

LEFT_OUT = {  # keywords of elements that are no faces: what of the file is ignored
    **dict.fromkeys((b"l", b"p"), "points and lines"),
    **dict.fromkeys((b"curv", b"curv2", b"surf"), "curves and their surfaces"),
}
NAMING = (b"usemtl", b"mtllib")  # keywords whose text may hold a #; elsewhere a comment begins there


class _Lines:
    """What the lines of a file say, in flat arrays."""

    def __init__(self) -> None:
        self.points, self.colors = array("d"), array("d")
        self.colored = array("q")  # which points have a colour
        self.coordinates, self.normals = array("d"), array("d")
        self.corners = array("q")  # point, coordinate, normal of each corner, from 1; 0 for none
        self.sizes, self.materials = array("q"), array("q")  # of each polygon
        self.names: dict[str | None, int] = {None: 0}  # of materials, in the order of their first use
        self.libraries: dict[str, None] = {}  # in order, each once
        self.ignored: set[str] = set()
        self._triangles = 0
        self._current = 0

    def read(self, path: Path) -> None:
        with path.open("rb") as file:
            kept = b""
            for number, line in enumerate(_each_line(file), start=1):
                if len(kept) + len(line) > MAX_LINE_BYTES:
                    raise UnirenderError(
                        f"line {number} has more than {MAX_LINE_BYTES:,} bytes, expected fewer; export it again"
                    )
                if line.rstrip(b"\r\n").endswith(b"\\"):
                    kept += line.rstrip(b"\r\n")[:-1] + b" "
                    continue
                try:
                    self._line((kept + line if kept else line).split(None, 1))
                except UnirenderError:
                    raise
                except (ValueError, OverflowError) as error:
                    raise UnirenderError(
                        f"line {number} cannot be read ({error}): {line[:60]!r}; export it again"
                    ) from error
                kept = b""

    def _line(self, parts: list[bytes]) -> None:
        """Takes one line, split into its keyword and the rest."""
        if len(parts) < 2:
            return
        keyword, rest = parts
        if b"#" in rest and keyword not in NAMING:
            rest = rest.partition(b"#")[0]
        if keyword == b"v":
            values = rest.split()
            self.points.extend(
                (float(values[0]), float(values[1]), float(values[2])) if len(values) > 2 else _short(rest)
            )
            if len(values) >= 6:
                self.colors.extend(map(float, values[3:6]))
                self.colored.append(len(self.points) // 3 - 1)
            _check_vertices(len(self.points) // 3, "vertices")
        elif keyword == b"vt":
            values = rest.split()
            self.coordinates.extend((float(values[0]), float(values[1]) if len(values) > 1 else 0.0))
            _check_vertices(len(self.coordinates) // 2, "texture coordinates")
        elif keyword == b"vn":
            values = rest.split()
            self.normals.extend(
                (float(values[0]), float(values[1]), float(values[2])) if len(values) > 2 else _short(rest)
            )
            _check_vertices(len(self.normals) // 3, "normals")
        elif keyword == b"f":
            self._face(rest.split())
        elif keyword == b"usemtl":
            self._current = self.names.setdefault(rest.decode("utf-8", "surrogateescape").strip(), len(self.names))
            check_materials(len(self.names))
        elif keyword == b"mtllib":
            self.libraries[rest.decode("utf-8", "surrogateescape").strip()] = None
            check_materials(len(self.libraries))
        elif keyword in LEFT_OUT:
            self.ignored.add(LEFT_OUT[keyword])

    def _face(self, tokens: list[bytes]) -> None:
        """Takes one polygon: its corners' indices from 1, 0 where there is none; negative ones count from the end."""
        if len(tokens) < 3:
            return
        counts = len(self.points) // 3, len(self.coordinates) // 2, len(self.normals) // 3
        for token in tokens:
            fields = token.split(b"/")
            for k in range(3):
                index = int(fields[k]) if k < len(fields) and fields[k] else 0
                if index < 0:
                    index += counts[k] + 1
                    index -= index <= 0  # before the first stays below 0, which stands for none
                self.corners.append(index)
        self.sizes.append(len(tokens))
        self.materials.append(self._current)
        self._triangles += len(tokens) - 2
        check_faces(self._triangles)


def _each_line(file: BinaryIO) -> Iterator[bytes]:
    """Lines that end in LF, CR LF or CR, also in turn; one of too many bytes is cut off."""
    head = file.read(MAX_LINE_BYTES)
    file.seek(len(codecs.BOM_UTF8) if head.startswith(codecs.BOM_UTF8) else 0)
    if re.search(rb"\r[^\n]", head):
        text = io.TextIOWrapper(file, "latin-1", newline="")
        return (line.encode("latin-1") for line in iter(lambda: text.readline(MAX_LINE_BYTES + 1), ""))
    return iter(lambda: file.readline(MAX_LINE_BYTES + 1), b"")


def _check_vertices(count: int, what: str) -> None:
    if count > MAX_VERTICES:
        raise UnirenderError(f"has more than {MAX_VERTICES:,} {what}; decimate the mesh")


def _short(rest: bytes) -> tuple[float, ...]:
    raise ValueError(f"expected 3 numbers, got {rest.strip()[:40]!r}")


def read_obj(path: Path, folder: ModelFolder) -> Model:
    """Reads an OBJ file and the MTL files and textures that its faces use.

    Args:
        path: the file.
        folder: where its MTL files and textures may lie.

    Raises:
        UnirenderError: no faces, a line cannot be read, an index or a file is missing, or a limit is exceeded.
    """
    check_bytes(path.stat().st_size, "the file")
    lines = _Lines()
    lines.read(path)
    if not lines.sizes:
        raise UnirenderError(
            f"has no faces, expected a triangle mesh: {len(lines.points) // 3:,} lines of v, none of f; is it an OBJ "
            "file?"
        )
    mesh = _Corners(lines)
    names = list(lines.names)
    used = [names[i] for i in np.unique(mesh.owner)]
    entries = read_libraries(folder, lines.libraries, {name for name in used if name is not None})
    mapped = np.array([bool(name in entries and entries[name].maps) for name in names])
    materials = MtlMaterials(folder, entries, used)
    made: dict[tuple[str | None, bool, bool], Material] = {}
    pieces, owners, ignored = [], [], set(lines.ignored)
    for group in mesh.alike(mapped):
        owners.append(mesh.owner[group[0]])
        name = names[owners[-1]]
        maps = entries[name].maps if name in entries else {}
        faces, uv, normals = mesh.faces(group), mesh.uv_at(group), mesh.normals_at(group)
        colors = None if mesh.colors is None else mesh.colors[faces]
        if colors is not None and np.isnan(colors).any():
            ignored |= set() if np.isnan(colors).all() else {"colours of faces with a bare corner"}
            colors = None
        ignored |= {BARE} if maps and uv is None else set()
        key = name, uv is not None, colors is not None
        if key not in made:
            made[key] = materials.make(*key)
        shown = None if "albedo" in maps else colors
        pieces.append(Piece(mesh.points, faces, normals, {} if uv is None else {0: uv}, shown, made[key]))
    if any(name is not None and name not in entries for name in used):
        ignored.add("undefined materials")
    return Model(_smoothed(pieces, np.array(owners)), frozenset(ignored | materials.ignored))


class _Corners:
    """The triangles of a file, with what stands at their corners.

    Attributes:
        points: [n 3].
        colors: of the points [n 3], linear, NaN where one has none; None where none has.
        owner: number of each triangle's material [m].
    """

    def __init__(self, lines: _Lines) -> None:
        self.points = np.array(lines.points).reshape(-1, 3)
        self._coordinates = np.array(lines.coordinates).reshape(-1, 2)
        self._normals = np.array(lines.normals).reshape(-1, 3)
        corners = np.array(lines.corners, np.int64).reshape(-1, 3)
        sizes = np.array(lines.sizes, np.int64)
        count = len(self.points)
        at_corners = self.points[np.clip(corners[:, 0], 1, count) - 1] if count else None  # checked by `faces`
        triangles, polygon = fans(sizes) if at_corners is None else triangulate(at_corners, sizes)
        self.owner = np.array(lines.materials, np.int64)[polygon]
        self.colors = _colors(lines, len(self.points))
        self._point, self._coordinate, self._normal = np.moveaxis(corners[triangles], -1, 0)  # [m 3] each, from 1

    def alike(self, mapped: Bool[np.ndarray, " k"]) -> list[Int[np.ndarray, " f"]]:
        """The triangles by material. Those that lack what others of their material have are a group of their own.

        Args:
            mapped: whether each material has textures, so that its triangles need texture coordinates.
        """
        lacks = [
            mapped[self.owner] & _lacking(self._coordinate, self._coordinates),
            (self._normal == 0).any(axis=1),
            np.False_ if self.colors is None else _lacking(self._point, self.colors),
        ]
        kind = self.owner
        for missing in lacks:
            kind = 2 * kind + missing
        order = np.argsort(kind, kind="stable")
        starts = np.unique(kind[order], return_index=True)[1]
        return np.split(order, starts[1:])

    def faces(self, group: Int[np.ndarray, " f"]) -> Int[np.ndarray, "f 3"]:
        """Indices of the points of some triangles."""
        faces = _looked_up(self._point[group], len(self.points), "vertex")
        if faces is None:
            raise UnirenderError("a face names vertex 0, OBJ counts from 1; export it again")
        return faces

    def normals_at(self, group: Int[np.ndarray, " f"]) -> Float[np.ndarray, "f 3 3"] | None:
        """Normals at the corners of some triangles; None where any corner has none."""
        at = _looked_up(self._normal[group], len(self._normals), "normal")
        return None if at is None else self._normals[at]

    def uv_at(self, group: Int[np.ndarray, " f"]) -> Float[np.ndarray, "f 3 2"] | None:
        """Texture coordinates at the corners, v from the first row; None where any corner has no finite one."""
        at = _looked_up(self._coordinate[group], len(self._coordinates), "texture coordinate")
        uv = None if at is None else self._coordinates[at] * [1, -1] + [0, 1]  # OBJ's v counts from below
        return uv if uv is not None and np.isfinite(uv).all() else None


def _smoothed(pieces: list[Piece], owners: Int[np.ndarray, " k"]) -> list[Piece]:
    """Gives the pieces of one material that have no normals those of all its faces without, as if it were not split."""
    bare = np.array([piece.normals is None for piece in pieces])
    split = [i for i in np.unique(owners[bare]) if (bare & (owners == i)).sum() > 1]
    if split:
        check_geometry(np.concatenate([piece.vertices[piece.faces] for piece in pieces]), step=0)
    result = list(pieces)
    for owner in split:
        parts = np.flatnonzero(bare & (owners == owner))
        first = pieces[parts[0]]
        faces = np.concatenate([pieces[k].faces for k in parts])
        normals = piece_normals(Piece(first.vertices, faces, None, {}, None, first.material))
        ends = np.cumsum([len(pieces[k].faces) for k in parts])
        for k, own in zip(parts, np.split(normals, ends[:-1]), strict=True):
            result[k] = replace(pieces[k], normals=own)
    return result


def _colors(lines: _Lines, count: int) -> Float[np.ndarray, "n 3"] | None:
    """Linear colours of the points, NaN where one has none; None where none has."""
    if not lines.colored:
        return None
    colors = np.full((count, 3), np.nan)
    colors[np.array(lines.colored)] = srgb_decode(unit_colors(np.array(lines.colors).reshape(-1, 3)))
    return colors


def _lacking(index: Int[np.ndarray, "m 3"], values: Float[np.ndarray, "n c"]) -> Bool[np.ndarray, " m"]:
    """Faces of which a corner has no value, or one that is not finite; indices from 1."""
    missing = np.append(~np.isfinite(values).all(-1), True)  # the last: index 0
    return np.asarray(missing[np.clip(index, 0, len(values)) - 1].any(axis=1))


def _looked_up(index: Int[np.ndarray, "m 3"], count: int, what: str) -> Int[np.ndarray, "m 3"] | None:
    """Indices from 0; None where any corner has none."""
    if (index == 0).any():
        return None
    if index.max() > count or index.min() < 1:
        before = f"a {what} before the first, counted back from a face"
        named = f"{what} {index.max():,}" if index.max() > count else before
        raise UnirenderError(f"its faces name {named}, but it has {count:,}; export it again")
    return index - 1
