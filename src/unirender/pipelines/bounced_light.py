"""What a hidden direction shows instead of the light: the object that hides it.

    d += c (1 - V_d) B,    s += c (1 - V_s) B

Notation: V_d, V_s what shadows leave of d and s under a white sky (`unirender.pipelines.shadowed_light`), so that
1 - V is the share of their lobe that sees the object; B what the object sends out about there, the mean of its
closed-form image around the pixel. c is less than 1: what is hidden sees the object's insides, which are darker than
what the picture shows, and B has been lit once only. B is taken to be alike in all directions, also where it is gloss,
and knows nothing of depth: what is beside a pixel in the picture counts as beside it.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.framing import Frame
from unirender.pipelines.shadowed_light import SHADOW_SIDE

REFLECTED = 0.4  # c: chosen by pictures of no suite, where 0.3 and 0.5 are as good
AROUND = 0.11  # of the object's size, the root of its area: standard deviation of the mean around a pixel

WHITE_SKY = np.ones((2, 4, 3), np.float32)


def bounced_light(
    intrinsics: Intrinsics, shares: Mapping[str, Float[np.ndarray, "h w 3"]]
) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """What is added to s and d that have shadows.

    Args:
        intrinsics: with all that the split-sum image needs; s and d direct light, derived ones with the shadows that
            the picture shows.
        shares: V_s and V_d by name, those that are wanted: `visible_shares` under `WHITE_SKY`.
    """
    radiance = _mean_radiance(intrinsics.replace(environment=None))
    return {name: REFLECTED * (1 - share) * radiance for name, share in shares.items()}


def _mean_radiance(intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    """B, found at the size at which shadows are."""
    mask = intrinsics.require("mask")["mask"]
    if max(intrinsics.height, intrinsics.width) > SHADOW_SIDE:
        frame = Frame.reduced(mask, SHADOW_SIDE)
        return frame.leave_map(_mean_radiance(frame.enter_intrinsics(intrinsics)), mask)
    image = split_sum_image(intrinsics)
    sigma = AROUND * np.sqrt(np.maximum(mask, 0).sum())
    around = gaussian_filter(np.concatenate([image, mask], axis=-1), (sigma, sigma, 0), mode="constant")
    covered = around[..., 3:]
    return np.divide(around[..., :3], covered, out=np.zeros_like(image), where=(covered > 0) & (mask > 0))
