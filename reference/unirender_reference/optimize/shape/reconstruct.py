"""A mesh from masks alone: visual hull, then Gauss-Newton steps towards the soft outlines, then charts."""

import logging
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from unirender_reference.optimize.shape.bounds import check_reach
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.charts import unwrap
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.shape.coverage import coverage_of, covered_otherwise, masks_of
from unirender_reference.optimize.shape.fit import MeshFit
from unirender_reference.optimize.shape.hull import extract, visual_hull
from unirender_reference.optimize.shape.placement import short_list
from unirender_reference.optimize.shape.topology import vertex_normals
from unirender_reference.optimize.views import Step, Views
from unirender_reference.shapes import MeshObject
from unirender_reference.shapes.mesh_object import RECONSTRUCTION

GREY = 0.5

_log = logging.getLogger("unirender.optimize")


def reconstruct(views: Views, config: ShapeConfig, on_step: Callable[[Step], bool] | None = None) -> MeshObject:
    """The mesh of an object that fits its masks, grey, with charts, in the world of the views.

    Masks that contradict each other are logged.

    Its bounding sphere has a radius of 1 as far as that of the object has in the views' world.

    Args:
        views: posed pictures with masks; colours are not looked at.
        config: grid and steps.
        on_step: told about every step; False ends the fit.

    Raises:
        UnirenderError: no point lies inside all masks, they do not bound the object, or a camera stands inside the
            unit sphere.
    """
    cameras, masks = Cameras(views.seen), masks_of(views.seen)
    fit = fit_masks(visual_hull(masks, cameras, config.cells), masks, cameras, config, on_step)
    check_reach(float(np.linalg.norm(fit.vertices, axis=1).max()), len(masks))
    found = charted_object(fit.vertices, fit.faces)
    if cut := covered_otherwise(views.seen, coverage_of(views.seen, found)):
        _log.warning(
            "the masks contradict each other: what lies inside all of them is not what %d of %d show (%s), IoU down to "
            "%.2f; the pose or the mask of a picture is wrong, perhaps of another one: leave pictures out in turn",
            len(cut),
            len(views.seen),
            short_list([name for name, _ in cut]),
            min(iou for _, iou in cut),
        )
    return found


def fit_masks(
    field: Float[np.ndarray, "side side side"],
    masks: Float[np.ndarray, "k h w"],
    cameras: Cameras,
    config: ShapeConfig,
    on_step: Callable[[Step], bool] | None = None,
) -> MeshFit:
    """The surface of a field, moved towards the masks.

    Args:
        field: positive inside, on a grid over [-HALF, HALF]^3 (`hull`).
        masks: coverage of each view.
        cameras: of the same views.
        config: the steps.
        on_step: told about every step; False ends the fit.
    """
    began = time.perf_counter()
    fit = MeshFit(*extract(field), masks, cameras)
    for index in range(config.mask_steps):
        last = index >= config.mask_steps - config.mask_steps // 3
        error = fit.step(config.final_smoothness if last else config.smoothness)
        step = Step("shape", index + 1, time.perf_counter() - began, {"mask_rmse": error, "loss": error**2})
        if on_step is not None and not on_step(step):
            break
    return fit


def charted_object(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> MeshObject:
    """A grey object of a mesh without seams: smooth normals, charts."""
    charts = unwrap(vertices, faces)
    return MeshObject(
        name="reconstruction",
        family=RECONSTRUCTION,
        vertices=vertices[charts.source].astype(np.float32),
        faces=charts.faces,
        normals=vertex_normals(vertices, faces)[charts.source].astype(np.float32),
        uv=charts.uv,
        albedo=np.full(3, GREY, np.float32),
        provenance={"source": "masks"},
    )
