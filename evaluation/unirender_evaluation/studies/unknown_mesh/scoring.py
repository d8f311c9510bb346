"""Scores of an object that was found without its mesh, where its outline is not the true one.

Maps and pictures are compared as rendered buffers. Each side is divided by its own coverage, so that a pixel says what
the part of it that is covered looks like, and then

    masked        weighted by the true coverage: where the truth covers and the result does not, the result is what it
                  is there, nothing: black, roughness and metallic 0. What it covers beyond the truth has no weight
    whole frame   each side over the background by its own coverage: all of the outline's error counts

Shape is scored from the held-out cameras, and from steep ones that look from where no picture was taken.
"""

import dataclasses

from unirender_evaluation.metrics import HIGHER, LOWER, Metric, metric_key
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.scoring import Looks, score_solution
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.measure import score_shape
from unirender_reference.optimize.solution import Solution
from unirender_reference.shapes import MeshObject

SHAPE, STEEP = "shape", "shape_steep"
STEEP_DEG = 60.0  # elevation of the steep cameras, above and below the horizon in turn
STEEP_CAMERAS = 6
MASK_IOU = Metric(
    "mask_iou",
    "mask IoU",
    "",
    HIGHER,
    1.0,
    (),
    4,
    "sum of the lesser coverage over that of the greater, mean of cameras",
)
NORMAL_COSINE = Metric(
    "normal_cosine", "normal cos", "", HIGHER, 1.0, (), 4, "mean over the pixels that both cover, by the true coverage"
)
CHAMFER = Metric(
    "chamfer", "chamfer", "", LOWER, 0.0, (), 4, "mean distance between the surfaces, in radii of the bounding sphere"
)


def score_found(scene: MultiviewScene, solution: Solution, looks: Looks | None = None) -> dict[str, float]:
    """Metric key -> value of a result with a mesh of its own."""
    return score_solution(scene, solution, looks=looks, own_outline=True) | shape_values(scene, solution.obj)


def shape_values(scene: MultiviewScene, found: MeshObject) -> dict[str, float]:
    """Metric key -> value of a mesh: from the held-out cameras, and from steep ones."""
    step = 360.0 / STEEP_CAMERAS
    steep = [pose_towards(k * step, STEEP_DEG * (-1) ** k, scene.camera) for k in range(STEEP_CAMERAS)]
    values = {}
    for quantity, poses in ((SHAPE, scene.held_out_poses), (STEEP, steep)):
        cameras = Cameras([dataclasses.replace(scene.views.seen[0], pose=pose) for pose in poses])
        score = score_shape(found, scene.obj, cameras)
        values[metric_key(quantity, MASK_IOU)] = score.mask_iou
        values[metric_key(quantity, NORMAL_COSINE)] = score.normal_cosine
        values[metric_key(quantity, CHAMFER)] = score.chamfer  # of the whole surface, the same for both
    del values[metric_key(STEEP, CHAMFER)]
    return values
