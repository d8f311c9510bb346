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
    cuts = _cuts(points, sizes, folded, earliest)
    found = {p: cut + first[p] for p, cut in cuts.items() if cut is not None}
    if not found:
        return begun[triangles], polygon
    kept = ~np.isin(polygon, list(found))
    triangles = np.concatenate([triangles[kept], *found.values()])
    polygon = np.concatenate([polygon[kept], *(np.full(len(cut), p) for p, cut in found.items())])
    order = np.argsort(polygon, kind="stable")
    return begun[triangles[order]], polygon[order]


def _cuts(
    points: Float[np.ndarray, "k 3"],
    sizes: Int[np.ndarray, " p"],
    folded: Int[np.ndarray, " q"],
    earliest: Int[np.ndarray, " p"],
) -> dict[int, Int[np.ndarray, "m 3"] | None]:
    """Of the folded polygons, the triangles that fill each, by rows of its corners; None where none do."""
    first = np.cumsum(sizes) - sizes
    cuts: dict[int, Int[np.ndarray, "m 3"] | None] = {}
    for size in np.unique(sizes[folded]).tolist():
        alike = folded[sizes[folded] == size]
        before = earliest[alike]
        rings, rings_before = (points[first[own, None] + np.arange(size)] for own in (alike, before))
        same = (rings[:, 1:] == rings_before[:, :0:-1]).all(axis=(1, 2))
        turned_over = same & (before < alike) & np.isin(before, folded)
        cuts |= zip(alike[~turned_over].tolist(), _other_cuts(rings[~turned_over]), strict=True)
        for p, q in zip(alike[turned_over].tolist(), before[turned_over].tolist(), strict=True):
            cut = cuts[q]  # begins at the same corner and goes round the other way
            cuts[p] = None if cut is None else -cut[:, ::-1] % size
    return cuts


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
    areas, owner = _doubled_areas(points[triangles[several]]), polygon[several]
    whole = np.zeros((len(sizes), 3))
    np.add.at(whole, owner, areas)
    with np.errstate(over="ignore", invalid="ignore"):  # broken coordinates are refused later
        along = (areas * whole[owner]).sum(-1)
        turned = np.bincount(owner, np.maximum(-along, 0), len(sizes))
        return np.flatnonzero(turned > FOLDED * (whole**2).sum(-1))


def _other_cuts(rings: Float[np.ndarray, "g n 3"]) -> list[Int[np.ndarray, "m 3"] | None]:
    """The triangles that fill each of some concave polygons, by rows of its corners; None where none do."""
    found: list[Int[np.ndarray, "m 3"] | None] = [None] * len(rings)
    fan, _ = fans(np.array([rings.shape[1]]))
    normals = _doubled_areas(rings[:, fan]).sum(1)
    areas = np.array([np.linalg.norm(normal) for normal in normals])
    usable = np.flatnonzero(np.isfinite(areas) & (areas > 0))
    rings, normals, areas = rings[usable], normals[usable], areas[usable]
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    flat = (rings - rings[:, :1]) @ np.stack([across, np.cross(normals, across) / areas[:, None]], axis=2)
    end = np.array([rings.shape[1]], np.uint32)
    cuts = [mapbox_earcut.triangulate_float64(plane, end).reshape(-1, 3).astype(np.int64) for plane in flat]
    counts = np.array([len(cut) for cut in cuts], np.int64)
    for count in np.unique(counts):
        alike = np.flatnonzero(counts == count)
        triangles = np.stack([cuts[i] for i in alike])
        along = (_doubled_areas(rings[alike[:, None, None], triangles]) * normals[alike, None]).sum(-1)
        triangles = np.where((along < 0)[..., None], triangles[..., ::-1], triangles)
        filled = np.abs(along).sum(-1) / areas[alike]
        for place in np.flatnonzero(np.abs(filled - areas[alike]) <= SAME_AREA * areas[alike]):
            found[usable[alike[place]]] = triangles[place]
    return found


def _doubled_areas(corners: Float[np.ndarray, "*m 3 3"]) -> Float[np.ndarray, "*m 3"]:
    """Normals of triangles as long as twice their areas."""
    a, b, c = np.moveaxis(corners, -2, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.cross(b - a, c - a)
