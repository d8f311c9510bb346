"""From a surface to a renderable mesh: charts, texture coordinates, creased normals, assembly.

A `Part` is a closed mesh whose triangles carry texture coordinates, with a *position map*: the point of the surface
that each texel shows. A solid texture is baked by evaluating it on the position map, so that it runs on across seams.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from unirender_reference.shapes.mesh_object import signed_volume

TEXTURE = (144, 144)
DENSITY = 80
MARGIN = 2
CHART_SMOOTHING = 6


@dataclass(frozen=True)
class Part:
    """A closed mesh with its chart.

    Attributes:
        vertices: (n, 3), welded: one vertex per point of the surface.
        faces: (m, 3), outward.
        corner_uv: (m, 3, 2) texture coordinates of each triangle's corners.
        position_map: (h, w, 3) the surface point under each texel.
        crease_deg: neighbouring faces that meet at a larger angle do not share a normal.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    corner_uv: Float[np.ndarray, "m 3 2"]
    position_map: Float[np.ndarray, "h w 3"]
    crease_deg: float


def outward(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "m 3"]:
    """Faces turned round where the mesh encloses a negative volume."""
    return faces[:, ::-1].copy() if signed_volume(vertices, faces) < 0 else faces


def grid_part(
    surface: Float[np.ndarray, "rows columns 3"], *, wrap_rows: bool = False, crease_deg: float = 40.0
) -> Part:
    """A surface given on a grid, closed along its columns (the last column repeats the first).

    Along the rows it closes on itself (`wrap_rows`: the last row repeats the first) or ends in a point at each end
    (the first and last rows are one point each).
    """
    rows, columns, _ = surface.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    index[:, -1] = index[:, 0]
    if wrap_rows:
        index[-1] = index[0]
    else:
        index[0], index[-1] = index[0, 0], index[-1, 0]
    h, w = TEXTURE
    down = _arc_length(np.linalg.norm(np.diff(surface, axis=0), axis=2).mean(1))
    along = _arc_length(np.linalg.norm(np.diff(surface, axis=1), axis=2).mean(0))
    uv = np.stack(np.broadcast_arrays((along * (w - 1) + 0.5) / w, ((down * (h - 1) + 0.5) / h)[:, None]), axis=-1)
    uv = uv.reshape(-1, 2)

    own = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = own[:-1, :-1], own[:-1, 1:], own[1:, 1:], own[1:, :-1]
    corners = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    faces = index.reshape(-1)[corners]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    corners, faces = corners[proper], faces[proper]
    vertices = surface.reshape(-1, 3).astype(np.float32)
    if signed_volume(vertices, faces) < 0:
        corners, faces = corners[:, ::-1], faces[:, ::-1]

    at = np.meshgrid(
        np.interp(np.linspace(0, 1, h), down, np.arange(rows)),
        np.interp(np.linspace(0, 1, w), along, np.arange(columns)),
        indexing="ij",
    )
    grid = vertices.reshape(surface.shape)
    positions = np.stack([ndimage.map_coordinates(grid[..., k], at, order=1) for k in range(3)], axis=-1)
    return Part(vertices, faces, uv[corners].astype(np.float32), positions, crease_deg)


def _arc_length(steps: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Cumulative length in [0, 1]; a step counts at least a tenth of an even share, so that none collapses."""
    steps = np.maximum(steps, 0.1 * steps.mean())
    return np.concatenate([[0], np.cumsum(steps)]) / steps.sum()


def box_part(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], *, crease_deg: float = 40.0) -> Part:
    """Any closed mesh, cut into charts that are each projected along one axis.

    A face belongs to the axis and side that the smoothed normal is nearest to; a chart is a connected set of faces of
    one side. All charts share one scale and are packed in shelves; `DENSITY` texels span the largest extent.
    """
    vertices, faces = vertices.astype(np.float32), outward(vertices, faces)
    chart, side = _charts(vertices, faces)
    scale = (DENSITY - 1) / float(np.ptp(vertices, axis=0).max())
    across = np.array([[1, 2], [1, 2], [0, 2], [0, 2], [0, 1], [0, 1]])[side]  # of each face
    flat = np.take_along_axis(vertices[faces], across[:, None, :].repeat(3, 1), axis=2) * scale  # (m, 3, 2) texels

    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, flat.min(1))
    np.maximum.at(high, chart, flat.max(1))
    size = np.ceil(high - low).astype(int) + 1 + 2 * MARGIN
    corner, (height, width) = _shelves(size)
    texel = flat - (low - corner - MARGIN)[chart][:, None, :]  # texel coordinates, centres at integers
    uv = (texel + 0.5) / np.array([width, height])
    return Part(vertices, faces, uv.astype(np.float32), _rasterise(vertices, faces, texel, (height, width)), crease_deg)


def _charts(vertices: np.ndarray, faces: np.ndarray) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Chart number and side (2 * axis + positive) of each face."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    order = np.argsort(edges[:, 0] * len(vertices) + edges[:, 1], kind="stable")
    same = (edges[order[1:]] == edges[order[:-1]]).all(1)
    first, second = order[1:][same] // 3, order[:-1][same] // 3
    ones, shape = np.ones(len(first)), (len(faces), len(faces))
    neighbours = sparse.coo_matrix((ones, (first, second)), shape=shape).tocsr()
    neighbours = neighbours + neighbours.T
    normals = face_normals(vertices, faces)
    for _ in range(CHART_SMOOTHING):
        normals = normals + 0.5 * (neighbours @ normals)
    axis = np.abs(normals).argmax(1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    joined = side[first] == side[second]
    graph = sparse.coo_matrix((ones[joined], (first[joined], second[joined])), shape=shape)
    _, chart = csgraph.connected_components(graph, directed=False)
    return chart, side


def _shelves(size: Int[np.ndarray, "k 2"]) -> tuple[Int[np.ndarray, "k 2"], tuple[int, int]]:
    """Packs rectangles (width, height), tallest first, in rows; returns corners and the sheet's (height, width)."""
    width = int(max(size[:, 0].max(), np.sqrt(1.1 * size.prod(1).sum())))
    corner = np.zeros_like(size)
    x = y = shelf = 0
    for k in np.argsort(-size[:, 1], kind="stable"):
        w, h = size[k]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        corner[k] = x, y
        x, shelf = x + w, max(shelf, h)
    return corner, (int(y + shelf), width)


def _rasterise(
    vertices: np.ndarray, faces: np.ndarray, texel: Float[np.ndarray, "m 3 2"], shape: tuple[int, int]
) -> Float[np.ndarray, "h w 3"]:
    """The surface point of every texel: on the plane of the face that was sampled nearest to it."""
    owner = np.full(shape, -1)
    steps = int(np.clip(np.ceil(np.median(np.ptp(texel, axis=1).max(1))), 2, 8))
    weights = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    weights = 0.98 * weights + 0.02 / 3
    at = np.rint(np.einsum("sk,mkc->smc", weights, texel)).astype(int)
    owner[at[..., 1], at[..., 0]] = np.arange(len(faces))
    nearest = ndimage.distance_transform_edt(owner < 0, return_distances=False, return_indices=True)
    assert nearest is not None
    owner = owner[tuple(nearest)]
    a, b, c = np.moveaxis(texel, 1, 0)
    area = _cross2(b - a, c - a)
    area = np.where(np.abs(area) < 1e-6, 1e-6, area)
    row, column = np.indices(shape)
    offset = np.stack([column, row], -1) - a[owner]
    beta = np.clip(_cross2(offset, (c - a)[owner]) / area[owner], -3, 4)[..., None]
    gamma = np.clip(_cross2((b - a)[owner], offset) / area[owner], -3, 4)[..., None]
    p, q, r = np.moveaxis(vertices[faces], 1, 0)
    return (p[owner] + beta * (q - p)[owner] + gamma * (r - p)[owner]).astype(np.float32)


def _cross2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def face_normals(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Normals of length twice the face's area."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


def corner_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], crease_deg: float
) -> Float[np.ndarray, "m 3 3"]:
    """Unit normal of each corner: area-weighted mean over the faces at its vertex within `crease_deg` of its own."""
    area = face_normals(vertices, faces)
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-30)
    order = np.argsort(faces.reshape(-1), kind="stable")  # corners grouped by vertex
    owner = faces.reshape(-1)[order]
    counts = np.bincount(owner, minlength=len(vertices))
    start = np.cumsum(counts) - counts
    size = counts[owner]
    first = np.repeat(np.arange(len(order)), size)  # all ordered pairs of corners that share a vertex
    second = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size) + np.repeat(start[owner], size)
    i, j = order[first] // 3, order[second] // 3
    near = np.einsum("ij,ij->i", unit[i], unit[j]) > np.cos(np.radians(crease_deg))
    near |= i == j
    total = np.stack([np.bincount(first[near], area[j[near], k], minlength=len(order)) for k in range(3)], -1)
    normals = np.empty_like(total)
    normals[order] = total
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = np.repeat(unit, 3, axis=0)
    normals = np.where(length > 1e-20, normals / np.maximum(length, 1e-30), flat)
    normals = np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0.5, normals, [0.0, 0.0, 1.0])
    return normals.reshape(-1, 3, 3)


def split_corners(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3 3"],
    corner_uv: Float[np.ndarray, "m 3 2"] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """One vertex per distinct (point, normal, uv): returns vertices, faces, normals, uv."""
    key = [faces.reshape(-1, 1), np.rint(normals.reshape(-1, 3) * 2048).astype(np.int64)]
    if corner_uv is not None:
        key.append(np.rint(corner_uv.reshape(-1, 2) * 65536).astype(np.int64))
    packed = np.concatenate(key, axis=1)
    mixed = np.zeros(len(packed), np.uint64)
    for column in packed.T:  # a 64-bit hash: sorting one integer is ten times faster than sorting rows
        mixed = (mixed ^ column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    _, first, inverse = np.unique(mixed, return_index=True, return_inverse=True)
    return (
        vertices[faces.reshape(-1)[first]].astype(np.float32),
        inverse.reshape(-1, 3).astype(np.int32),
        normals.reshape(-1, 3)[first].astype(np.float32),
        None if corner_uv is None else corner_uv.reshape(-1, 2)[first].astype(np.float32),
    )


@dataclass(frozen=True)
class AtlasPlace:
    """Where a texture lies in an atlas: uv of the atlas = uv of the texture * scale + offset."""

    scale: Float[np.ndarray, "2"]
    offset: Float[np.ndarray, "2"]

    def move(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Texture coordinates in the atlas."""
        return uv * self.scale + self.offset


def pack_textures(
    textures: Sequence[Float[np.ndarray, "_ _ c"]],
) -> tuple[Float[np.ndarray, "h w c"], list[AtlasPlace]]:
    """Puts textures side by side, repeating the last row below the lower ones."""
    height = max(len(texture) for texture in textures)
    width = sum(texture.shape[1] for texture in textures)
    columns, places, left = [], [], 0
    for texture in textures:
        h, w, _ = texture.shape
        columns.append(np.concatenate([texture, np.repeat(texture[-1:], height - h, axis=0)]))
        places.append(AtlasPlace(np.array([w / width, h / height]), np.array([left / width, 0.0])))
        left += w
    return np.concatenate(columns, axis=1), places
