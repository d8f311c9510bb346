"""Where the object stands among the cameras: from its mesh or its masks into the unit sphere of the contract."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject, Sphere

MARGIN = 1.05  # of a sphere that is known from masks alone
LEAST_INSIDE = 0.5  # share of a mesh's vertices that fall into the masks; of a mesh that fits, nearly all do
LEAST_OVERLAP = 0.4  # of the rectangles around mesh and mask; of a mesh that fits, nearly 1


def placed(views: Views, sphere: Sphere) -> Views:
    """The views with their world moved and scaled so that `sphere` becomes the unit sphere."""

    def moved(view: View) -> View:
        pose = view.pose.astype(np.float64)
        pose[:3, 3] = sphere.to_unit(pose[:3, 3])
        return dataclasses.replace(view, pose=pose.astype(np.float32))

    return dataclasses.replace(views, seen=tuple(map(moved, views.seen)), held_out=tuple(map(moved, views.held_out)))


def sphere_of_masks(views: Views) -> Sphere:
    """A sphere around an object that is known by its silhouettes: a few per cent larger than the object, as a rule.

    The centre is the point nearest to the rays through the centroids of the masks; the radius is the largest distance
    from it to a ray through a covered pixel, which is a lower bound for each view and close to the truth for many.

    Raises:
        UnirenderError: the cameras all look along one direction, so that the distance is unknown.
    """
    normal_sum, point_sum = np.zeros((3, 3)), np.zeros(3)
    rays = [_world_rays(view) for view in views.seen]
    for view, directions in zip(views.seen, rays, strict=True):
        weight = np.where(view.mask > 0.5, view.mask, 0)
        axis = (directions * weight).sum((0, 1))
        axis /= max(float(np.linalg.norm(axis)), 1e-12)
        across = np.eye(3) - np.outer(axis, axis)
        normal_sum += across
        point_sum += across @ view.pose[:3, 3]
    if np.linalg.cond(normal_sum) > 1e4:
        raise UnirenderError(
            "views: all cameras look at the object from one side, so that its size and place are unknown; add pictures "
            "from other sides, or pass --mesh"
        )
    center = np.linalg.solve(normal_sum, point_sum)
    reach = 0.0
    for view, directions in zip(views.seen, rays, strict=True):
        offset = center - view.pose[:3, 3]
        covered = directions[view.mask[..., 0] > 0.5]
        if len(covered):
            reach = max(reach, float(np.linalg.norm(np.cross(covered, offset), axis=1).max()))
    return Sphere(center, reach * MARGIN)


def check_alignment(views: Views, obj: MeshObject) -> None:
    """Looks whether a mesh lies where the masks are.

    Raises:
        UnirenderError: most of its vertices are seen beside the masks, or it is much smaller or larger than they are.
    """
    inside, overlap = np.mean([_agreement(view, obj) for view in views.seen], axis=0)
    if inside < LEAST_INSIDE or overlap < LEAST_OVERLAP:
        raise UnirenderError(
            f"mesh {obj.name}: {inside:.0%} of its vertices lie inside the masks of the pictures, and its frames "
            f"overlap those of the masks by {overlap:.0%}, expected nearly all; are its units and axes those of the "
            "poses? (--up z, if the poses have +z up and the mesh +y)"
        )


def _agreement(view: View, obj: MeshObject) -> tuple[float, float]:
    """Share of the vertices that are seen inside the mask, and intersection over union of the bounding rectangles.

    Where the mask is cut off by the frame, so is the mesh.
    """
    found, mask = project(view, obj.vertices), view.mask[..., 0] > 0
    shown = (found[:, 2] > 0) & np.isfinite(found).all(1)
    if not shown.any() or not mask.any():
        return 0.0, 0.0
    size = np.array([mask.shape[1], mask.shape[0]])
    rows, columns = np.nonzero(mask)
    mask_low = np.array([columns.min(), rows.min()])
    mask_high = np.array([columns.max() + 1, rows.max() + 1])
    least = np.where(mask_low == 0, 0, -np.inf)
    most = np.where(mask_high == size, size, np.inf)
    places = found[shown, :2]
    column, row = np.clip(places.astype(int), 0, size - 1).T
    in_frame = ((places >= 0) & (places < size)).all(1)
    cut = ((places < least) | (places > most)).any(1)
    inside = float((mask[row, column] & in_frame).sum() / max(int((~cut).sum()), 1))
    low = np.stack([np.clip(places.min(0), least, most), mask_low])
    high = np.stack([np.clip(places.max(0), least, most), mask_high])
    areas = np.prod(high - low, axis=1)
    both = float(np.prod(np.maximum(high.min(0) - low.max(0), 0)))
    return inside, both / max(float(areas.sum()) - both, 1e-9)


def project(view: View, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Where a view shows points of the world: column and row (pixel (i, j) covers [j, j+1] x [i, i+1]) and depth."""
    height, width = view.mask.shape[:2]
    pose = view.pose.astype(np.float64)
    local = (points.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
    depth = -local[:, 2]
    scale = height / (2 * math.tan(math.radians(view.camera.fov_deg) / 2)) / np.where(depth > 1e-9, depth, np.nan)
    x, y = view.camera.principal
    return np.stack([x * width + local[:, 0] * scale, y * height - local[:, 1] * scale, depth], axis=1)


def _world_rays(view: View) -> Float[np.ndarray, "h w 3"]:
    """Unit directions through the pixel centres in world axes."""
    return view.camera.rays(*view.mask.shape[:2]).astype(np.float64) @ view.pose[:3, :3].T
