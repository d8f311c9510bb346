"""The visual hull with soft masks, and meshes from grids.

A mask's coverage tells where the outline crosses a pixel. `mask_distance` turns it into a signed distance to the
outline in pixels (positive inside), exact to a fraction of a pixel for straight outlines; a grid point's value is the
least over all views, in world units at the point: an outer bound of the object, close to a distance at its surface.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.sparse import coo_array, csgraph

from unirender.errors import UnirenderError
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.topology import face_vectors, neighbours, vertex_normals

HALF = 1.05  # half side of the grid: the unit sphere and a margin that no mask reaches
FINER = 8  # places along the side of a pixel at which the coverage is read
RELAXATIONS = 5  # of the vertices of marching cubes
SMALLEST_PIECE = 0.02  # of the largest piece's surface; smaller ones are splinters of the hull
WIDE, WIDE_CELLS = 2.0, 32  # half side and cells of a grid that tells whether the masks bound the object at all


def mask_distance(mask: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Signed distance of the pixel centres to the outline in pixels, positive inside.

    The outline is sampled at sub-pixel places: where the coverage, linear between pixel centres, is 1/2.
    """
    fine = ndimage.zoom(np.pad(mask, 2, mode="edge"), FINER, order=1, grid_mode=True, mode="nearest")
    inside = np.asarray(fine) > 0.5
    if not inside.any():
        return np.full(mask.shape, -float(max(mask.shape)))
    within, beyond = (np.asarray(ndimage.distance_transform_edt(side)) for side in (inside, ~inside))
    signed = within - beyond
    signed = (signed - 0.5 * np.sign(signed)) / FINER
    height, width = mask.shape
    padded = signed.reshape(height + 4, FINER, width + 4, FINER).mean((1, 3))
    return padded[2:-2, 2:-2]


def visual_hull(masks: Float[np.ndarray, "k h w"], cameras: Cameras, cells: int) -> Float[np.ndarray, "side side side"]:
    """Least signed distance to the outlines, in world units, on a grid of `cells` along each side of [-HALF, HALF].

    Args:
        masks: coverage of each view.
        cameras: of the same views.
        cells: along each side; the grid has one point more.

    Raises:
        UnirenderError: no point lies inside all masks (masks and poses do not belong together), or a camera stands
            inside the unit sphere.
    """
    cameras.require_outside()
    axis = np.linspace(-HALF, HALF, cells + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    least = np.full(len(points), np.inf)
    for view, mask in enumerate(masks):
        pixels = cameras.project(points, view)
        at = pixels[:, ::-1].T - 0.5
        distance = ndimage.map_coordinates(mask_distance(mask), at, order=1, mode="nearest")
        beyond = np.maximum(np.maximum(-pixels, pixels - [cameras.width, cameras.height]).max(1), 0)
        pixel_size = np.linalg.norm(points - cameras.center[view], axis=1) / cameras.focal[view]
        value = np.where(beyond > 0, np.minimum(-beyond, distance), distance) * pixel_size
        value = np.where(cameras.depth(points, view) > 0, value, -HALF)  # a camera sees nothing behind it
        least = np.minimum(least, value)
    if not (least > 0).any():
        raise UnirenderError(
            f"visual hull: no point of the unit sphere lies inside all {len(masks)} masks; expected masks of one "
            "object at the origin: check that masks and poses belong together and that poses are camera to world, "
            "with +y up and +z towards the viewer"
        )
    return least.reshape((cells + 1,) * 3)


def hull_reach(masks: Float[np.ndarray, "k h w"], cameras: Cameras) -> float:
    """How far from the origin points lie inside all masks, as a coarse grid over [-WIDE, WIDE]^3 tells; 0: none do.

    Args:
        masks: coverage of each view.
        cameras: of the same views.
    """
    return float(np.linalg.norm(points_inside(masks, cameras, WIDE, WIDE_CELLS), axis=1).max(initial=0))


def points_inside(
    masks: Float[np.ndarray, "k h w"], cameras: Cameras, half: float, cells: int
) -> Float[np.ndarray, "n 3"]:
    """The points of a grid over [-half, half]^3 that lie inside all masks.

    Args:
        masks: coverage of each view.
        cameras: of the same views.
        half: half side of the grid.
        cells: along each side.
    """
    axis = np.linspace(-half, half, cells + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    for view, mask in enumerate(masks):
        points = points[cameras.depth(points, view) > 0]
        column, row = np.floor(cameras.project(points, view)).T
        inside = (column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height)
        points, column, row = points[inside], column[inside].astype(int), row[inside].astype(int)
        points = points[mask[row, column] > 0.5]
    return points


def extract(
    field: Float[np.ndarray, "side side side"],
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """The surface where a grid over [-HALF, HALF]^3 is 0, positive inside: even triangles, without splinters.

    Marching cubes leaves slivers; each relaxation moves the vertices towards the mean of their neighbours along the
    surface.
    """
    from skimage.measure import marching_cubes

    cells = field.shape[0] - 1
    closed = np.pad(field, 1, constant_values=min(float(field.min()), -1e-3))
    vertices, faces, _, _ = marching_cubes(closed, 0.0, gradient_direction="ascent")
    faces = _large_pieces(vertices, faces)
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used].astype(np.float64), faces.reshape(-1, 3)
    average = neighbours(len(vertices), faces)
    for _ in range(RELAXATIONS):
        step = average @ vertices - vertices
        normal = vertex_normals(vertices, faces)
        vertices = vertices + step - np.einsum("ni,ni->n", step, normal)[:, None] * normal
    return (vertices - 1) * (2 * HALF / cells) - HALF, faces.astype(np.int32)


def _large_pieces(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "k 3"]:
    """The faces of connected pieces with at least `SMALLEST_PIECE` of the largest one's surface."""
    i, j = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(len(vertices),) * 2)
    _, piece = csgraph.connected_components(graph, directed=False)
    area = np.bincount(piece[faces[:, 0]], np.linalg.norm(face_vectors(vertices, faces), axis=1))
    return faces[(area >= SMALLEST_PIECE * area.max())[piece[faces[:, 0]]]]
