"""Faces that lie on each other: exporters write a sheet twice, once for each side.

All our surfaces are two-sided, so the second face shows nothing new; which of the two a ray meets is chance, and where
their normals or materials differ the picture is speckled. Only the first face stays.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt64

from unirender_reference.meshes.surface import Piece

MIX = np.uint64(0x9E3779B97F4A7C15)


def without_doubles(pieces: list[Piece]) -> tuple[list[Piece], int]:
    """The pieces without faces whose three corner points are those of an earlier face, and how many those were."""
    arrays = {id(piece.vertices): piece.vertices for piece in pieces}  # an OBJ's pieces share one
    hashed = {key: _hashed(points) for key, points in arrays.items()}
    keys = [np.sort(hashed[id(piece.vertices)][piece.faces], axis=1).astype(np.uint64) for piece in pieces]
    mixed = np.zeros(sum(map(len, keys)), np.uint64)
    for column in np.concatenate(keys).T:
        mixed = _mixed(mixed, column)
    _, first = np.unique(mixed, return_index=True)
    kept = np.zeros(len(mixed), bool)
    kept[first] = True
    ends = np.cumsum([len(piece.faces) for piece in pieces])
    parts = [_chosen(piece, part) for piece, part in zip(pieces, np.split(kept, ends[:-1]), strict=True)]
    return [piece for piece in parts if len(piece.faces)], int((~kept).sum())


def _hashed(points: Float[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
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
