"""What a reader hands on: pieces of mesh with a material, before anything is put into one atlas.

Channels, the same for every format: `albedo` (3, linear), `roughness` (1, perceptual), `metallic` (1), `normal` (3,
unit tangent-space vectors with y up in the picture). A channel is one value or a texture.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

Wrap = Literal["repeat", "mirror", "clamp"]
IDENTITY = np.eye(2, 3)
BARE = "textures of faces without coordinates"  # among what is ignored: they count as their mean


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture and how texture coordinates find it.

    Attributes:
        texels: (h, w, c) float32, decoded: linear colour, roughness, unit vectors.
        texcoord: which set of coordinates of the piece.
        transform: affine, coordinates of the set -> coordinates of the picture (v from its first row).
        wrap: outside [0, 1], along u and along v.
    """

    texels: Float[np.ndarray, "h w c"]
    texcoord: int = 0
    transform: Float[np.ndarray, "2 3"] = field(default_factory=lambda: IDENTITY)
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def scaled(self, factor: Float[np.ndarray, " c"]) -> "Texture":
        """The same picture times a colour."""
        return replace(self, texels=self.texels * factor)


BURIED = -0.1  # z of a normal that points into the surface, and not along it by rounding or resampling
Channel = Texture | Float[np.ndarray, " c"]


@dataclass(frozen=True, eq=False)
class Material:
    """The channels of a surface; `albedo` always, `roughness` and `metallic` both or neither, `normal` or not."""

    channels: Mapping[str, Channel]

    def has_smaller_textures(self) -> bool:
        """Whether it has pictures of different size: the smaller ones are interpolated to the largest (`tiles`)."""
        textures = [channel for channel in self.channels.values() if isinstance(channel, Texture)]
        return len({texture.texels.shape[:2] for texture in textures} - {(1, 1)}) > 1


@dataclass(frozen=True)
class Piece:
    """Triangles of one material in world space.

    Attributes:
        vertices: (n, 3).
        faces: (m, 3), counter-clockwise seen from outside.
        normals: (m, 3, 3) of each corner, of any length; None where the file has none.
        uv: (m, 3, 2) of each corner, by set; v from the first row.
        colors: (m, 3, 3) linear colours of each corner that multiply the albedo, or None.
        material: shared by the pieces that have the same one.
        step: distance between neighbouring coordinates that the file can tell apart, in world units; 0 for text.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 3 3"] | None
    uv: Mapping[int, Float[np.ndarray, "m 3 2"]]
    colors: Float[np.ndarray, "m 3 3"] | None
    material: Material
    step: float = 0.0


@dataclass(frozen=True)
class Model:
    """A whole file: its pieces and what of it is not part of our contract ("alpha", "emission", ...)."""

    pieces: list[Piece]
    ignored: frozenset[str]


def tangent_normals(
    texels: Float[np.ndarray, "h w 3"], scale: float
) -> tuple[Float[np.ndarray, "h w 3"], frozenset[str]]:
    """The vectors of a normal map's numbers in [0, 1], and what of them is left out.

    A tangent-space normal points out of its surface (glTF 2.0, 3.9.3). Those that point into it (the black around
    charts, object-space maps) count as flat: Mitsuba turns them round, and the surface then reflects light that it does
    not receive.
    """
    vectors = unit_vectors(2 * texels - 1, scale)
    buried = vectors[..., 2] < BURIED
    vectors[buried] = [0, 0, 1]
    return vectors, frozenset({"normals into the surface"} if buried.any() else ())


def unit_vectors(vectors: Float[np.ndarray, "h w 3"], scale: float) -> Float[np.ndarray, "h w 3"]:
    """Tangent-space vectors with x and y scaled, normalised; (0, 0, 1) where there is none."""
    scaled = vectors * np.array([scale, scale, 1], np.float32)
    length = np.linalg.norm(scaled, axis=-1, keepdims=True)
    flat = np.array([0, 0, 1], np.float32)
    return np.where(length > 1e-6, scaled / np.maximum(length, 1e-6), flat).astype(np.float32)
