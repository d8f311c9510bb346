"""Polygons cut into triangles: into fans from their first corner, and where a fan would reach beyond a concave polygon,
along other diagonals. A polygon that is written twice, once for each side, is cut alike both times.
"""

import mapbox_earcut
import numpy as np
from jaxtyping import Bool, Float, Int

from unirender_reference.meshes.doubles import hashed, together
from unirender_reference.meshes.limits import check_corners

FOLDED = 1e-3  # triangles turned against their polygon, together more than this share of its area
SAME_AREA = 1e-3  # by which the area of a cut may miss the polygon's


def triangulate(
    points: Float[np.ndarray, "k 3"], sizes: Int[np.ndarray, " p"]
) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Triangles of polygons, in the polygons' order and turned as they are.

    Args:
        points: the corners of all polygons, one polygon after the other.
        sizes: corners of each polygon, 3 and more.

    Returns:
        The triangles' corners as rows of `points`, and the polygon of each triangle. A polygon that cuts itself, which
        no cut fills, remains a fan.

    Raises:
        UnirenderError: a concave polygon has too many corners.
    """
    triangles, polygon = fans(sizes)
    first = np.cumsum(sizes) - sizes
    earliest, begun = _begun_alike(points, sizes)
    points = points[begun]
    folded = _folded(points, sizes, triangles, polygon)
    check_corners(int(sizes[folded].max(initial=0)))
    cuts: dict[int, Int[np.ndarray, "m 3"] | None] = {}
    for p, q in zip(folded.tolist(), earliest[folded].tolist(), strict=True):
        ring, before = (points[first[own] : first[own] + sizes[own]] for own in (p, q))
        turned_over = q in cuts and np.array_equal(ring[1:], before[:0:-1])
        cuts[p] = _turned_over(cuts[q], len(ring)) if turned_over else _other_cut(ring)
    found = {p: cut + first[p] for p, cut in cuts.items() if cut is not None}
    if not found:
        return begun[triangles], polygon
    kept = ~np.isin(polygon, list(found))
    triangles = np.concatenate([triangles[kept], *found.values()])
    polygon = np.concatenate([polygon[kept], *(np.full(len(cut), p) for p, cut in found.items())])
    order = np.argsort(polygon, kind="stable")
    return begun[triangles[order]], polygon[order]


def _turned_over(cut: Int[np.ndarray, "m 3"] | None, corners: int) -> Int[np.ndarray, "m 3"] | None:
    """The same triangles of the polygon that begins at the same corner and goes round the other way."""
    return None if cut is None else -cut[:, ::-1] % corners


def _begun_alike(
    points: Float[np.ndarray, "k 3"], sizes: Int[np.ndarray, " p"]
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " k"]]:
    """Of each polygon the first that has its corners, and the rows of its corners from that one's first on."""
    first = np.cumsum(sizes) - sizes
    owner = np.repeat(np.arange(len(sizes)), sizes)
    numbers, keys = hashed(points), np.zeros(len(sizes), np.uint64)
    for size in np.unique(sizes):
        alike = np.flatnonzero(sizes == size)
        keys[alike] = together(numbers[first[alike, None] + np.arange(size)])
    _, earliest, which = np.unique(keys, return_index=True, return_inverse=True)
    begin = np.flatnonzero(numbers == numbers[first[earliest[which]]][owner])
    again, at = np.unique(owner[begin], return_index=True)
    shift = np.zeros(len(sizes), np.int64)
    shift[again] = begin[at] - first[again]
    step = np.arange(len(points)) - first[owner]
    return earliest[which], first[owner] + (step + shift[owner]) % sizes[owner]


def fans(sizes: Int[np.ndarray, " p"]) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """The same for convex polygons, whose corners need not be looked at."""
    count = sizes - 2
    polygon = np.repeat(np.arange(len(sizes)), count)
    first = (np.cumsum(sizes) - sizes)[polygon]
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(count) - count, count)
    return np.stack([first, first + step + 1, first + step + 2], axis=1), polygon


def strip(corners: Int[np.ndarray, " n"]) -> Int[np.ndarray, "m 3"]:
    """Triangles of a strip: each corner and the two behind it, every second one turned round."""
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2][:, [0, 2, 1]]
    return triangles


def _folded(
    points: Float[np.ndarray, "k 3"],
    sizes: Int[np.ndarray, " p"],
    triangles: Int[np.ndarray, "m 3"],
    polygon: Int[np.ndarray, " m"],
) -> Int[np.ndarray, " q"]:
    """Polygons of four corners and more of whose fan some triangles are turned against the whole."""
    several: Bool[np.ndarray, " m"] = sizes[polygon] > 3
    areas, owner = _doubled_areas(points, triangles[several]), polygon[several]
    whole = np.zeros((len(sizes), 3))
    np.add.at(whole, owner, areas)
    with np.errstate(over="ignore", invalid="ignore"):  # broken coordinates are refused later
        along = (areas * whole[owner]).sum(-1)
        turned = np.bincount(owner, np.maximum(-along, 0), len(sizes))
        return np.flatnonzero(turned > FOLDED * (whole**2).sum(-1))


def _other_cut(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "m 3"] | None:
    """The triangles that fill one concave polygon, by rows of its corners; None where none do."""
    fan, _ = fans(np.array([len(points)]))
    normal = _doubled_areas(points, fan).sum(0)
    area = float(np.linalg.norm(normal))
    if not (np.isfinite(area) and area > 0):
        return None
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    flat = (points - points[0]) @ np.stack([across, np.cross(normal, across) / area], axis=1)
    cut = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), np.array([len(flat)], np.uint32))
    triangles = cut.reshape(-1, 3).astype(np.int64)
    turned = (_doubled_areas(points, triangles) * normal).sum(-1) < 0
    triangles[turned] = triangles[turned, ::-1]
    filled = np.abs((_doubled_areas(points, triangles) * normal).sum(-1)).sum() / area
    return triangles if abs(filled - area) <= SAME_AREA * area else None


def _doubled_areas(points: Float[np.ndarray, "k 3"], triangles: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Normals as long as twice the triangles' areas."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.cross(b - a, c - a)
