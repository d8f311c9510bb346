"""Where the object stands among the cameras: from its mesh or its masks into the unit sphere of the contract.

A mesh has to cover the pictures as their masks do (`coverage`); where it does not, `misplaced` looks for the cause.
"""

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.files.transforms import Up
from unirender_reference.optimize.shape.coverage import coverage_of, covered_otherwise, least_iou, mask_iou
from unirender_reference.optimize.shape.misplaced import OPENCV, likely_cause
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject, Sphere

MARGIN = 1.05  # of a sphere that is known from masks alone
FULL = 0.9  # of a frame: a mesh that covers as much may have a mask that covers all
SHOWN = 3  # names in a message
EDGES = (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])
UNIT_SPHERE = Sphere(np.zeros(3), 1.0)

_log = logging.getLogger("unirender.optimize")


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
    Views that show nothing of the object say nothing.

    Raises:
        UnirenderError: a mask covers its whole frame or is cut off by it, the cameras all look along one direction, so
            that the distance is unknown, or they look away from where the rays meet.
    """
    _check_whole(views)
    rays = [(view, _world_rays(view)[view.mask[..., 0] > 0.5]) for view in views.seen]
    rays = [(view, covered) for view, covered in rays if len(covered)]
    normal_sum, point_sum, axes = np.zeros((3, 3)), np.zeros(3), []
    for view, covered in rays:
        axis = covered.sum(0)
        axis /= np.linalg.norm(axis)
        across = np.eye(3) - np.outer(axis, axis)
        normal_sum += across
        point_sum += across @ view.pose[:3, 3]
        axes.append(axis)
    if not rays or np.linalg.cond(normal_sum) > 1e4:
        raise UnirenderError(
            "views: all cameras look at the object from one side, so that its size and place are unknown; add pictures "
            "from other sides, or pass the mesh (--mesh)"
        )
    center = np.linalg.solve(normal_sum, point_sum)
    away = [view.name for (view, _), axis in zip(rays, axes, strict=True) if (center - view.pose[:3, 3]) @ axis <= 0]
    if away:
        raise UnirenderError(
            f"views: the object that the masks show lies behind {len(away)} of {len(rays)} cameras "
            f"({short_list(away)}); expected it before all of them: {OPENCV}"
        )
    reach = max(
        float(np.linalg.norm(np.cross(covered, center - view.pose[:3, 3]), axis=1).max()) for view, covered in rays
    )
    return Sphere(center, reach * MARGIN)


def _check_whole(views: Views) -> None:
    """Masks without a mesh have to show all of the object: what lies outside a frame is cut off from it."""
    full = [view.name for view in views.seen if view.mask.min() > 0.5]
    if full:
        raise _no_outline(full)
    cut = [view.name for view in views.seen if any((view.mask[edge] > 0.5).any() for edge in EDGES)]
    if cut:
        raise UnirenderError(
            f"views: the frame cuts the object off in {len(cut)} of {len(views.seen)} pictures ({short_list(cut)}); "
            "without a mesh, expected masks that do not touch the border: leave these pictures out, or pass the mesh "
            "(--mesh)"
        )


def _no_outline(names: Sequence[str]) -> UnirenderError:
    return UnirenderError(
        f"views: the mask covers the whole frame in {len(names)} pictures ({short_list(names)}), expected the object's "
        "outline; is the alpha channel no mask (an opaque RGBA file)? name masks by mask_path"
    )


def short_list(names: Sequence[str]) -> str:
    """The first names, for a message."""
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def check_alignment(views: Views, obj: MeshObject, place: Sphere = UNIT_SPHERE, up: Up = "y") -> None:
    """Looks whether a mesh lies where the masks are; single views in which it does not are logged.

    Args:
        views: in the unit sphere of the mesh.
        obj: the mesh.
        place: where it stood among the poses as they were given; for the message, as the next.
        up: which way was up in these.

    Raises:
        UnirenderError: a mask covers a whole frame that the mesh does not, or masks and mesh overlap too little.
    """
    coverage = coverage_of(views.seen, obj)
    pairs = zip(views.seen, coverage, strict=True)
    full = [view.name for view, own in pairs if view.mask.min() > 0.5 and own.mean() < FULL]
    if full:
        raise _no_outline(full)
    iou, least = mask_iou(views.seen, coverage), least_iou(views.seen)
    if iou >= least:
        _warn_of_single(views.seen, coverage)
        return
    try:
        shown = sphere_of_masks(views)
    except UnirenderError:  # the masks do not tell
        shown = None
    hint = likely_cause(views.seen, obj, least, place, up, shown)
    raise UnirenderError(
        f"mesh {obj.name}: it covers other pixels than the masks of the pictures: IoU (intersection over union) "
        f"{iou:.2f}, expected at least {least:.2f}; {hint}"
    )


def _warn_of_single(views: Sequence[View], coverage: Float[np.ndarray, "k h w"]) -> None:
    """Logs the views whose own IoU is too small, which those of many others hide."""
    if wrong := covered_otherwise(views, coverage):
        _log.warning(
            "the mesh covers other pixels than the mask in %d of %d pictures (%s): IoU down to %.2f; are their poses "
            "or masks wrong? leave them out",
            len(wrong),
            len(views),
            short_list([name for name, _ in wrong]),
            min(iou for _, iou in wrong),
        )


def check_in_picture(mask: Float[np.ndarray, "h w 1"], camera: Camera, obj: MeshObject) -> None:
    """Looks whether a mesh before the contract's camera lies where the mask of the one picture is.

    Raises:
        UnirenderError: mask and mesh overlap too little.
    """
    view = View(np.zeros((*mask.shape[:2], 3), np.float32), mask, camera, pose_towards(0, 0, camera))
    coverage = coverage_of([view], obj)
    iou, least = mask_iou([view], coverage), least_iou([view])
    if iou < least:
        raise UnirenderError(
            f"--mesh {obj.name}: it covers other pixels than the picture's mask: IoU (intersection over union) "
            f"{iou:.2f}, expected at least {least:.2f}; does it face the camera, with its bounding sphere in the "
            "middle and as high as 0.9 of the frame, and do --fov and --mask (or the alpha channel) belong to "
            "the picture?"
        )


def _world_rays(view: View) -> Float[np.ndarray, "h w 3"]:
    """Unit directions through the pixel centres in world axes."""
    return view.camera.rays(*view.mask.shape[:2]).astype(np.float64) @ view.pose[:3, :3].T
