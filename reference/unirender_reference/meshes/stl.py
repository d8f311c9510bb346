"""STL files, text and binary: whole, of triangles alone, and without what follows the last of them."""

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.meshes.limits import check_bytes, check_faces, float32_step
from unirender_reference.meshes.mtl import DEFAULT_ALBEDO
from unirender_reference.meshes.surface import Material, Model, Piece

HEADER = 84  # bytes of a binary file before its facets; the last four are their count
FACETS = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attributes", "<u2")])
ATTRIBUTES = "attributes of facets"  # among what is ignored; where some exporters keep a colour
MORE = "facets beyond the count"  # likewise
END = 65536  # bytes in which the last solid ends; zeros may follow
NAMES = re.compile(rb"solid(?!\S)[^\r\n]*?(?=[ \t]facet[ \t]+normal[ \t]+[-+.\d]|[\r\n]|$)")  # of solids: any words
# The keywords, wherever they stand in a line; what is looked for behind their letters is found fast.
MARKS = re.compile(rb"facet(?<!\Sfacet)(?!\S)|vertex(?<!\Svertex)(?!\S)")
POINT = re.compile(rb"vertex(?<!\Svertex)((?:[ \t]+\S+){3})")
NO_POINT = re.compile(
    rb"vertex(?<!\Svertex)(?!(?:[ \t]+(?!vertex)\S+){3}[ \t\r]*(?:$|(?:vertex|endloop)(?!\S)))[^\r\n]*", re.MULTILINE
)


def read_stl(path: Path) -> Model:
    """Reads an STL file, text or binary; each solid is a piece.

    Raises:
        UnirenderError: the file is cut off, or a text whose facets are not three vertices of three numbers each, or a
            limit is exceeded.
    """
    length = path.stat().st_size
    check_bytes(length, "the file")
    with path.open("rb") as file:
        head = file.read(END)
        file.seek(0)
        if _is_text(head):
            solids, ignored = _of_text(file.read()), set[str]()
        else:
            solids, ignored = _of_bytes(file, length, head)
    return Model([_piece(points.astype(np.float64)) for points in solids], frozenset(ignored))


def _piece(points: Float[np.ndarray, "n 3"]) -> Piece:
    """Triangles of three points each, in their order."""
    material = Material({"albedo": np.full(3, DEFAULT_ALBEDO, np.float32)})
    faces = np.arange(len(points)).reshape(-1, 3)
    return Piece(points, faces, None, {}, None, material, float32_step(points))


def _is_text(head: bytes) -> bool:
    """Whether it is one of words, whose name or end may be padded; a binary one's count of facets has a zero."""
    return b"\0" not in head[80:HEADER] and re.search(rb"facet|endsolid", head, re.IGNORECASE) is not None


def _of_bytes(file: BinaryIO, length: int, head: bytes) -> tuple[list[np.ndarray], set[str]]:
    """The points of a binary file, and what of it is ignored."""
    count = int.from_bytes(head[HEADER - 4 : HEADER], "little")
    expected = HEADER + FACETS.itemsize * count
    if length < expected:
        raise UnirenderError(
            f"truncated: claims {count:,} triangles in {length:,} bytes, expected {expected:,}; copy it again"
        )
    check_faces(count)
    if not count and length >= HEADER + FACETS.itemsize:
        raise UnirenderError(
            f"claims 0 triangles, but has bytes for {(length - HEADER) // FACETS.itemsize:,}: its count was never "
            "written; export it again"
        )
    facets = np.frombuffer(file.read(expected)[HEADER:], FACETS)
    more = any(file.read(FACETS.itemsize)) and length >= expected + FACETS.itemsize
    ignored = {MORE: more, ATTRIBUTES: bool(facets["attributes"].any())}
    return [facets["points"].reshape(-1, 3)], {name for name, is_so in ignored.items() if is_so}


def _of_text(data: bytes) -> list[np.ndarray]:
    """The points of each solid of a text."""
    words = (data if b"\n" in data else data.replace(b"\r", b"\n")).lower()
    if b"endsolid" not in words[-END:]:
        raise UnirenderError("truncated: its last solid does not end, expected 'endsolid'; copy it again")
    check_faces(words.count(b"endfacet"))
    words = NAMES.sub(b"solid", words)
    if odd := NO_POINT.search(words):
        raise UnirenderError(f"has the line {odd[0].strip()[:60]!r}, expected three numbers; export it again")
    marks = b"".join(found[0][:1] for found in MARKS.finditer(words))
    if marks.startswith(b"v"):
        raise UnirenderError("has vertices before its first facet; export it again")
    if marks != b"fvvv" * (len(marks) // 4):
        sizes = {len(vertices) for vertices in marks.split(b"f")[1:]} - {3}
        raise UnirenderError(
            f"has facets of {', '.join(map(str, sorted(sizes)))} vertices, expected triangles; export it as triangles"
        )
    numbers = (np.fromstring(b" ".join(POINT.findall(solid)), sep=" ") for solid in words.split(b"endsolid"))
    return [points.reshape(-1, 3) for points in numbers if len(points)]
