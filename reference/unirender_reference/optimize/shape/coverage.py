"""How well a mesh's coverage of pictures agrees with their masks: intersection over union (IoU), and what to demand.

The IoU is the sum of the smaller over the sum of the larger of both coverages in all pixels of all pictures. Less than
`LEAST_IOU` is too little; that the masks may be wrong by half a pixel all along their outline lowers the demand, down
to `FLOOR_IOU`: it counts where pictures are small. Measured with 14 objects and 6 views of 16, 24, 64 and 160 pixels:
masks rounded to 0 and 1, wrong by half a pixel, or blurred reach the demand always; of 126 quarter and half turns of
the meshes about an axis 88, 120, 124 and 125 do not (the others, from 24 pixels on, are half turns of objects that are
nearly symmetric), and from 24 pixels on no mesh that is 1.3 or 0.75 times as large, or moved by 0.3 of its radius. Of
pictures of 8 pixels, 23 turns do not.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.tracer import MeshTracer
from unirender_reference.optimize.views import View
from unirender_reference.shapes import MeshObject

LEAST_IOU, FLOOR_IOU = 0.88, 0.5
OUTLINE_ERROR = 0.5  # pixels by which masks may be wrong along their outline
SIDES, MOST_RAYS = (4, 2), 3e7  # rays along the side of a pixel: the first number, unless it takes more rays


def coverage_of(views: Sequence[View], obj: MeshObject) -> Float[np.ndarray, "k h w"]:
    """The share of each pixel that the mesh covers, sampled on a grid."""
    cameras = Cameras(views)
    rays = len(cameras) * cameras.height * cameras.width * SIDES[0] ** 2
    return MeshTracer(obj.vertices, obj.faces).coverage(cameras, SIDES[0] if rays <= MOST_RAYS else SIDES[1])


def mask_iou(views: Sequence[View], coverage: Float[np.ndarray, "k h w"]) -> float:
    """Intersection over union of masks and coverage, over all pictures together."""
    masks = masks_of(views)
    return float(np.minimum(masks, coverage).sum() / max(float(np.maximum(masks, coverage).sum()), 1e-9))


def least_iou(views: Sequence[View]) -> float:
    """The IoU below which a mesh is not the one that the masks show.

    The length of an outline is what the masks change by from pixel to pixel along rows and columns, which is 4 / pi
    times the length of a round one, whether masks are soft or of 0 and 1.
    """
    masks = masks_of(views)
    change = sum(float(np.abs(np.diff(masks, axis=axis)).sum(dtype=np.float64)) for axis in (1, 2))
    outline = math.pi / 4 * change
    return max(FLOOR_IOU, LEAST_IOU - OUTLINE_ERROR * outline / max(float(masks.sum(dtype=np.float64)), 1e-9))


def covered_otherwise(views: Sequence[View], coverage: Float[np.ndarray, "k h w"]) -> list[tuple[str, float]]:
    """Name and IoU of the views in which a mesh is not what their mask shows; a mask of nothing says nothing."""
    each = [(view, mask_iou([view], own[None])) for view, own in zip(views, coverage, strict=True) if view.mask.any()]
    return [(view.name, iou) for view, iou in each if iou < least_iou([view])]


def masks_of(views: Sequence[View]) -> Float[np.ndarray, "k h w"]:
    """The coverage that the views show."""
    return np.stack([view.mask[..., 0] for view in views]).astype(np.float64)
