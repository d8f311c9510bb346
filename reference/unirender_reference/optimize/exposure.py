"""The exposure at which linear pictures are fitted, so that their scale does not matter.

Misfits and figures are measured in display values, and the priors' widths were chosen on pictures of ordinary
brightness. Linear pictures may have any scale: they are divided by their exposure, one for all of a set, before the
fit, and what is radiance in the result is multiplied by it. Display values have an exposure of 1.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views

MIDDLE = 0.1  # log-average radiance of the object after division: that of pictures that the priors were chosen on
DARK_SHARE = 1e-3  # of the mean radiance, added before logarithms
RADIANCE_MAPS = ("environment", "specular", "diffuse")


def exposure_of(image_linear: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> float:
    """The log-average radiance over the mask, divided by `MIDDLE`; 1 for a black picture.

    Args:
        image_linear: premultiplied, of any scale.
        mask: coverage, [0, 1], not empty.

    Source: Reinhard et al., "Photographic Tone Reproduction for Digital Images", 2002, equation 1, with a dark floor
    that is proportional to the picture.
    """
    covered = mask[..., 0] > 0
    weight = mask[covered].astype(np.float64)
    grey = image_linear[covered].astype(np.float64).mean(axis=1, keepdims=True) / weight
    mean = float(np.average(grey, weights=weight))
    if mean == 0:
        return 1.0
    return math.exp(float(np.average(np.log(grey / mean + DARK_SHARE), weights=weight))) * mean / MIDDLE


def exposed(maps: Intrinsics, factor: float) -> Intrinsics:
    """The same under a light that is `factor` times as bright: environment, s and d, where they are known."""
    known = {name: getattr(maps, name) for name in RADIANCE_MAPS if getattr(maps, name) is not None}
    return maps.replace(**{name: values * np.float32(factor) for name, values in known.items()})


def exposure_of_views(views: Views) -> float:
    """That of the pictures that are fitted, all together, as of one picture (`exposure_of`)."""
    if not views.hdr:
        return 1.0
    return exposure_of(
        np.concatenate([views.linear(view) for view in views.seen]), np.concatenate([view.mask for view in views.seen])
    )


def divided_views(views: Views, exposure: float) -> Views:
    """Linear views, their radiance divided by the exposure; display values have none to divide by."""
    if not views.hdr:
        return views

    def divided(view: View) -> View:
        return dataclasses.replace(view, image=view.image / np.float32(exposure))

    return dataclasses.replace(
        views, seen=tuple(map(divided, views.seen)), held_out=tuple(map(divided, views.held_out))
    )


def lit(solution: Solution, factor: float) -> Solution:
    """The same object under a light that is `factor` times as bright; itself for a factor of 1."""
    if factor == 1:
        return solution
    return dataclasses.replace(solution, environment=solution.environment * np.float32(factor))
