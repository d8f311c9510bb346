"""A model to OBJ, MTL and pictures: geometry, normals, texture coordinates and albedo, which is what a mix has.

Vertex colours count as their mean: OBJ has no standard place for them. MTL repeats a picture along both axes or clamps
it along both: what is mirrored, or clamped along one, is repeated.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.color import srgb_encode
from unirender_reference.meshes.images import resized
from unirender_reference.meshes.surface import Channel, Model, Piece, Texture

PICTURE_SIDE = 512  # most pixels of a picture along each side
PNG_SIDE = 64  # up to which pictures are PNG: each texel of a palette counts
JPEG_QUALITY = 95


def write_obj(model: Model, folder: Path, name: str, header: Sequence[str] = ()) -> Path:
    """Writes `name`.obj, `name`.mtl and the pictures that they name into a folder that exists.

    Args:
        model: whose albedo is written.
        folder: where.
        name: of the files, without a suffix.
        header: lines of comment at the head of the OBJ.

    Returns:
        The OBJ.
    """
    mtl: list[str] = []
    materials: dict[tuple[int, bytes, bool, bool], str] = {}
    pictures = _Pictures(folder, name)
    obj = [*(f"# {line}" for line in header), f"mtllib {name}.mtl"]
    counts = np.ones(3, np.int64)  # of points, coordinates and normals so far, from 1
    points: dict[int, int] = {}  # where the points of an array that pieces share begin
    for piece in model.pieces:
        if id(piece.vertices) not in points:
            points[id(piece.vertices)] = int(counts[0])
            counts[0] += len(piece.vertices)
            obj += _rows("v", piece.vertices)
        albedo = piece.material.channels["albedo"]
        mean = np.ones(3) if piece.colors is None else piece.colors.reshape(-1, 3).mean(0)
        uv = _coordinates(piece, albedo)
        key = id(albedo), mean.tobytes(), uv is None, piece.normals is None  # all faces of a material have the same
        if key not in materials:
            materials[key] = f"m{len(materials)}"
            mtl += [f"newmtl {materials[key]}", pictures.line(albedo, mean)]
        corners = [(piece.faces + points[id(piece.vertices)]).reshape(-1), None, None]
        for kind, keyword, values in ((1, "vt", uv), (2, "vn", piece.normals)):
            if values is None:
                continue
            flat = values.reshape(-1, values.shape[-1])
            corners[kind] = counts[kind] + np.arange(len(flat))
            counts[kind] += len(flat)
            obj += _rows(keyword, flat)
        obj.append(f"usemtl {materials[key]}")
        obj += _faces(corners)
    (folder / f"{name}.mtl").write_text("\n".join(mtl) + "\n", encoding="utf-8")
    path = folder / f"{name}.obj"
    path.write_text("\n".join(obj) + "\n", encoding="utf-8")
    return path


def _rows(keyword: str, values: Float[np.ndarray, "n c"]) -> Iterator[str]:
    return (f"{keyword} {' '.join(f'{x:.7g}' for x in row)}" for row in values.tolist())


def _coordinates(piece: Piece, albedo: Channel) -> Float[np.ndarray, "m 3 2"] | None:
    """Where the corners look into the picture, v from below, as OBJ has it."""
    if not isinstance(albedo, Texture) or albedo.texcoord not in piece.uv:
        return None
    uv = piece.uv[albedo.texcoord] @ albedo.transform[:, :2].T + albedo.transform[:, 2]
    return uv * [1, -1] + [0, 1]


def _faces(corners: list[np.ndarray | None]) -> Iterator[str]:
    """Triangles: three corners `point/coordinate/normal` each, as far as there are such."""
    points, coordinates, normals = corners
    assert points is not None
    texts = [str(p) for p in points.tolist()]
    if coordinates is not None or normals is not None:
        seconds = [""] * len(texts) if coordinates is None else map(str, coordinates.tolist())
        texts = [f"{a}/{b}" for a, b in zip(texts, seconds, strict=True)]
    if normals is not None:
        texts = [f"{a}/{c}" for a, c in zip(texts, normals.tolist(), strict=True)]
    return (f"f {' '.join(texts[i : i + 3])}" for i in range(0, len(texts), 3))


class _Pictures:
    """The pictures of a model, each written once."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.files: dict[tuple[int, bytes], str] = {}

    def line(self, albedo: Channel, factor: Float[np.ndarray, "3"]) -> str:
        """What MTL says of an albedo times a colour."""
        if not isinstance(albedo, Texture):
            return f"Kd {' '.join(f'{x:.6f}' for x in _encoded(albedo * factor).tolist())}"
        key = id(albedo.texels), factor.tobytes()
        if key not in self.files:
            self.files[key] = self._write(albedo.texels * factor)
        return f"map_Kd {'-clamp on ' if albedo.wrap == ('clamp', 'clamp') else ''}{self.files[key]}"

    def _write(self, texels: Float[np.ndarray, "h w 3"]) -> str:
        height, width = texels.shape[:2]
        scale = min(1.0, PICTURE_SIDE / max(height, width))
        reduced = resized(texels, max(1, round(height * scale)), max(1, round(width * scale)))
        small = max(reduced.shape[:2]) <= PNG_SIDE
        file = f"{self.name}_{len(self.files)}.{'png' if small else 'jpg'}"
        picture = Image.fromarray(np.round(_encoded(reduced) * 255).astype(np.uint8))
        picture.save(self.folder / file, quality=JPEG_QUALITY, subsampling=0)  # which PNG does not look at
        return file


def _encoded(linear: np.ndarray) -> np.ndarray:
    return srgb_encode(np.clip(linear, 0, 1))
