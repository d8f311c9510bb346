"""Shape from what pictures show inside the outlines: with light and materials given, shading tells the normals.

Each step renders the pictures (all bounces), takes the derivative of the shading by the normals (`shading`, direct
light), carries it on to the vertices (`normal_matrix`) and solves for a movement (`fit`), with the masks beside it.
Pixels that the object does not fill, saturated ones and outliers (shadows' edges, wrong materials) count less or not.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array

from unirender.color import display_slope, image_srgb
from unirender.pictures import DISPLAY_WHITE
from unirender_reference.optimize.refine.scene import TexturedScene, maps_of
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.charts import welded
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.shape.fit import ImageTerm, MeshFit
from unirender_reference.optimize.shape.normal_matrix import normal_matrix
from unirender_reference.optimize.shape.shading import shade_points
from unirender_reference.optimize.shape.topology import vertex_normals
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Step, Views
from unirender_reference.shapes.mesh_object import RECONSTRUCTION

FILLED = 0.99  # coverage from which a pixel shows nothing but the object
STIFFER = 5.0  # the last step than the first: large movements first, then less of the samples' noise
OUTLIER = 0.1  # display values: errors of this size count half (Geman-McClure weights)


def refine_shape(
    views: Views, solution: Solution, config: ShapeConfig, on_step: Callable[[Step], bool] | None = None
) -> Solution:
    """The solution with its vertices moved towards the pictures; textures, charts and light stay.

    Args:
        views: posed pictures with masks.
        solution: mesh, textures and light to start from.
        config: steps and weights.
        on_step: told about every step (rmse of masks, and of pictures in display values); False ends the fit.
    """
    began = time.perf_counter()
    cameras = Cameras(views.seen)
    cameras.require_outside()
    masks = np.stack([view.mask[..., 0] for view in views.seen]).astype(np.float64)
    targets = np.stack([image_srgb(view.image) if views.hdr else view.image for view in views.seen]).reshape(-1, 3)
    known = ~(np.stack([views.saturated(view) for view in views.seen]).reshape(-1, 3) | (targets >= DISPLAY_WHITE))
    points, faces, index = welded(solution.obj.vertices, solution.obj.faces)
    fit = MeshFit(points, faces, masks, cameras)
    for count in range(config.image_steps):
        now = moved(solution, fit.vertices, faces, index)
        coverage = fit.coverage()
        inner = np.flatnonzero((masks.ravel() > FILLED) & (coverage.ravel() > FILLED))
        seed = config.seed * 1009 + count
        image = TexturedScene(now, views.seen, config.depth).image(maps_of(now), config.spp, seed)[..., :3]
        term, image_error = image_term(now, cameras, inner, image.reshape(-1, 3), targets, known, fit, config, seed)
        stiffness = config.stiffness * STIFFER ** (count / max(config.image_steps - 1, 1))
        mask_error = fit.step(config.image_smoothness, stiffness, term, coverage)
        values = {"mask_rmse": mask_error, "image_rmse": image_error, "loss": mask_error**2 + image_error**2}
        if on_step is not None and not on_step(Step("reshape", count + 1, time.perf_counter() - began, values)):
            break
    return moved(solution, fit.vertices, faces, index)


def moved(
    solution: Solution,
    points: Float[np.ndarray, "k 3"],
    faces: Int[np.ndarray, "m 3"],
    index: Int[np.ndarray, " n"],
) -> Solution:
    """The solution with the places of its vertices, `points[index]`, and smooth normals.

    Args:
        solution: whose charts and textures stay.
        points: one for each place.
        faces: of the places.
        index: the place of each vertex of the solution.
    """
    normals = vertex_normals(points, faces)[index].astype(np.float32)
    vertices = points[index].astype(np.float32)
    obj = dataclasses.replace(solution.obj, family=RECONSTRUCTION, vertices=vertices, normals=normals)
    return dataclasses.replace(solution, obj=obj)


def image_term(
    solution: Solution,
    cameras: Cameras,
    inner: Int[np.ndarray, " p"],
    image_linear: Float[np.ndarray, "q 3"],
    target_srgb: Float[np.ndarray, "q 3"],
    known: Bool[np.ndarray, "q 3"],
    fit: MeshFit,
    config: ShapeConfig,
    seed: int,
) -> tuple[ImageTerm, float]:
    """The pictures' part of a step, and the root mean square error of the display values.

    Args:
        solution: what `image_linear` shows.
        cameras: of all views.
        inner: flat indices of the pixels that count.
        image_linear: all pixels, as rendered.
        target_srgb: all pixels, as they should be.
        known: where that is more than a lower bound of the light; elsewhere it counts for nothing.
        fit: whose vertices move.
        config: samples and weights.
        seed: of the shading's samples.
    """
    shaded = shade_points(solution, cameras, inner, 2 * config.spp, seed)
    linear, target = image_linear[shaded.pixel], target_srgb[shaded.pixel]
    error = (image_srgb(linear) - target).astype(np.float64)
    weight = np.sqrt(config.image_weight) / (1 + (error / OUTLIER) ** 2)
    slope = display_slope(linear) * known[shaded.pixel]
    rows = (weight * slope)[:, None, :, None] * shaded.share[:, :, None, None] * shaded.derivative[:, None]
    row = np.arange(len(error))[:, None, None, None] * 3 + np.arange(3)[:, None]
    column = fit.faces[shaded.face][:, :, None, None] * 3 + np.arange(3)
    place = [np.broadcast_to(indices, rows.shape).ravel() for indices in (row, column)]
    by_normals = coo_array((rows.ravel(), place), shape=(error.size, fit.vertices.size)).tocsr()
    counts = weight * known[shaded.pixel]
    matrix = by_normals @ normal_matrix(fit.vertices, fit.faces)
    return ImageTerm((counts * error).ravel(), matrix), float(np.sqrt((error**2).mean()))
