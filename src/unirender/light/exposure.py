"""The gauge: the rule that fixes the scale of the light when a scene is made.

A picture alone cannot tell a bright light with a short exposure from a dim light with a long one. The exposure is
therefore folded into the light: environment, s, d and image are all multiplied by

    factor = target / percentile_90(Y(d) over the mask),    target uniform in TARGET_RANGE

where Y(d) is the luminance of the white-diffuse buffer. The rule sees the light and the shape, never the material, so
that all edits of a scene share one factor; and twice the light gives half the factor, the same sample.
"""

import numpy as np
from jaxtyping import Float

from unirender.color import luminance
from unirender.errors import UnirenderError

PERCENTILE = 90.0
TARGET_RANGE = (0.5, 1.0)  # radiance of a white surface at the percentile; 1 is display white
MASK_THRESHOLD = 0.5  # pixels with more coverage than this count


def draw_target(rng: np.random.Generator) -> float:
    """A brightness for a scene, uniform in `TARGET_RANGE`."""
    return float(rng.uniform(*TARGET_RANGE))


def exposure_factor(
    diffuse: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"] | Float[np.ndarray, "h w"], target: float
) -> float:
    """The factor that brings a scene's light to display units.

    Args:
        diffuse: d under the light at any scale, linear, not premultiplied.
        mask: coverage, [0, 1].
        target: radiance that a white surface has afterwards at the percentile, as drawn by `draw_target`.

    Raises:
        UnirenderError: the mask has another size or is empty, or no more of the object than above the percentile
            receives light, or more than is finite.
    """
    if mask.size != diffuse[..., 0].size:
        raise UnirenderError(f"exposure: got a mask of {mask.shape[:2]} pixels, expected {diffuse.shape[:2]}, d's size")
    inside = mask.reshape(diffuse.shape[:2]) > MASK_THRESHOLD
    if not inside.any():
        raise UnirenderError(
            f"exposure: no pixel has coverage above {MASK_THRESHOLD}, expected an object in view; check camera and mask"
        )
    received = luminance(diffuse[inside])
    level = float(np.percentile(received, PERCENTILE))
    if not np.isfinite(level):
        raise UnirenderError(f"exposure: the white-diffuse level is {level}, expected finite radiance; check the light")
    if level <= 0:
        raise UnirenderError(
            f"exposure: the white-diffuse level is {level}, expected light on more than {100 - PERCENTILE:g}% of the "
            f"object, got it on {100 * (received > 0).mean():.2g}%; turn the light, or choose the exposure yourself "
            "(relight: --exposure 0, in Python exposure='keep')"
        )
    return target / level
