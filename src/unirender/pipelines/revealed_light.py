"""The light that a decomposition's s reveals, from which an edit takes the s of another roughness.

The predicted light is a mean over what may be: where a lamp may stand in several places, a part of it stands in each.
s says more, above all when the decomposition is closed and s has the highlights of the picture. It is linear in the
light, s = W L, so a few steps of the multiplicative rule of Richardson (1972) and Lucy (1974) from the predicted light,

    L <- L (W^T (s / W L) + p) / (W^T 1 + p)

bring W L nearer to s while no texel becomes negative. What no lobe sees well stays as predicted (p is what a texel
counts for as predicted), and the steps are few, since s also has shadows and what the normals are wrong about.

Notation: L the light's texels, W what the lobe of each pixel takes of each texel (`unirender.lobes.lobe_matrix`).
"""

import numpy as np
from jaxtyping import Float

from unirender.ggx import facing_normal
from unirender.intrinsics import Intrinsics
from unirender.lighting import resample_environment
from unirender.lobes import LOBE_WIDTH, lobe_matrix
from unirender.pipelines.framing import Frame

STEPS = 6
SIDE = 64  # pixels along the longer side at which s is compared: its light has 16 x 32 texels
MOST_SHAPE = (32, 64)  # rows and columns at which a finer light is looked at; it keeps its own detail
PRIOR = 0.3  # p, of what the texels' lobes sum to on average
FLOOR = 0.02  # radiance added to s and to W L, so that dark light does not decide


def revealed_light(intrinsics: Intrinsics) -> Float[np.ndarray, "eh ew 3"]:
    """The environment of a decomposition, changed so that the s which it gives without shadows is nearer to its s.

    Args:
        intrinsics: with normal, roughness, specular, environment and mask; the camera gives the view directions.
    """
    given = Intrinsics(
        **intrinsics.require("normal", "roughness", "specular", "mask", "environment"), camera=intrinsics.camera
    )
    if max(given.height, given.width) > SIDE:
        given = Frame(given.height, given.width, SIDE).enter_intrinsics(given)
    maps = given.require("normal", "roughness", "specular", "mask")
    environment = intrinsics.require("environment")["environment"]
    rows, columns = environment.shape[:2]
    shape = min(rows, MOST_SHAPE[0]), min(columns, MOST_SHAPE[1])
    there = (maps["mask"][..., 0] > 0.5) & np.any(maps["normal"] != 0, axis=-1)
    if not there.any():
        return environment
    view = given.camera.view_directions(given.height, given.width)[there].T
    normal = facing_normal(maps["normal"][there].T, view)
    texel = np.pi / (shape[0] - 1)
    alpha = np.maximum(
        np.square(maps["roughness"][there][:, 0]), np.float32(texel / LOBE_WIDTH)
    )  # at least a texel wide
    lobes = lobe_matrix(normal, view, alpha, shape)
    specular = maps["specular"][there]
    total = lobes.sum(axis=0)[:, None]
    prior = PRIOR * total.mean()
    light = resample_environment(environment, shape).reshape(-1, 3)
    gain = np.ones_like(light)
    for _ in range(STEPS):
        ratio = (specular + FLOOR) / (lobes @ (gain * light) + FLOOR)
        gain *= (lobes.T @ ratio + prior) / (total + prior)
    return (environment * resample_environment(gain.reshape(*shape, 3), (rows, columns))).astype(np.float32)
