"""Shading normals of a piece: the file's own, flat ones (glTF without normals), or creased ones in bounded memory."""

import numpy as np
from jaxtyping import Float, Int

from unirender_reference.meshes.surface import Piece
from unirender_reference.shapes.surface import corner_normals

CREASE_DEG = 40.0
MAX_VALENCE = 256  # a vertex of more corners is not smoothed: the work grows with the square of that number
MAX_PAIRS = 4_000_000  # pairs of corners compared at a time


def piece_normals(piece: Piece) -> Float[np.ndarray, "m 3 3"]:
    """Unit normals of the corners: the file's where all are valid; else creased ones, vertices welded by position."""
    if piece.normals is not None:
        length = np.linalg.norm(piece.normals, axis=-1, keepdims=True)
        if np.isfinite(piece.normals).all() and length.min() > 1e-9 * length.max():
            return piece.normals / length
    used, index = np.unique(piece.faces, return_inverse=True)
    points = piece.vertices[used]
    extent = max(float(np.ptp(points, axis=0).max()), 1e-30)
    rounded = np.rint((points - points.min(0)) / extent * 1e6).astype(np.int64)
    _, first, welded = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    corner = welded.reshape(-1)[index.reshape(-1)]
    corner, points = _parted(corner, np.bincount(corner)[corner] > MAX_VALENCE, points[first])
    work = np.cumsum(np.bincount(corner) ** 2) // MAX_PAIRS  # vertices whose pairs fit into one go share a number
    if work[-1] == 0:
        return corner_normals(points, corner.reshape(-1, 3), CREASE_DEG)
    normals = np.empty((len(corner), 3))
    for part in np.unique(work):
        inside = work[corner] == part
        touched = np.repeat(inside.reshape(-1, 3).any(1), 3)
        local, local_points = _parted(corner[touched], ~inside[touched], points)
        found = corner_normals(local_points, local.reshape(-1, 3), CREASE_DEG).reshape(-1, 3)
        normals[inside] = found[inside[touched]]
    return normals.reshape(-1, 3, 3)


def flat_normals(points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3 3"]:
    """The normal of each face at its three corners; (0, 0, 1) where it has no area."""
    a, b, c = np.moveaxis(points[faces], 1, 0)
    across = np.cross(b - a, c - a)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    unit = np.where(length > 0, across / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    return np.repeat(unit[:, None], 3, axis=1)


def _parted(
    corner: Int[np.ndarray, " k"], alone: np.ndarray, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "j 3"]]:
    """Gives some corners a vertex of their own, at the same point."""
    own = np.where(alone, len(points) + np.cumsum(alone) - 1, corner)
    return own, np.concatenate([points, points[corner[alone]]])
