"""Meshes in other proportions and put together: more shapes to train on than a folder has.

A *mix* is one to three meshes, most of them stretched along their axes, all turned, and pushed into the first; some of
their materials have another colour, or the picture of another mesh. What comes out is made of the same parts, so it
belongs on their side of a split.

Of the materials the albedo alone is kept: roughness and metallic come from the scene, as with any OBJ file.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.meshes.surface import Channel, Material, Model, Piece, Texture

MAX_PARTS = 3
ANOTHER_PART = 0.5  # probability of one more, up to `MAX_PARTS`
STRETCH = 0.3  # standard deviation of the logarithm of the size along each axis
KEPT_SHAPE = 0.25, 0.4  # probability that a mesh by itself, or a part, keeps its proportions
TUMBLED = 0.35  # probability of any rotation at all, instead of one about +y
PART_SIZE = 0.4, 1.0  # of every part but the first, whose longest side is 1
REACH = 1.0  # how far out in the box of the first, as it is turned, the others' middles lie; 1: to its faces
RECOLOURED, REPICTURED = 0.25, 0.25  # probability that a material gets a colour, or another mesh's picture
GREY = 0.5  # share of grey among the colours


def draw_count(rng: np.random.Generator) -> int:
    """How many meshes a mix is made of."""
    count = 1
    while count < MAX_PARTS and rng.random() < ANOTHER_PART:
        count += 1
    return count


def mixed(parts: Sequence[Model], pictures: Sequence[Texture], rng: np.random.Generator) -> Model:
    """One mesh made of several.

    Args:
        parts: one or more, as they were read, in any units.
        pictures: of other meshes, for some of the materials that have one.
        rng: decides all of it.

    Returns:
        The mix, in units of the first part's longest side; `ignored` as the parts have it.

    Raises:
        UnirenderError: a part has no extent, or coordinates that are no numbers.
    """
    pieces: list[Piece] = []
    box = np.zeros((2, 3))  # of the first, as it is turned: low and high corner
    for number, part in enumerate(parts):
        placed = _Placed.drawn(part, box, alone=len(parts) == 1, first=number == 0, rng=rng)
        materials: dict[int, Material] = {}  # pieces share them, and the arrays of vertices
        vertices: dict[int, Float[np.ndarray, "n 3"]] = {}
        for piece in part.pieces:
            if id(piece.material) not in materials:
                materials[id(piece.material)] = _changed(piece.material, pictures, rng)
            if id(piece.vertices) not in vertices:
                vertices[id(piece.vertices)] = placed.points(piece.vertices)
            material = materials[id(piece.material)]
            pieces.append(
                replace(
                    piece,
                    vertices=vertices[id(piece.vertices)],
                    normals=placed.normals(piece.normals),
                    colors=piece.colors if _same_albedo(piece.material, material) else None,
                    material=material,
                )
            )
        if number == 0:
            box = np.stack([_points(pieces).min(0), _points(pieces).max(0)])
    return Model(pieces, frozenset().union(*(part.ignored for part in parts)))


@dataclass(frozen=True)
class _Placed:
    """Where a part goes: x -> matrix (x - middle) + shift; the middle is that of its own box, before it is turned."""

    middle: Float[np.ndarray, "3"]
    matrix: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    @classmethod
    def drawn(
        cls, part: Model, box: Float[np.ndarray, "2 3"], *, alone: bool, first: bool, rng: np.random.Generator
    ) -> "_Placed":
        corners = _points(part.pieces)
        low, high = corners.min(0), corners.max(0)
        longest = float((high - low).max())
        if not np.isfinite(longest) or longest <= 0:
            raise UnirenderError(f"has an extent of {longest:g}, expected more than 0; export it again")
        kept = rng.random() < KEPT_SHAPE[0 if alone else 1]
        stretch = np.ones(3) if kept else np.exp(rng.normal(size=3) * STRETCH)
        size = 1.0 if first else rng.uniform(*PART_SIZE)
        shift = box.mean(0) if first else box.mean(0) + REACH * rng.uniform(-1, 1, 3) * np.ptp(box, axis=0) / 2
        return cls((low + high) / 2, _rotation(rng) @ np.diag(stretch) * (size / longest), shift)

    def points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return (points - self.middle) @ self.matrix.T + self.shift

    def normals(self, normals: Float[np.ndarray, "m 3 3"] | None) -> Float[np.ndarray, "m 3 3"] | None:
        """By the inverse transpose, of unit length."""
        if normals is None:
            return None
        turned = normals @ np.linalg.inv(self.matrix)
        return turned / np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-30)


def _points(pieces: Sequence[Piece]) -> Float[np.ndarray, "n 3"]:
    """What the faces use."""
    return np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces])


def _rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """About +y by any angle, or any rotation at all."""
    if rng.random() < TUMBLED:
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        q = q * np.sign(np.diag(r))
        return q * np.linalg.det(q)  # its determinant is 1 or -1, and becomes 1
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _changed(material: Material, pictures: Sequence[Texture], rng: np.random.Generator) -> Material:
    """The albedo of a material, or another colour or picture in its place."""
    albedo = material.channels["albedo"]
    what = rng.random()
    if what < RECOLOURED:
        return _of(_color(rng))
    if what < RECOLOURED + REPICTURED and isinstance(albedo, Texture) and pictures:
        picture = pictures[int(rng.integers(len(pictures)))]
        return _of(Texture(picture.texels, albedo.texcoord, albedo.transform, albedo.wrap))
    return _of(albedo)


def _same_albedo(before: Material, after: Material) -> bool:
    """Whether a material kept its colour or picture, which vertex colours multiply."""
    return before.channels["albedo"] is after.channels["albedo"]


def _of(albedo: Channel) -> Material:
    channels: Mapping[str, Channel] = {"albedo": albedo}
    return Material(channels)


def _color(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Linear."""
    if rng.random() < GREY:
        return np.full(3, rng.uniform(0.02, 0.9), np.float32)
    return rng.beta(1.2, 1.6, 3).astype(np.float32)


def pictures_of(model: Model) -> list[Texture]:
    """The pictures of a mesh's albedo, each once."""
    albedos = [piece.material.channels["albedo"] for piece in model.pieces]
    return list({id(albedo): albedo for albedo in albedos if isinstance(albedo, Texture)}.values())
