"""Whether masks bound an object in the unit sphere, before its shape is looked for.

Measured with 6 objects and cameras evenly around them, 48 pixels: what lies inside 2 masks (from opposite sides)
reaches 2 to 2.3 times as far as the object, inside 3 at most 1.2 (around a ball 1.4, inside 4 1.2). The IoU of what was
reconstructed in 12 other views is 0.84 from 3 pictures, 0.91 from 4, 0.95 from 6, 0.97 from 8 and 0.99 from 12 (means).
"""

import logging

import numpy as np

from unirender.errors import UnirenderError
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.coverage import masks_of
from unirender_reference.optimize.shape.hull import hull_reach, visual_hull
from unirender_reference.optimize.shape.placement import sphere_of_masks
from unirender_reference.optimize.shape.principal import shifted_principal
from unirender_reference.optimize.views import Views
from unirender_reference.shapes.mesh_object import RECONSTRUCTION_TOLERANCE

MOST_REACH = 1 + RECONSTRUCTION_TOLERANCE
FEW_VIEWS = 4
PLACE_TOLERANCE, SIZE_TOLERANCE = 0.3, 1.5  # radii, and a factor: of a world that is that of the unit sphere

_log = logging.getLogger("unirender.optimize")


def check_masks(views: Views, cells: int) -> None:
    """Looks whether masks can tell the shape; warns of few views, and of a principal point that they contradict.

    Args:
        views: with the object in the unit sphere of their world.
        cells: along a side of the grid that the hull will have.

    Raises:
        UnirenderError: the world is not that of the unit sphere, what lies inside all masks is not bounded to about it,
            or nothing does.
    """
    cameras, masks = Cameras(views.seen), masks_of(views.seen)
    reach = hull_reach(masks, cameras)
    if not 0 < reach <= MOST_REACH:
        _check_placed(views)
    check_reach(reach, len(masks))
    if not reach:
        visual_hull(masks, cameras, cells)  # finer: something thin may be there
    if len(masks) < FEW_VIEWS:
        _log.warning("%d pictures and no mesh: the shape will be rough, expected %d or more", len(masks), FEW_VIEWS)
    if shifted := shifted_principal(views.seen):
        _log.warning(
            "the masks agree better with cx moved by about %+.0f pixels: is the principal point right?", shifted
        )


def check_reach(reach: float, count: int) -> None:
    """Looks whether a shape ends near the unit sphere.

    Args:
        reach: how far from the origin it goes.
        count: of the masks that it was made from.

    Raises:
        UnirenderError: it goes further than a reconstruction may.
    """
    if reach > MOST_REACH:
        raise UnirenderError(
            f"shape: the {count} masks do not bound the object: what lies inside all of them reaches {reach:.2g} times "
            f"as far as they show it, expected at most {MOST_REACH:g}; add pictures from other sides, or pass the mesh "
            "(--mesh)"
        )


def _check_placed(views: Views) -> None:
    try:
        shown = sphere_of_masks(views)
    except UnirenderError:  # the masks do not tell
        return
    if np.linalg.norm(shown.center) > PLACE_TOLERANCE or not 1 / SIZE_TOLERANCE < shown.radius < SIZE_TOLERANCE:
        raise UnirenderError(
            f"views: the masks show an object about {np.round(shown.center, 3).tolist()} with a radius of "
            f"{shown.radius:.3g}, expected the unit sphere: move the views there with "
            "placed(views, sphere_of_masks(views)) of unirender_reference.optimize.shape.placement"
        )
