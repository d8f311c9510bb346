"""PLY, STL and OFF through trimesh: geometry, vertex and face colours (sRGB-coded), one texture of a PLY.

trimesh trusts the counts of a header, so those are held against the size of the file first.
"""

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.colors import unit_colors
from unirender_reference.meshes.folder import FolderResolver, ModelFolder
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
from unirender_reference.meshes.surface import Channel, Material, Model, Piece, Texture

PLY_ELEMENT = re.compile(rb"^element\s+(\w+)\s+(\d+)\s*$", re.MULTILINE)
PLY_TEXT = re.compile(rb"^format\s+ascii", re.MULTILINE)
FACES_LAST = re.compile(rb"^element\s+face\s+\d+\s+property\s+list[^\n]*\s*\Z", re.MULTILINE)
DOUBLE = re.compile(rb"^format ascii|^property (double|float64) x", re.MULTILINE)
PLY_COLOR = re.compile(rb"^(property\s+\w+\s+)((?:diffuse_)?(?:red|green|blue)|[rgb])(?=\s*$)", re.MULTILINE)
PLY_COLORS = ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")
USUAL = {b"r": b"red", b"g": b"green", b"b": b"blue"}
HEAD = 65536  # bytes that are looked at before trimesh reads the file
STL_HEADER, STL_FACET = 84, 50  # bytes of a binary file: its header with the count, and each facet
FACET_ATTRIBUTES = "attributes of facets"  # among what is ignored
WHITE = Material({"albedo": np.ones(3, np.float32)})
TEXTURE_COMMENT = re.compile(rb"^comment\s+TextureFile\s+(.+?)\s*$", re.MULTILINE)


def read_through_trimesh(path: Path, folder: ModelFolder) -> Model:
    """Reads a PLY, STL or OFF file.

    Args:
        path: the file.
        folder: where the texture of a PLY may lie.

    Raises:
        UnirenderError: the file claims more than it holds, or a limit is exceeded; also whatever trimesh raises.
    """
    length = path.stat().st_size
    check_bytes(length, "the file")
    with path.open("rb") as file:
        head = file.read(HEAD)
    _check_claims(path.suffix.lower(), head, length)
    _check_end(path, head)
    texture = _texture(folder, head)
    off = read_off_lines(path) if path.suffix.lower() == ".off" else OffLines()
    resolver = FolderResolver(folder)
    kind, rewritten, ignored = path.suffix.lower()[1:], None, {"colours"} if off.left_out else set[str]()
    if kind == "ply":
        rewritten = _with_usual_colors(path, head)
    elif kind == "stl" and not _is_text(head):
        rewritten = _whole_facets(path, head)
        ignored |= {FACET_ATTRIBUTES} if _has_attributes(rewritten) else set()
    if rewritten is None:
        scene = trimesh.load_scene(path, process=False, resolver=resolver)
    else:
        scene = trimesh.load_scene(rewritten, file_type=kind, process=False, resolver=resolver)
    if resolver.error:
        raise resolver.error
    pieces = []
    for mesh in scene.geometry.values():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            check_faces(len(mesh.faces))
            if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
                raise UnirenderError(f"its faces index outside the {len(mesh.vertices):,} vertices; export it again")
            step = 0.0 if DOUBLE.search(head) or path.suffix.lower() == ".off" else float32_step(mesh.vertices)
            piece = _piece(mesh, texture, step)
            if piece.colors is None and not piece.uv and _stored_colors(mesh, "face") is not None:
                ignored.add("colours")
            if off.normals is not None:
                piece = replace(piece, normals=off.normals[piece.faces])
            if off.colored:
                piece = replace(piece, colors=off.corners(piece.faces), material=WHITE)
            pieces.append(piece)
    return Model(pieces, frozenset(ignored))


def _is_text(head: bytes) -> bool:
    """Whether an STL is one of words, whose name or end may be padded; a binary one's count of facets has a zero."""
    return b"\0" not in head[80:STL_HEADER] and re.search(rb"facet|endsolid", head, re.IGNORECASE) is not None


def _facets(head: bytes) -> int:
    """How many facets a binary STL claims."""
    return int.from_bytes(head[80:STL_HEADER], "little")


def _whole_facets(path: Path, head: bytes) -> io.BytesIO:
    """A binary STL without what follows its last facet, which trimesh takes for a sign that it is none."""
    with path.open("rb") as file:
        return io.BytesIO(file.read(STL_HEADER + STL_FACET * _facets(head)))


def _has_attributes(stl: io.BytesIO) -> bool:
    """Whether a facet has attributes: the two last bytes of each, where some exporters keep a colour."""
    facets = np.frombuffer(stl.getbuffer(), np.uint8, offset=STL_HEADER).reshape(-1, STL_FACET)
    return bool(facets[:, -2:].any())


def _with_usual_colors(path: Path, head: bytes) -> io.BytesIO | None:
    """The file with `red green blue` for the properties `diffuse_red ...` or `r g b`, where it has these alone."""
    header = head.partition(b"end_header")[0]
    spelled = [name.decode() for _, name in PLY_COLOR.findall(header)]
    if {"red", "green", "blue"} <= set(spelled) or not any(set(names) <= set(spelled) for names in PLY_COLORS):
        return None
    full = PLY_COLOR.sub(lambda found: found[1] + USUAL[found[2].removeprefix(b"diffuse_")[:1]], header)
    with path.open("rb") as file:
        file.seek(len(header))
        return io.BytesIO(full + file.read())


def _check_claims(suffix: str, head: bytes, length: int) -> None:
    """Counts in a header that the file cannot hold; an element takes a byte at least."""
    claims: dict[str, int] = {}
    if suffix == ".ply" and head[:3] == b"ply":
        if b"end_header" not in head:
            raise UnirenderError(f"truncated: its header does not end within {len(head):,} bytes; export it again")
        claims = {name.decode(): int(count) for name, count in PLY_ELEMENT.findall(head.partition(b"end_header")[0])}
    elif suffix == ".off":
        numbers = re.findall(rb"\d+", re.sub(rb"#[^\n]*", b"", head).partition(b"OFF")[2])[:2]
        claims = dict(zip(("vertex", "face"), map(int, numbers), strict=False))
    elif suffix == ".stl" and not _is_text(head):
        count = _facets(head)
        expected = STL_HEADER + STL_FACET * count
        if length < expected:
            raise UnirenderError(f"truncated: claims {count:,} triangles in {length:,} bytes, expected {expected:,}")
    for name, count in claims.items():
        limit = MAX_FACES if name == "face" else MAX_VERTICES
        if count > limit:
            raise UnirenderError(f"claims {count:,} of element {name}, expected at most {limit:,}")
        if count > length:
            raise UnirenderError(f"truncated: claims {count:,} of element {name} in {length:,} bytes")


def _check_end(path: Path, head: bytes) -> None:
    """A text that is cut off: trimesh takes the faces of a PLY that are left, and of an STL none."""
    if path.suffix.lower() == ".ply" and PLY_TEXT.search(head):
        header, _, body = path.read_bytes().partition(b"end_header")
        claimed = sum(int(count) for _, count in PLY_ELEMENT.findall(header))
        lines = [line for line in body.splitlines() if line.strip()]
        if len(lines) < claimed:
            raise UnirenderError(
                f"truncated: its header claims {claimed:,} lines, it has {len(lines):,}; copy it again"
            )
        last = lines[claimed - 1].split() if claimed and FACES_LAST.search(header) else [b"0", b""]
        if len(last) <= int(last[0]):
            raise UnirenderError(
                f"truncated: its last face has {len(last) - 1} of {int(last[0])} corners; copy it again"
            )
    elif path.suffix.lower() == ".stl" and _is_text(head):
        with path.open("rb") as file:
            file.seek(-min(path.stat().st_size, HEAD), io.SEEK_END)  # zeros may follow
            if b"endsolid" not in file.read().lower():
                raise UnirenderError("truncated: its last solid does not end, expected 'endsolid'; copy it again")


def _texture(folder: ModelFolder, head: bytes) -> Texture | None:
    """The picture that a PLY header names, as MeshLab writes it."""
    names = list(dict.fromkeys(TEXTURE_COMMENT.findall(head.partition(b"end_header")[0])))
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
    visual: Any = mesh.visual
    faces = np.asarray(mesh.faces, np.int64)
    vertices = np.asarray(mesh.vertices, np.float64)
    stored = mesh._cache["vertex_normals"]  # the file's, or None; the property would compute them
    uv = np.asarray(getattr(visual, "uv", None), np.float64)  # of any shape
    textured = texture is not None and uv.shape == (len(vertices), 2) and bool(np.isfinite(uv).all())
    colors = None if textured else _colors(mesh, faces)
    albedo: Channel = np.full(3, 1.0 if colors is not None else DEFAULT_ALBEDO, np.float32)
    material = getattr(visual, "material", None)
    if textured:
        assert texture is not None
        albedo = texture
    elif colors is None and isinstance(material, SimpleMaterial | PBRMaterial) and texture is not None:
        albedo = texture.texels.mean((0, 1))
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
    if kind == "vertex":
        return linear[faces] if len(linear) == len(mesh.vertices) else None
    # Of polygons with more corners trimesh makes triangles in another order.
    return np.repeat(linear[:, None], 3, axis=1) if len(linear) == len(faces) else None


def _stored_colors(mesh: trimesh.Trimesh, element: str) -> np.ndarray | None:
    """Red, green and blue of a PLY's vertices or faces in the type that the file has; trimesh takes floats as of 1."""
    data = mesh.metadata.get("_ply_raw", {}).get(element, {}).get("data")
    names = data.dtype.names or () if isinstance(data, np.ndarray) else data or ()
    if data is None or not {"red", "green", "blue"} <= set(names):
        return None
    return np.stack([np.asarray(data[name]).reshape(-1) for name in ("red", "green", "blue")], axis=-1)
