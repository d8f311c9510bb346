"""The exposure at which a linear picture is fitted, so that its scale does not matter.

Misfits are measured in display values, and the priors' widths were chosen on pictures of ordinary brightness. A linear
picture may have any scale: it is divided by its exposure before the fit, and what is radiance in the result is
multiplied by it.
"""

import math

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics

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
