"""Faces that lie on each other: exporters write a sheet twice, once for each side.

All our surfaces are two-sided, so the second face shows nothing new; which of the two a ray meets is chance, and where
their normals or materials differ the picture is speckled. Only the first face stays; of a flat quadrangle that two
pieces have, cut along one diagonal and along the other, the first piece's. (Within a piece both cuts stay, where the
file has triangles; its polygons are cut alike, see `polygons`.)
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt64

from unirender_reference.meshes.surface import Piece

MIX = np.uint64(0x9E3779B97F4A7C15)
FLAT = 1 - 1e-6  # cosine between the halves of a flat quadrangle


def without_doubles(pieces: list[Piece]) -> tuple[list[Piece], int]:
    """The pieces without faces that cover what earlier ones cover, and how many those were."""
    arrays = {id(piece.vertices): piece.vertices for piece in pieces}  # an OBJ's pieces share one
    numbers = {key: hashed(points) for key, points in arrays.items()}
    keys = np.concatenate([numbers[id(piece.vertices)][piece.faces] for piece in pieces])
    _, first = np.unique(together(keys), return_index=True)
    kept = np.zeros(len(keys), bool)
    kept[first] = True
    counts = [len(piece.faces) for piece in pieces]
    if len(pieces) > 1:
        single = np.flatnonzero(kept)
        corners = np.concatenate([piece.vertices[piece.faces] for piece in pieces])[single]
        owners = np.repeat(np.arange(len(pieces)), counts)[single]
        kept[single[_other_cuts(keys[single], corners, owners)]] = False
    ends = np.cumsum(counts)
    parts = [_chosen(piece, part) for piece, part in zip(pieces, np.split(kept, ends[:-1]), strict=True)]
    return [piece for piece in parts if len(piece.faces)], int((~kept).sum())


def _other_cuts(
    keys: UInt64[np.ndarray, "m 3"], corners: Float[np.ndarray, "m 3 3"], owners: Int[np.ndarray, " m"]
) -> Int[np.ndarray, " k"]:
    """Triangles that are halves of a flat quadrangle whose halves along the other diagonal are of an earlier piece.

    Args:
        keys: numbers of the corner points.
        corners: the points.
        owners: the pieces.
    """
    apex, points = keys.reshape(-1), corners.reshape(-1, 3)  # rows: a triangle's corner, and the edge that faces it
    edge = together(np.stack([keys[:, [1, 2, 0]], keys[:, [2, 0, 1]]], axis=-1).reshape(-1, 2))
    order = np.argsort(edge, kind="stable")
    _, start, count = np.unique(edge[order], return_index=True, return_counts=True)
    pairs = start[count == 2]
    one, other = order[pairs], order[pairs + 1]
    p, q = (points[one - one % 3 + (one + turn) % 3] for turn in (1, 2))
    with np.errstate(over="ignore", invalid="ignore"):  # broken coordinates are refused later
        here, there = np.cross(q - p, points[one] - p), np.cross(q - p, points[other] - p)
        flat = (here * there).sum(-1) < -FLAT * np.linalg.norm(here, axis=-1) * np.linalg.norm(there, axis=-1)
    one, other = one[flat], other[flat]
    diagonal, across = edge[one], together(np.stack([apex[one], apex[other]], axis=-1))
    cut, turned = (_in_turn(np.stack(both, axis=-1)) for both in ((diagonal, across), (across, diagonal)))
    _, a, b = np.intersect1d(cut, turned, return_indices=True)
    later = a[owners[one[a] // 3] > owners[one[b] // 3]]
    return np.concatenate([one[later], other[later]]) // 3


def together(numbers: UInt64[np.ndarray, "n k"]) -> UInt64[np.ndarray, " n"]:
    """A number for several, whatever their order."""
    return _in_turn(np.sort(numbers, axis=1))


def _in_turn(numbers: UInt64[np.ndarray, "n k"]) -> UInt64[np.ndarray, " n"]:
    """A number for several in their order."""
    mixed = np.zeros(len(numbers), np.uint64)
    for column in numbers.T:
        mixed = _mixed(mixed, column)
    return mixed


def hashed(points: Float[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
    """A number for each point, the same for equal points."""
    mixed = np.zeros(len(points), np.uint64)
    for column in (points + 0.0).T:  # -0.0 is 0.0
        mixed = _mixed(mixed, np.ascontiguousarray(column, np.float64).view(np.uint64))
    return mixed


def _mixed(state: UInt64[np.ndarray, " n"], value: UInt64[np.ndarray, " n"]) -> UInt64[np.ndarray, " n"]:
    state = (state ^ value) * MIX
    return state ^ (state >> np.uint64(29))


def _chosen(piece: Piece, kept: np.ndarray) -> Piece:
    if kept.all():
        return piece
    return replace(
        piece,
        faces=piece.faces[kept],
        normals=None if piece.normals is None else piece.normals[kept],
        uv={i: values[kept] for i, values in piece.uv.items()},
        colors=None if piece.colors is None else piece.colors[kept],
    )
