"""Where the object stands among the cameras: from its mesh or its masks into the unit sphere of the contract.

A mesh lies where the masks are if its coverage of the pictures is theirs: intersection over union (IoU), the sum of the
smaller over the sum of the larger of both coverages in all pixels of all pictures. Less than `LEAST_IOU` is refused;
masks whose outline is wrong by half a pixel everywhere lower the demand, which counts where pictures are small.
Measured with 14 objects and 6 views of 24, 64 and 160 pixels: masks rounded to 0 and 1, wrong by half a pixel, or
blurred pass all; of 126 quarter and half turns of the meshes about an axis 121, 124 and 125 are refused. The others
are half turns of objects that are nearly symmetric.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.tracer import MeshTracer
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject, Sphere

MARGIN = 1.05  # of a sphere that is known from masks alone
LEAST_IOU = 0.88
OUTLINE_ERROR = 0.5  # pixels by which masks may be wrong along their outline
SIDES, MOST_RAYS = (4, 2), 3e7  # rays along the side of a pixel: the first number, unless it takes more rays
FULL = 0.9  # of a frame: a mesh that covers as much may have a mask that covers all
SHOWN = 3  # names in a message
EDGES = (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])
OPENCV = (
    "are the poses in OpenCV's axes (+z forward)? negate columns 2 and 3 of each transform_matrix; or world to camera? "
    "invert them"
)
OTHER_AXES = (
    "try --up z (poses with +z up, as Blender and NeRF's synthetic scenes have them, and a glTF mesh), or "
    "another mesh; do its units and axes, and the masks, belong to the poses?"
)


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
            "from other sides, or pass --mesh"
        )
    center = np.linalg.solve(normal_sum, point_sum)
    away = [view.name for (view, _), axis in zip(rays, axes, strict=True) if (center - view.pose[:3, 3]) @ axis <= 0]
    if away:
        raise UnirenderError(
            f"views: the object that the masks show lies behind {len(away)} of {len(rays)} cameras ({_names(away)}); "
            f"expected it before all of them: {OPENCV}"
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
            f"views: the frame cuts the object off in {len(cut)} of {len(views.seen)} pictures ({_names(cut)}); "
            "without --mesh, expected masks that do not touch the border: leave these pictures out, or pass --mesh"
        )


def _no_outline(names: Sequence[str]) -> UnirenderError:
    return UnirenderError(
        f"views: the mask covers the whole frame in {len(names)} pictures ({_names(names)}), expected the object's "
        "outline; is the alpha channel no mask (an opaque RGBA file)? name masks by mask_path"
    )


def _names(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def coverage_of(views: Sequence[View], obj: MeshObject) -> Float[np.ndarray, "k h w"]:
    """The share of each pixel that the mesh covers, sampled on a grid."""
    cameras = Cameras(views)
    rays = len(cameras) * cameras.height * cameras.width * SIDES[0] ** 2
    return MeshTracer(obj.vertices, obj.faces).coverage(cameras, SIDES[0] if rays <= MOST_RAYS else SIDES[1])


def mask_iou(views: Sequence[View], coverage: Float[np.ndarray, "k h w"]) -> float:
    """Intersection over union of masks and coverage, over all pictures together."""
    masks = np.stack([view.mask[..., 0] for view in views])
    return float(np.minimum(masks, coverage).sum() / max(float(np.maximum(masks, coverage).sum()), 1e-9))


def least_iou(coverage: Float[np.ndarray, "k h w"]) -> float:
    """The IoU below which masks are not those of a mesh with this coverage."""
    outline = float(((coverage > 0) & (coverage < 1)).sum())
    return max(0.0, LEAST_IOU - OUTLINE_ERROR * outline / max(float(coverage.sum()), 1e-9))


def check_alignment(views: Views, obj: MeshObject) -> None:
    """Looks whether a mesh lies where the masks are.

    Raises:
        UnirenderError: a mask covers a whole frame that the mesh does not, or masks and mesh overlap too little.
    """
    coverage = coverage_of(views.seen, obj)
    pairs = zip(views.seen, coverage, strict=True)
    full = [view.name for view, own in pairs if view.mask.min() > 0.5 and own.mean() < FULL]
    if full:
        raise _no_outline(full)
    iou, least = mask_iou(views.seen, coverage), least_iou(coverage)
    if iou >= least:
        return
    away = sum(float(view.pose[:3, 2] @ view.pose[:3, 3]) <= 0 for view in views.seen)  # the object is at the origin
    hint = (
        f"{away} of {len(views.seen)} cameras look away from it: {OPENCV}" if 2 * away > len(views.seen) else OTHER_AXES
    )
    raise UnirenderError(
        f"mesh {obj.name}: it covers other pixels than the masks of the pictures: IoU (intersection over union) "
        f"{iou:.2f}, expected at least {least:.2f}; {hint}"
    )


def check_in_picture(mask: Float[np.ndarray, "h w 1"], camera: Camera, obj: MeshObject) -> None:
    """Looks whether a mesh before the contract's camera lies where the mask of the one picture is.

    Raises:
        UnirenderError: mask and mesh overlap too little.
    """
    view = View(np.zeros((*mask.shape[:2], 3), np.float32), mask, camera, pose_towards(0, 0, camera))
    coverage = coverage_of([view], obj)
    iou, least = mask_iou([view], coverage), least_iou(coverage)
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
