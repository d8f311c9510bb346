"""The exposure at which a set of linear pictures is worked on, so that their scale does not matter.

Losses, their weights and the figures are made of display values: they would see another brightness where the same
pictures come in another unit. Linear pictures are divided by one exposure for all of them, and the light that is found
is multiplied by it. Display values have an exposure of 1.
"""

import dataclasses

import numpy as np

from unirender_reference.optimize.exposure import exposure_of
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views


def exposure_of_views(views: Views) -> float:
    """That of the pictures that are fitted, all together, as of one picture (`exposure.exposure_of`)."""
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
