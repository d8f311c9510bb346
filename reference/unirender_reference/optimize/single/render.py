"""What single-view optimisation found, rendered again: a picture to hold against the given one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.intrinsics import Intrinsics
from unirender_reference.optimize.exposure import exposure_of
from unirender_reference.optimize.refine.losses import psnr_db
from unirender_reference.optimize.show.strips import views_strip
from unirender_reference.optimize.single.picture import PictureInput
from unirender_reference.optimize.views import View, Views
from unirender_reference.shade import shade
from unirender_reference.shapes import MeshObject

SPP = 64  # of each half


@dataclass(frozen=True)
class Rerendered:
    """The picture of the maps under their light.

    Attributes:
        image_linear: premultiplied, in the given picture's unit.
        psnr_db: against the given picture: display values over covered pixels, without the samples' noise.
        strip: given above found, as a display shows them.
    """

    image_linear: Float[np.ndarray, "h w 3"]
    psnr_db: float
    strip: Image.Image


def rerendered(given: PictureInput, found: Intrinsics, geometry: MeshObject | None, name: str) -> Rerendered:
    """Shades what was found (`shade`: one bounce; shadows where the geometry is known), and compares.

    A linear picture is compared at the exposure at which it was fitted.

    Args:
        given: the picture.
        found: all maps and the light, at its size.
        geometry: the mesh in the picture, or None.
        name: of the picture, for the strip.
    """
    halves = [shade(found, spp=SPP, seed=seed, geometry=geometry) for seed in (0, 1)]
    exposure = np.float32(exposure_of(given.image * given.mask, given.mask) if given.hdr else 1.0)
    view = View(given.image / exposure, given.mask, given.camera, np.eye(4), name)
    views = Views((view,), (), given.hdr)
    shown = [np.concatenate([half / exposure, given.mask], axis=-1)[None] for half in halves]
    mean = (halves[0] + halves[1]) / 2
    return Rerendered(mean, psnr_db(views, views.seen, *shown), views_strip(views, (shown[0] + shown[1]) / 2))
