"""The gauge applied to a scene: `unirender.light.exposure` with the target drawn by seed and a d buffer of its own.

The rule itself (a percentile of the white-diffuse luminance is mapped to a target) is shared with the training data's
augmentation and stands in `unirender.light.exposure`. It sees the light and the object, never the material.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.light import exposure as gauge
from unirender_reference.faults import LightFault, ObjectFault

PASS_SPP = 16
PASS_SEED = 0


@runtime_checkable
class _Renderer(Protocol):
    @property
    def obj(self) -> Any: ...

    def exposure_mask(self) -> Any: ...

    def diffuse(self, environment: Any, spp: int, seed: int, batches: int) -> Any: ...


def exposure_factor(diffuse: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], seed: int) -> float:
    """The factor for a scene whose white-diffuse buffer under the unexposed light is `diffuse`.

    Args:
        diffuse: d at any scale, linear, not premultiplied.
        mask: coverage, [0, 1].
        seed: draws the target brightness.

    Raises:
        ObjectFault: the object covers no pixel.
        LightFault: the light does not reach it.
    """
    if not (mask > gauge.MASK_THRESHOLD).any():
        raise ObjectFault(
            "covers no pixel of the picture by half or more, expected an object in view; is it flat and seen edge-on?"
        )
    try:
        return gauge.exposure_factor(diffuse, mask, gauge.draw_target(np.random.default_rng(seed)))
    except UnirenderError as error:
        raise LightFault(str(error)) from error


def scene_exposure(
    renderer: _Renderer, environment: Float[np.ndarray, "h w 3"], seed: int, name: str = "the light"
) -> float:
    """The factor of a light on a renderer's object, from a d pass of its own.

    That pass and the mask have a fixed seed and sample count: two truths of one scene (other seeds) share their
    exposure.

    Raises:
        ObjectFault: the object covers no pixel, or an even light does not reach it either.
        LightFault: the light does not reach it; the message begins with the light's `name`.
    """
    mask = renderer.exposure_mask()
    try:
        return exposure_factor(_diffuse(renderer, environment), mask, seed)
    except LightFault as fault:
        try:
            exposure_factor(_diffuse(renderer, np.ones((3, 4, 3), np.float32)), mask, seed)
        except LightFault as error:
            raise ObjectFault("stays black even under a light from everywhere; are its normals broken?") from error
        raise LightFault(
            f"{name} does not reach {renderer.obj.name}, of which it lights no more than {100 - gauge.PERCENTILE:g}% "
            "before the camera, expected light on its visible side; turn the light, or give another"
        ) from fault


def _diffuse(renderer: _Renderer, environment: Float[np.ndarray, "eh ew 3"]) -> Float[np.ndarray, "h w 3"]:
    return renderer.diffuse(environment, spp=PASS_SPP, seed=PASS_SEED, batches=1).mean
