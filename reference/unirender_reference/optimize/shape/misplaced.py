"""Why a mesh is not where the masks are: what can be told from the two, as a hint for whoever gave them.

Tried in turn: poses of another convention, cameras that look away, another axis that is up, meshes turned by quarters,
principal points far from the middle, and another size or place than the masks show.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from unirender_reference.optimize.files.transforms import Y_UP, Up
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.coverage import masks_of
from unirender_reference.optimize.shape.tracer import MeshTracer
from unirender_reference.optimize.views import View
from unirender_reference.shapes import MeshObject, Sphere

MOST_VIEWS, MOST_PIXELS = 8, 64  # looked at, and along a side of each
AS_GOOD = 0.02  # of the IoU: --up is named rather than a turn that is better by less
OFF_CENTER = 0.15  # of the frame
USUAL_REACH = 1.1  # radius of a sphere of masks, where the object's is 1: 1.02 to 1.22 were measured
OTHER_SIZE, OTHER_PLACE = 1.35, 0.3  # a factor; radii of the larger of both
OPENCV = (
    "are the poses in OpenCV's axes (+z forward)? negate columns 2 and 3 of each transform_matrix; or world to camera? "
    "invert them"
)
FORWARD = np.diag([1.0, -1.0, -1.0, 1.0])  # from a camera with +z forward and +y down
CONVENTIONS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "in OpenCV's axes (+z forward)? then negate columns 2 and 3 of each transform_matrix": lambda pose: pose @ FORWARD,
    "world to camera? then invert each transform_matrix": np.linalg.inv,
    "world to camera in OpenCV's axes, as COLMAP's images.txt has them? then invert each transform_matrix and negate "
    "columns 2 and 3 of what comes out": lambda pose: np.linalg.inv(pose) @ FORWARD,
}
BELONG = "do its units and axes, and the masks, belong to the poses?"


def likely_cause(
    views: Sequence[View], obj: MeshObject, least: float, place: Sphere, up: Up, shown: Sphere | None
) -> str:
    """What is probably wrong, and what to do.

    Args:
        views: in the unit sphere of the mesh.
        obj: the mesh.
        least: IoU that is demanded.
        place: where the mesh stands among the poses as they were given.
        up: which way is up in the poses, as it was given.
        shown: the sphere that the masks show, in the same world as the views; None: not known.
    """
    if convention := _other_convention(views, obj, least, place, up):
        return convention
    away = sum(float(view.pose[:3, 2] @ view.pose[:3, 3]) <= 0 for view in views)  # the object is at the origin
    if 2 * away > len(views):
        return f"{away} of {len(views)} cameras look away from it: {OPENCV}"
    return (
        _other_axes(views, obj, least, place, up)
        or _off_center(views)
        or _elsewhere(shown, place)
        or f"{BELONG} is it another mesh, or a field of view that is not that of the pictures?"
    )


def _other_convention(views: Sequence[View], obj: MeshObject, least: float, place: Sphere, up: Up) -> str | None:
    """A convention of poses under which the mesh is where the masks are."""
    few = _few(views)
    world = np.eye(4) if up == "y" else Y_UP
    for said, camera_to_world in CONVENTIONS.items():
        changed = []
        for view in few:
            pose = view.pose.astype(np.float64)
            pose[:3, 3] = place.center + place.radius * pose[:3, 3]
            pose = world @ camera_to_world(world.T @ pose)
            pose[:3, 3] = place.to_unit(pose[:3, 3])
            changed.append(dataclasses.replace(view, pose=pose.astype(np.float32)))
        iou = _Sampled(changed, obj).iou(np.eye(3), np.zeros(3))
        if iou >= least:
            return f"are the poses {said}: it would be {iou:.2f}"
    return None


def _few(views: Sequence[View]) -> Sequence[View]:
    return views[:: -(-len(views) // MOST_VIEWS)]


def _other_axes(views: Sequence[View], obj: MeshObject, least: float, place: Sphere, up: Up) -> str | None:
    """A turn of the mesh about the origin of the poses' world that puts it where the masks are."""
    sampled = _Sampled(_few(views), obj)
    toggled = Y_UP[:3, :3].T if up == "y" else Y_UP[:3, :3]
    origin = place.center / place.radius
    found = [(sampled.iou(turn, turn @ origin - origin), turn) for turn in _turns()]
    best = max(iou for iou, _ in found)
    iou, turn = max(found, key=lambda one: one[0] + AS_GOOD * np.array_equal(one[1], toggled))
    if best < least:
        return None
    if np.array_equal(turn, toggled):
        change = "with --up z (poses with +z up)" if up == "y" else "without --up z (poses with +y up)"
        return f"{change} it would be {iou:.2f}"
    signs = {1: "+", -1: "-"}
    axes = [signs[int(column[k])] + "xyz"[k] for column in turn.T for k in np.flatnonzero(column)]
    return (
        f"turned so that its +x, +y and +z point along {axes[0]}, {axes[1]} and {axes[2]} of the poses' world (+y up), "
        f"it would be {iou:.2f}: turn the mesh, or the poses the other way"
    )


class _Sampled:
    """The IoU at some pixels of some views, for a mesh that is put elsewhere."""

    def __init__(self, views: Sequence[View], obj: MeshObject) -> None:
        cameras = Cameras(views)
        step = -(-max(cameras.height, cameras.width) // MOST_PIXELS)
        rows, columns = np.arange(step // 2, cameras.height, step), np.arange(step // 2, cameras.width, step)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2) + 0.5
        at = np.repeat(np.arange(len(views)), len(pixels))
        self._origins = cameras.center[at]
        self._directions = cameras.rays(np.tile(pixels, (len(views), 1)), at)
        self._masks = masks_of(views)[:, step // 2 :: step, step // 2 :: step].ravel() > 0.5
        self._tracer = MeshTracer(obj.vertices, obj.faces)

    def iou(self, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> float:
        """With the mesh turned, then shifted; the rays move instead."""
        met = self._tracer.meets((self._origins - shift) @ turn, self._directions @ turn)
        return float((self._masks & met).sum() / max(int((self._masks | met).sum()), 1))


def _turns() -> list[Float[np.ndarray, "3 3"]]:
    """The 23 turns by quarters that are not none."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.diag(signs)[:, order]
            if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(3)):
                found.append(turn)
    return found


def _off_center(views: Sequence[View]) -> str | None:
    far = max((view.camera.principal for view in views), key=lambda at: max(abs(at[0] - 0.5), abs(at[1] - 0.5)))
    if max(abs(far[0] - 0.5), abs(far[1] - 0.5)) <= OFF_CENTER:
        return None
    return (
        f"the principal point lies at {far[0]:.2f} of the width and {far[1]:.2f} of the height: do cx, cy, w and h, "
        "and the focal length with them, belong to the pictures?"
    )


def _elsewhere(shown: Sphere | None, place: Sphere) -> str | None:
    """Another size or another place, from the sphere that the masks show."""
    if shown is None:
        return None
    size = shown.radius / USUAL_REACH
    center, radius = place.center + place.radius * shown.center, place.radius * size
    other_size = not 1 / OTHER_SIZE < size < OTHER_SIZE
    along = np.linalg.norm(center - size * place.center) < OTHER_PLACE * radius  # scaled about the world's origin
    other_place = np.linalg.norm(shown.center) > OTHER_PLACE * max(size, 1) and not (other_size and along)
    says = []
    if other_size:
        says.append(f"the object is about {size:.2g} times as large as the mesh")
    if other_place:
        says.append(f"it lies about {_point(center)}, the mesh about {_point(place.center)} in the poses' units")
    if not says:
        return None
    lens = ", or is the field of view (camera_angle_x, fl_x with w and h) wrong?" if other_size else ""
    return f"by the masks {' and '.join(says)}: {BELONG}{lens}"


def _point(at: Float[np.ndarray, "3"]) -> str:
    return "(" + ", ".join(f"{value + 0.0:.3g}" for value in at) + ")"
