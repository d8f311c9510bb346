"""STL files as trimesh reads them: whole, of triangles alone, and without what follows the last of them."""

import io
import re
from pathlib import Path

import numpy as np

from unirender.errors import UnirenderError
from unirender_reference.meshes.limits import check_faces

HEADER, FACET = 84, 50  # bytes of a binary file: its header with the count, and each facet
ATTRIBUTES = "attributes of facets"  # among what is ignored; where some exporters keep a colour
MORE = "facets beyond the count"  # likewise
END = 65536  # bytes in which the last solid ends; zeros may follow
NAMES = re.compile(rb"solid(?!\S)[^\r\n]*")  # of solids: any words
# The keywords, wherever they stand in a line; what is looked for behind their letters is found fast.
MARKS = re.compile(rb"facet(?<!\Sfacet)(?!\S)|vertex(?<!\Svertex)(?!\S)")
NO_POINT = re.compile(
    rb"vertex(?<!\Svertex)(?!(?:[ \t]+(?!vertex)\S+){3}[ \t\r]*(?:$|vertex(?!\S)))[^\r\n]*", re.MULTILINE
)


def whole_stl(path: Path, head: bytes) -> tuple[io.BytesIO | None, set[str]]:
    """What trimesh is to read of a file, None for the file itself; and what of the file is ignored.

    Args:
        path: the file.
        head: its first bytes.

    Raises:
        UnirenderError: the file is cut off, or a text whose facets are not three vertices of three numbers each.
    """
    if _is_text(head):
        return _of_text(path.read_bytes()), set()
    length, count = path.stat().st_size, int.from_bytes(head[HEADER - 4 : HEADER], "little")
    expected = HEADER + FACET * count
    if length < expected:
        raise UnirenderError(
            f"truncated: claims {count:,} triangles in {length:,} bytes, expected {expected:,}; copy it again"
        )
    check_faces(count)
    with path.open("rb") as file:
        data = file.read(expected)  # trimesh takes what follows for a sign that the file is none
        more = any(file.read(FACET))
    if not count and length >= HEADER + FACET:
        raise UnirenderError(
            f"claims 0 triangles, but has bytes for {(length - HEADER) // FACET:,}: its count was never written; "
            "export it again"
        )
    facets = np.frombuffer(data, np.uint8, offset=HEADER).reshape(-1, FACET)
    ignored = {MORE} if more and length >= expected + FACET else set[str]()
    return io.BytesIO(data), ignored | ({ATTRIBUTES} if facets[:, -2:].any() else set())


def _is_text(head: bytes) -> bool:
    """Whether it is one of words, whose name or end may be padded; a binary one's count of facets has a zero."""
    return b"\0" not in head[80:HEADER] and re.search(rb"facet|endsolid", head, re.IGNORECASE) is not None


def _of_text(data: bytes) -> io.BytesIO | None:
    """trimesh takes no face of a solid without an end, and all vertices of a solid as triples, whatever the facets."""
    rewritten = None
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
        rewritten = io.BytesIO(data)
    words = data.lower()
    if b"endsolid" not in words[-END:]:
        raise UnirenderError("truncated: its last solid does not end, expected 'endsolid'; copy it again")
    check_faces(words.count(b"endfacet"))
    words = NAMES.sub(b"", words)
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
    return rewritten
