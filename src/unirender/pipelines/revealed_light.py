"""The light that a decomposition's own s and d reveal.

The network predicts its light as a mean over what may be, in log radiance: where a lamp may stand in several places, a
part of it stands in each, and the whole is darker than the d beside it. s and d say more, above all when the
decomposition is closed and they have what the picture shows. Both are linear in the light, s = W L and d = C L, so a
few steps of the multiplicative rule of Richardson (1972) and Lucy (1974) from the predicted light,

    L <- L (W^T (s / W L) + c C^T (d / C L) + p) / (W^T 1 + c C^T 1 + p)

bring W L and C L nearer to s and d while no texel becomes negative. What no lobe sees well stays as predicted (p is
what a texel counts for as predicted), and the steps are few, since s and d also have shadows and what the normals are
wrong about.

`agreeing_light` looks at both: it is the light that a decomposition returns. `revealed_light` looks at s alone (c = 0):
an edit takes the s of another roughness from it, for which d says nothing (docs/training_record.md).

Notation: L the light's texels; W, C what the lobe and the cosine of each pixel take of each texel
(`unirender.light.lobes.lobe_matrix`, `cosine_matrix`); c how much d counts beside s.
"""

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender.light.ggx import facing_normal
from unirender.light.lobes import LOBE_WIDTH, cosine_matrix, lobe_matrix
from unirender.light.resampling import resample_environment
from unirender.pipelines.framing import Frame
from unirender.vectors import nonzero

STEPS, AGREEING_STEPS = 6, 12  # for s alone; for s and d
DIFFUSE_WEIGHT = 3.0  # c: a cosine tells directions apart less than a lobe does, and takes more steps
SIDE = 64  # pixels along the longer side at which s and d are compared: their light has 16 x 32 texels
MOST_SHAPE = (32, 64)  # rows and columns at which a finer light is looked at; it keeps its own detail
PRIOR = 0.3  # p, of what the texels' lobes sum to on average
FLOOR = 0.02  # radiance added to both sides of each ratio: light well below it does not decide, and stays as predicted


def revealed_light(intrinsics: Intrinsics) -> Float[np.ndarray, "eh ew 3"]:
    """The environment of a decomposition, changed so that the s which it gives without shadows is nearer to its s.

    Args:
        intrinsics: with normal, roughness, specular, environment and mask; the camera gives the view directions.
    """
    return _revealed(intrinsics, ("specular",), STEPS)


def agreeing_light(intrinsics: Intrinsics) -> Float[np.ndarray, "eh ew 3"]:
    """The same by s and d: also as bright as the decomposition says that the object is lit.

    Args:
        intrinsics: as for `revealed_light`, and diffuse.
    """
    return _revealed(intrinsics, ("specular", "diffuse"), AGREEING_STEPS)


def _revealed(intrinsics: Intrinsics, by: tuple[str, ...], steps: int) -> Float[np.ndarray, "eh ew 3"]:
    """The environment after so many steps `by` specular, or by it and diffuse; as it is where nothing is covered."""
    given = Intrinsics(
        **intrinsics.require("normal", "roughness", *by, "mask", "environment"), camera=intrinsics.camera
    )
    if max(given.height, given.width) > SIDE:
        given = Frame.reduced(given.require("mask")["mask"], SIDE).enter_intrinsics(given)
    given = given.with_unit_normals()
    environment = intrinsics.require("environment")["environment"]
    rows, columns = environment.shape[:2]
    shape = min(rows, MOST_SHAPE[0]), min(columns, MOST_SHAPE[1])
    seen = _seen(given, by, shape)
    if not seen:
        return environment
    total = np.sum([weight * takes.sum(axis=0) for takes, _, weight in seen], axis=0)[:, None]
    prior = PRIOR * total.mean()
    light = resample_environment(environment, shape).reshape(-1, 3)
    gain = np.ones_like(light)
    for _ in range(steps):
        wanted = prior
        for takes, shown, weight in seen:
            ratio = (shown + FLOOR) / (takes @ (gain * light) + FLOOR)
            wanted = wanted + weight * (takes.T @ ratio)
        gain *= wanted / (total + prior)
    return (environment * resample_environment(gain.reshape(*shape, 3), (rows, columns))).astype(np.float32)


def _seen(
    given: Intrinsics, by: tuple[str, ...], shape: tuple[int, int]
) -> list[tuple[Float[np.ndarray, "p m"], Float[np.ndarray, "p 3"], float]]:
    """Of each buffer what its pixels take of the texels (W, C), what they show (s, d), and what that counts (1, c)."""
    maps = given.require("normal", "roughness", *by, "mask")
    there = (maps["mask"][..., 0] > 0.5) & nonzero(maps["normal"])
    if not there.any():
        return []
    view = given.camera.view_directions(given.height, given.width)[there].T
    normal = facing_normal(maps["normal"][there].T, view)
    narrowest = np.pi / (shape[0] - 1) / LOBE_WIDTH  # alpha of a lobe as wide as a texel
    alpha = np.maximum(np.square(maps["roughness"][there][:, 0]), np.float32(narrowest))
    seen = [(lobe_matrix(normal, view, alpha, shape), maps["specular"][there], 1.0)]
    if "diffuse" in by:
        seen.append((cosine_matrix(normal, shape), maps["diffuse"][there], DIFFUSE_WEIGHT))
    return seen
