"""Hollows that no outline shows: space carving of the visual hull by colours (Kutulakos and Seitz 2000).

The inside of a cup is never part of an outline, so the hull closes it with a lid. What cameras see on the lid is the
cup's wall, from each another part of it: their colours cannot agree. A grid point on the surface at which the colours
of the cameras that see it cannot agree is not on the surface, and is taken away, until every point is consistent.

A camera says an interval for each channel: of the four pixels around the point, which allows for half a pixel of
misplacement. Intervals agree if one value lies in all of them, to within a tolerance. Surfaces whose colour depends
on the direction, mirrors above all, disagree with themselves and are carved away; so a carved shape is only a
proposal. It has to fill the masks as well as the hull does, and then to explain the pictures better (`multiview.run`).
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from unirender.color import image_srgb
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.shape.coverage import coverage_of, masks_of
from unirender_reference.optimize.shape.hull import HALF, visual_hull
from unirender_reference.optimize.shape.reconstruct import charted_object, fit_masks
from unirender_reference.optimize.views import Views
from unirender_reference.shapes import MeshObject

TOLERANCES = (0.06, 0.12, 0.25)  # display values: the first whose shape fills the masks is proposed
MOST_LEFT, LEAST_LEFT = 0.99, 0.5  # of the hull's volume
LOOSER = 1.1  # the proposal's error of masks than the hull's
FILLED = 0.99  # coverage from which a pixel shows nothing but the object
LEAST_COSINE = 0.2  # of the angle between normal and camera: more grazing ones are not asked
LEAST_CAMERAS = 3  # that have to see a point before it can be taken away
SWEEPS = 60
START, STRIDE = 2.0, 0.8  # of a line of sight, in grid steps
SMOOTH = 1.5  # grid steps: of the occupancy whose gradient is the normal
ROUNDED = 1.0  # grid steps: of the distance to what was taken away


def carved_object(views: Views, closed: MeshObject, config: ShapeConfig) -> MeshObject | None:
    """The visual hull with its hollows, grey, with charts; None where colours tell of none or cannot be relied on.

    Args:
        views: posed pictures with masks.
        closed: what was reconstructed from the masks alone; a proposal fills them about as well.
        config: grid and steps.
    """
    cameras, masks = Cameras(views.seen), masks_of(views.seen)
    images = np.stack([image_srgb(view.image) if views.hdr else view.image for view in views.seen])
    hull = visual_hull(masks, cameras, config.cells)
    most = LOOSER * _mask_error(coverage_of(views.seen, closed), masks)
    for tolerance in TOLERANCES:
        field, left = carve(hull, images, masks, cameras, tolerance)
        if LEAST_LEFT < left < MOST_LEFT:
            fit = fit_masks(field, masks, cameras, config)
            hollow = charted_object(fit.vertices, fit.faces)
            if _mask_error(coverage_of(views.seen, hollow), masks) <= most:
                return hollow
    return None


def _mask_error(coverage: Float[np.ndarray, "k h w"], masks: Float[np.ndarray, "k h w"]) -> float:
    return float(np.sqrt(np.square(coverage - masks).mean()))


def carve(
    field: Float[np.ndarray, "side side side"],
    images: Float[np.ndarray, "k h w 3"],
    masks: Float[np.ndarray, "k h w"],
    cameras: Cameras,
    tolerance: float,
) -> tuple[Float[np.ndarray, "side side side"], float]:
    """The hull's field without the points at which colours disagree, and the share of the volume that is left.

    Args:
        field: positive inside, on a grid over [-HALF, HALF]^3 (`hull.visual_hull`).
        images: display values.
        masks: coverage.
        cameras: of the same views.
        tolerance: display values by which colours may disagree.
    """
    inside, steps = field > 0, 2 * HALF / (field.shape[0] - 1)
    before = max(np.count_nonzero(inside), 1)
    low, high = _intervals(images, masks)
    for _ in range(SWEEPS):
        surface = np.argwhere(inside & ~np.asarray(ndimage.binary_erosion(inside), bool))
        wrong = _disagreement(surface, inside, low, high, cameras) > tolerance
        inside[tuple(surface[wrong].T)] = False
        if not wrong.any() or np.count_nonzero(inside) < LEAST_LEFT * before:
            break
    left = np.count_nonzero(inside) / before
    removed = (field > 0) & ~inside
    if not removed.any():
        return field, left
    away, within = (np.asarray(ndimage.distance_transform_edt(side)) for side in (~removed, removed))
    distance = away - within
    distance = np.asarray(ndimage.gaussian_filter(distance - 0.5 * np.sign(distance), ROUNDED)) * steps
    return np.minimum(field, distance), left


def _intervals(
    images: Float[np.ndarray, "k h w 3"], masks: Float[np.ndarray, "k h w"]
) -> tuple[Float[np.ndarray, "k y x 3"], Float[np.ndarray, "k y x 3"]]:
    """Least and greatest of four neighbouring pixels; element (i, j) is of (i-1, j-1) to (i, j).

    Where one of the four shows anything else than the object, the interval is everything.
    """
    filled = masks > FILLED
    bounds = []
    for pick, beyond in ((np.minimum, -np.inf), (np.maximum, np.inf)):
        values = np.pad(
            np.where(filled[..., None], images, beyond), [(0, 0), (1, 1), (1, 1), (0, 0)], constant_values=beyond
        )
        down = pick(values[:, 1:], values[:, :-1])
        bounds.append(pick(down[:, :, 1:], down[:, :, :-1]))
    return bounds[0], bounds[1]


def _disagreement(
    surface: Int[np.ndarray, "n 3"],
    inside: Bool[np.ndarray, "side side side"],
    low: Float[np.ndarray, "k y x 3"],
    high: Float[np.ndarray, "k y x 3"],
    cameras: Cameras,
) -> Float[np.ndarray, " n"]:
    """How far the colours of grid points are from agreeing, in display values; 0 where too few cameras see them."""
    steps = 2 * HALF / (inside.shape[0] - 1)
    points = surface * steps - HALF
    smooth = np.asarray(ndimage.gaussian_filter(inside.astype(np.float32), SMOOTH))
    outward = -np.stack(list(np.gradient(smooth)), axis=-1)
    normal = outward[tuple(surface.T)]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    least = np.full((len(cameras), len(points), 3), -np.inf)
    greatest, seen = -least, np.zeros(len(points), int)
    for view in range(len(cameras)):
        towards = cameras.center[view] - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        asked = np.flatnonzero(np.einsum("ni,ni->n", towards, normal) > LEAST_COSINE)
        asked = asked[_free(points[asked], towards[asked], inside)]
        x, y = np.rint(cameras.project(points[asked], view)).astype(int).T
        within = (x >= 0) & (x <= cameras.width) & (y >= 0) & (y <= cameras.height)
        asked, x, y = asked[within], x[within], y[within]
        known = np.isfinite(low[view, y, x, 0])
        asked, x, y = asked[known], x[known], y[known]
        least[view, asked], greatest[view, asked] = low[view, y, x], high[view, y, x]
        seen[asked] += 1
    gap = least.max(axis=0) - greatest.min(axis=0)
    return np.where(seen >= LEAST_CAMERAS, gap.max(axis=1), 0)


def _free(
    points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"], inside: Bool[np.ndarray, "side side side"]
) -> Bool[np.ndarray, " n"]:
    """Whether lines of sight meet no other part of the shape."""
    side = inside.shape[0]
    steps = 2 * HALF / (side - 1)
    free, index = np.ones(len(points), bool), np.arange(len(points))
    place, step = (points + HALF) / steps + START * direction, STRIDE * direction
    while len(index):
        cell = np.rint(place).astype(int)
        within = ((cell >= 0) & (cell < side)).all(axis=1)
        index, place, step, cell = index[within], place[within], step[within], cell[within]
        met = inside[tuple(cell.T)]
        free[index[met]] = False
        index, place, step = index[~met], place[~met] + step[~met], step[~met]
    return free
