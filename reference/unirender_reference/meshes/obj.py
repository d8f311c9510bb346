"""Wavefront OBJ: polygons of any size, absolute and relative indices, materials, vertex colours.

Polygons are cut into fans. Curves, points, lines and smoothing groups are left out: faces without normals get creased
ones (`load`).
"""

from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Int

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.limits import (
    MAX_LINE_BYTES,
    MAX_TEXT_BYTES,
    MAX_VERTICES,
    check_bytes,
    check_faces,
    check_materials,
)
from unirender_reference.meshes.mtl import MtlEntry, MtlMaterials, parse_mtl
from unirender_reference.meshes.surface import Model, Piece


class _Lines:
    """What the lines of a file say, in flat arrays."""

    def __init__(self) -> None:
        self.points, self.colors = array("d"), array("d")
        self.coordinates, self.normals = array("d"), array("d")
        self.corners = array("q")  # point, coordinate, normal of each corner, from 1; 0 for none
        self.sizes, self.materials = array("q"), array("q")  # of each polygon
        self.names: dict[str | None, int] = {None: 0}  # of materials, in the order of their first use
        self.libraries: dict[str, None] = {}  # in order, each once
        self._triangles = 0
        self._current = 0

    def read(self, path: Path) -> None:
        with path.open("rb") as file:
            kept = b""
            for number, line in enumerate(iter(lambda: file.readline(MAX_LINE_BYTES + 1), b""), start=1):
                if len(kept) + len(line) > MAX_LINE_BYTES:
                    raise UnirenderError(f"line {number} has more than {MAX_LINE_BYTES:,} bytes, expected fewer")
                if line.rstrip(b"\r\n").endswith(b"\\"):
                    kept += line.rstrip(b"\r\n")[:-1] + b" "
                    continue
                try:
                    self._line((kept + line if kept else line).split(None, 1))
                except UnirenderError:
                    raise
                except (ValueError, OverflowError) as error:
                    raise UnirenderError(f"line {number} cannot be read ({error}): {line[:60]!r}") from error
                kept = b""

    def _line(self, parts: list[bytes]) -> None:
        if len(parts) < 2:
            return
        keyword, rest = parts
        if keyword == b"v":
            values = rest.split()
            self.points.extend(
                (float(values[0]), float(values[1]), float(values[2])) if len(values) > 2 else _short(rest)
            )
            if len(values) >= 6:
                self.colors.extend(map(float, values[3:6]))
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

    def _face(self, tokens: list[bytes]) -> None:
        if len(tokens) < 3:
            return
        counts = len(self.points) // 3, len(self.coordinates) // 2, len(self.normals) // 3
        for token in tokens:
            fields = token.split(b"/")
            for k in range(3):
                index = int(fields[k]) if k < len(fields) and fields[k] else 0
                self.corners.append(index if index >= 0 else counts[k] + 1 + index)
        self.sizes.append(len(tokens))
        self.materials.append(self._current)
        self._triangles += len(tokens) - 2
        check_faces(self._triangles)


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
    points = np.array(lines.points).reshape(-1, 3)
    corners = np.array(lines.corners, np.int64).reshape(-1, 3)
    triangles, polygon = _fans(np.array(lines.sizes, np.int64))
    owner = np.array(lines.materials, np.int64)[polygon]
    order = np.argsort(owner, kind="stable")  # faces grouped by material
    present, starts = np.unique(owner[order], return_index=True)
    names = list(lines.names)
    used = [names[i] for i in present]
    entries = _libraries(folder, lines.libraries) if any(name is not None for name in used) else {}
    materials = MtlMaterials(folder, entries, used)
    coordinates = np.array(lines.coordinates).reshape(-1, 2)
    normals = np.array(lines.normals).reshape(-1, 3)
    colors = np.array(lines.colors).reshape(-1, 3) if len(lines.colors) == len(lines.points) > 0 else None
    if colors is not None:
        colors = srgb_decode(np.clip(np.nan_to_num(colors / (255 if colors.max() > 1 else 1)), 0, 1)).astype(np.float64)
    pieces = []
    for name, group in zip(used, np.split(order, starts[1:]), strict=True):
        index = corners[triangles[group]]  # (m, 3 corners, 3 kinds)
        faces = _looked_up(index[..., 0], len(points), "vertex")
        if faces is None:
            raise UnirenderError("a face names vertex 0, OBJ counts from 1; export it again")
        at = _looked_up(index[..., 1], len(coordinates), "texture coordinate")
        turned = _looked_up(index[..., 2], len(normals), "normal")
        uv = None if at is None else coordinates[at] * [1, -1] + [0, 1]  # v from below -> from the first row
        textured = uv is not None and bool(np.isfinite(uv).all())
        mapped = "albedo" in entries[name].maps if name in entries else False
        pieces.append(
            Piece(
                vertices=points,
                faces=faces,
                normals=None if turned is None else normals[turned],
                uv={0: uv} if uv is not None and textured else {},
                colors=None if colors is None or mapped else colors[faces],
                material=materials.make(name, textured, colors is not None),
            )
        )
    ignored = set(materials.ignored)
    if any(name is not None and name not in entries for name in used):
        ignored.add("undefined materials")
    return Model(pieces, frozenset(ignored))


def _libraries(folder: ModelFolder, names: Iterable[str]) -> dict[str, MtlEntry]:
    entries: dict[str, MtlEntry] = {}
    for name in names:
        try:
            texts = [folder.read(name, "material library", limit=MAX_TEXT_BYTES)]
        except UnirenderError:
            if len(name.split()) < 2:
                raise
            texts = (folder.read(part, "material library", limit=MAX_TEXT_BYTES) for part in name.split())  # several
        for text in texts:
            entries |= parse_mtl(text.decode("utf-8", "surrogateescape"))
            check_materials(len(entries))
    return entries


def _fans(sizes: Int[np.ndarray, " p"]) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Triangles of polygons as positions in their list of corners, and the polygon of each."""
    count = sizes - 2
    polygon = np.repeat(np.arange(len(sizes)), count)
    first = (np.cumsum(sizes) - sizes)[polygon]
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(count) - count, count)
    return np.stack([first, first + step + 1, first + step + 2], axis=1), polygon


def _looked_up(index: Int[np.ndarray, "m 3"], count: int, what: str) -> Int[np.ndarray, "m 3"] | None:
    """Indices from 0; None where any corner has none."""
    if (index == 0).any():
        return None
    if index.max() > count or index.min() < 1:
        wrong = index.max() if index.max() > count else index.min()
        raise UnirenderError(f"its faces name {what} {wrong:,}, but it has {count:,}; export it again")
    return index - 1
